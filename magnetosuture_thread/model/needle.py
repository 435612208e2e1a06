"""The needle's own safety filter: a commanded velocity that keeps it out of the obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.arc import NeedlePoints, needle_points
from magnetosuture_thread.geometry.obstacles import Surroundings
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.program import SPAN, ChainProgram, Solver

UNIT = 1e-3  # m; what the filter's program counts in, so that its residuals are scaled
SPACING = 5e-4  # m; of the points that stand for the needle's body at the most
LEAVING = 0.1  # of the speed asked for, at which a needle that is too near leaves while it moves
YIELDING = 1e-3  # compliance of a row that asks to leave: it gives way where two ask for the opposite
_POINT = NeedlePoints(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(2))


@dataclass(frozen=True)
class NeedleFilter:
    """Changes the commanded velocity of the needle as little as its obstacle barriers ask for.

        minimise over u   1/2 |u - v|^2
        subject to        n' J_p u >= -alpha max(h, 0)       for every point p of the needle, and
                          h = sd_O(p) - rho                  every obstacle O that is near it

    A needle without a length is the point where the thread begins, and J = 1. Else u is the velocity of its
    tip: along the needle's chord it is driven, across it turns about the chord's middle, and J_p u is what
    that moves the point p by. All rows are hard. Rest is always allowed, and nothing but a command ever moves
    the needle: where it is too near already, h < 0, it may leave or slide along but go no deeper, and while
    it is told to move it leaves, at up to a tenth of the speed. What asks to leave is soft, and is left out
    where that cannot be solved; the needle never goes faster than it is told: |u| <= |v|.

    Source: [Forghani2025], h_obs,needle,O and the controller's part in u_0. Deviation: connectivity does
    not act on the needle, so its part of the program stands alone and is solved alone; h is the signed
    distance, see `ObstacleAvoidance`; max(h, 0) for h, as the source's row would push a needle that nobody
    asked to move; the body.

    Attributes:
        surroundings: the obstacles [m]; a needle farther from them than their reach goes where it is told.
        distance: rho, least distance of the needle's axis from a surface [m].
        gain: alpha [1/s].
        solver: solves the program.
        tolerance: the largest residual with which a solution is accepted.
        length: of the needle along its body; 0 for a point [m].
        curvature: of its arc, positive to the left of its heading [1/m].
    """

    surroundings: Surroundings
    distance: float
    gain: float
    solver: Solver
    tolerance: float = 1e-6
    length: float = 0.0
    curvature: float = 0.0

    @cached_property
    def _needle(self) -> NeedlePoints:
        return needle_points(self.length, self.curvature, SPACING) if self.length > 0.0 else _POINT

    def safe_velocity(self, tail: Points, heading: Points, commanded: Points) -> NDArray[np.float64]:
        """Return the velocity to go with, shape (2,) [m/s]; of the tip, or of a needle that is a point.

        Args:
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).
            commanded: v, shape (2,) [m/s].

        Raises:
            InvalidInputError: a position, a heading or a velocity is not finite.
            SolverError: the solution's residual is above the tolerance.
        """
        for name, value in (("needle position", tail), ("needle heading", heading), ("needle velocity", commanded)):
            if not np.all(np.isfinite(value)):
                raise InvalidInputError(name, np.asarray(value).tolist(), "finite coordinates")
        points, turning, chord = self._needle.turned(heading)
        near = self.surroundings.near(tail + points)
        margin = (near.distance - self.distance) / UNIT
        across = np.array([-chord[1], chord[0]])
        rows = near.outward
        if self.length > 0.0:
            along = np.einsum("ij,j->i", near.outward, chord)
            aside = np.einsum("ij,ij->i", near.outward, turning[near.node])
            rows = along[:, None] * chord + aside[:, None] * across
        lower = -self.gain * np.maximum(margin, 0.0)
        asked = np.asarray(commanded, dtype=np.float64)
        speed = math.hypot(*asked.tolist())
        beyond = np.flatnonzero(margin < 0.0)
        if not len(beyond):
            return self._solved(asked, rows, lower, np.zeros(len(rows)))
        leaving = np.minimum(-self.gain * margin[beyond], LEAVING * speed / UNIT)
        compliance = np.concatenate([np.zeros(len(rows)), np.full(len(beyond), YIELDING)])
        try:
            passed = self._solved(asked, np.vstack([rows, rows[beyond]]), np.concatenate([lower, leaving]), compliance)
        except SolverError:  # of rows that ask for the opposite of each other; what forbids never does
            passed = self._solved(asked, rows, lower, np.zeros(len(rows)))
        faster = math.hypot(*passed.tolist())
        return passed * (speed / faster) if faster > speed else passed

    def _solved(
        self,
        commanded: Points,
        rows: NDArray[np.float64],
        lower: NDArray[np.float64],
        compliance: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the solution of the program over u, of which each row asks  row . u >= lower."""
        dimension, count = len(commanded), len(lower)
        gradient = np.zeros((count, SPAN, dimension))
        gradient[:, 0] = rows
        linear = np.zeros((SPAN, dimension))  # the smallest chain; its other nodes are known
        linear[0] = -commanded / UNIT
        program = ChainProgram(
            blocks=np.tile(np.eye(dimension), (SPAN, 1, 1)),
            couplings=np.zeros((SPAN, SPAN)),
            linear=linear,
            known=np.arange(SPAN) > 0,
            first=np.zeros(count, dtype=np.int64),
            gradient=gradient,
            lower=lower,
            upper=np.full(count, np.inf),
            compliance=compliance,
        )
        solution = self.solver.solve(program, -linear, np.zeros(count))
        if not solution.residuals.largest <= self.tolerance:
            raise SolverError(solution.solver, solution.status, solution.residuals.largest, self.tolerance)
        return np.asarray(UNIT * solution.velocities[0])
