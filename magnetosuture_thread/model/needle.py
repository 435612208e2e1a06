"""The needle's own safety filter: a commanded velocity that keeps it out of the obstacles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.obstacles import Surroundings
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.program import SPAN, ChainProgram, Solver

UNIT = 1e-3  # m; what the filter's program counts in, so that its residuals are scaled
RECOVERING = 1e-7  # compliance of a row that has to push the needle out


@dataclass(frozen=True)
class NeedleFilter:
    """Changes the commanded velocity of the needle as little as its obstacle barriers ask for.

        minimise over u_0   1/2 |u_0 - v_0|^2
        subject to          n' u_0 >= -alpha h_obs,needle,O    for every obstacle O that is near

    From outside of the safe set, h < 0, the same row leads back into it, at the rate alpha.

    Source: [Forghani2025], h_obs,needle,O and the controller's part in u_0. Deviation: connectivity does
    not act on the needle, so its part of the program stands alone and is solved alone; h is the signed
    distance, see `ObstacleAvoidance`.

    Attributes:
        surroundings: the obstacles [m]; a needle farther from them than their reach goes where it is told.
        distance: rho, least distance of the needle's tail from a surface [m].
        gain: alpha [1/s].
        solver: solves the program.
        tolerance: the largest residual with which a solution is accepted.
    """

    surroundings: Surroundings
    distance: float
    gain: float
    solver: Solver
    tolerance: float = 1e-6

    def safe_velocity(self, position: Points, commanded: Points) -> NDArray[np.float64]:
        """Return the velocity to go with, shape (d,) [m/s].

        Args:
            position: of the needle's tail, shape (d,) [m].
            commanded: v_0, shape (d,) [m/s].

        Raises:
            InvalidInputError: a position or a velocity is not finite.
            SolverError: the solution's residual is above the tolerance.
        """
        for name, value in (("needle position", position), ("needle velocity", commanded)):
            if not np.all(np.isfinite(value)):
                raise InvalidInputError(name, np.asarray(value).tolist(), "finite coordinates")
        dimension, near = self.surroundings.dimension, self.surroundings.near(position[None, :])
        margin = (near.distance - self.distance) / UNIT
        gradient = np.zeros((len(near), SPAN, dimension))
        gradient[:, 0] = near.outward
        linear = np.zeros((SPAN, dimension))  # the smallest chain; its other nodes are known
        linear[0] = -commanded / UNIT
        program = ChainProgram(
            blocks=np.tile(np.eye(dimension), (SPAN, 1, 1)),
            couplings=np.zeros((SPAN, SPAN)),
            linear=linear,
            known=np.arange(SPAN) > 0,
            first=np.zeros(len(near), dtype=np.int64),
            gradient=gradient,
            lower=-self.gain * margin,
            upper=np.full(len(near), np.inf),
            compliance=np.where(margin < 0.0, RECOVERING, 0.0),
        )
        solution = self.solver.solve(program, -linear, np.zeros(len(near)))
        if not solution.residuals.largest <= self.tolerance:
            raise SolverError(solution.solver, solution.status, solution.residuals.largest, self.tolerance)
        return np.asarray(UNIT * solution.velocities[0])
