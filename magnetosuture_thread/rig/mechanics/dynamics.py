"""The dish in motion: a magnetic needle that coil currents pull through glycerin, and the thread behind it.

Everything is overdamped. Needle and thread move in one implicit step: the thread's drag is greater than the
needle's, so steps in turn would not be stable.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magnetosuture_thread.errors import ConfigurationError, InvalidInputError, SolverError
from magnetosuture_thread.geometry.polyline import Points, chain_along
from magnetosuture_thread.rig.mechanics.contact import Shapes, Surface
from magnetosuture_thread.rig.mechanics.field import CoilField
from magnetosuture_thread.rig.mechanics.needle import Needle, NeedleBody, find_poles
from magnetosuture_thread.rig.mechanics.newton import MAX_ITERATIONS, advance, make_buffers
from magnetosuture_thread.rig.mechanics.rod import Rod
from magnetosuture_thread.rig.mechanics.thread import NeedleJoint, ThreadProperties

__all__ = ["NeedleJoint", "RigDynamics", "Surface", "ThreadProperties"]

MAX_STEP = 2e-3  # s
TOLERANCE = 1e-9  # m; the last move of Newton's iteration, which then converges quadratically
MAX_HALVINGS = 8
GREATEST_GROWTH = 2.0  # of a step; the formula is stable up to 1 + sqrt(2)
MAX_CONTACTS = 48  # points of the needle's outline


class RigDynamics:
    """Needle and thread over time.

    Args:
        needle: the needle.
        thread: the thread.
        surface: what can be touched.
        field: of the coils; without it the needle can only be driven.
        tail: where the needle's tail is, (x, y) [m].
        heading: of the needle at its tail [rad].
        thread_points: a polyline from the tail on, along which the thread is laid, shape (m, 2) [m].
        largest_step: of the integration [s].

    Attributes:
        time: since the start [s].
        residual: the largest force that is out of balance after the last step [N].
        iterations: of Newton in the last call.
        substeps: in the last call.
        halvings: of steps that did not converge at first, in the last call.
        converged: whether the last step did; where it is false, an error was raised.

    Raises:
        InvalidInputError: a value is not finite, or the thread does not begin at the tail.
    """

    def __init__(
        self,
        needle: NeedleBody,
        thread: ThreadProperties,
        surface: Surface,
        field: CoilField | None,
        tail: ArrayLike,
        heading: float,
        thread_points: Points,
        *,
        largest_step: float = MAX_STEP,
    ) -> None:
        self.needle, self.properties, self.field = needle, thread, field
        start = _finite("rig.tail", tail, (2,))
        points = np.asarray(thread_points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or not np.isfinite(points).all():
            raise InvalidInputError("rig.thread_points", points.shape, "two or more finite points, shape (m, 2) [m]")
        length = thread.length / thread.segments
        if float(np.linalg.norm(points[0] - start)) > 0.1 * length:
            raise InvalidInputError("rig.thread_points", tuple(points[0]), f"a first point at the tail, {start}")
        if not float(np.ptp(points, axis=0).max()) > 0.0:
            raise InvalidInputError("rig.thread_points", "one place", "points that differ")
        if not largest_step > 0.0:
            raise ConfigurationError("rig.largest_step", largest_step, "a positive number [s]")
        self._q = np.concatenate(
            [[_number("rig.heading", heading)], chain_along(points, thread.segments, length).ravel()]
        )
        self._q[1:3] = start
        self._before, self._last_dt = self._q.copy(), 0.0
        self._largest_step = largest_step
        self._skin = surface.skin
        self._shapes = surface.packed()
        self._rod = Rod(
            length,
            thread.stretching_stiffness,
            thread.bending_stiffness,
            thread.drag_across,
            thread.drag_along,
            thread.rest_curvature * length,
            0.5 * thread.diameter + surface.skin,
        )
        glue = thread.bending_stiffness / length**3 if thread.attachment is NeedleJoint.CLAMPED else 0.0
        touching = min(int(2.0 * needle.length / needle.diameter) + 2, MAX_CONTACTS)
        self._needle = Needle(
            np.ascontiguousarray(needle.resistance[np.ix_([2, 0, 1], [2, 0, 1])]),
            needle.tip,
            needle.pole,
            needle.outline(touching),
            0.5 * needle.diameter + surface.skin,
            (glue, 0.5 * thread.rest_curvature * length**2),
        )
        self._buffers = make_buffers(thread.segments, _contacts(self._shapes))
        self._poles, self._flux = np.zeros((2, 3)), np.zeros((2, 2))  # tail and tip, and the field there [T]
        self._move, self._held = 0.0, np.zeros(0)
        self.time, self.residual, self.converged = 0.0, 0.0, True
        self.iterations = self.substeps = self.halvings = 0

    @property
    def tail(self) -> NDArray[np.float64]:
        """The needle's tail, shape (2,) [m]."""
        return np.array(self._q[1:3])

    @property
    def heading(self) -> float:
        """Of the needle at its tail, unwrapped [rad]."""
        return float(self._q[0])

    @property
    def tip(self) -> NDArray[np.float64]:
        """The needle's tip, shape (2,) [m]."""
        return self._tip_of(self._q)

    @property
    def body(self) -> Points:
        """Points along the needle's axis, from the tail to the tip, shape (m, 2) [m]."""
        return np.array([self._q[1:3] + self._turned(self._q, point) for point in self._needle.outline])

    @property
    def thread(self) -> Points:
        """The thread's nodes, the tail first, shape (n + 1, 2) [m]."""
        return np.array(self._q[1:].reshape(-1, 2))

    @property
    def tension(self) -> NDArray[np.float64]:
        """Tension of each segment, positive when pulled, shape (n,) [N]."""
        chords = np.linalg.norm(np.diff(self._q[1:].reshape(-1, 2), axis=0), axis=1)
        return np.asarray(self._rod.stretching * (chords / self._rod.segment - 1.0))

    @property
    def thread_pull(self) -> NDArray[np.float64]:
        """Force of the thread on the needle, at the tail, shape (2,) [N]: of stretching, bending and the clamp."""
        rod, edges, clamp = self._rod, np.diff(self.thread[:3], axis=0), self._needle.clamp
        stretch = self.tension[0] * edges[0] / np.linalg.norm(edges[0])
        c, s = math.cos(rod.rest_turn), math.sin(rod.rest_turn)
        bend = c * (edges[1] - edges[0]) + s * np.array([edges[1, 1], -edges[1, 0]])
        gap = edges[0] + self._turned(self._q, np.array([rod.segment, clamp[1]]))
        return np.asarray(stretch - rod.bending / rod.segment**3 * bend + 2.0 * clamp[0] * gap)

    @property
    def thread_moment(self) -> float:
        """Moment of the thread upon the needle about its tail, counter-clockwise [N m]: of the clamp; 0 if pinned."""
        direction = self._turned(self._q, np.array([self._rod.segment, self._needle.clamp[1]]))
        edge = self.thread[1] - self.thread[0]
        return float(2.0 * self._needle.clamp[0] * (direction[1] * edge[0] - direction[0] * edge[1]))

    @property
    def energy(self) -> float:
        """Elastic energy of the thread, with the clamp's [J]."""
        rod, nodes = self._rod, self.thread
        edges = np.diff(nodes, axis=0)
        stretch = 0.5 * rod.segment / rod.stretching * float(self.tension @ self.tension)
        cross = edges[:-1, 0] * edges[1:, 1] - edges[:-1, 1] * edges[1:, 0]
        turns = np.arctan2(cross, np.sum(edges[:-1] * edges[1:], axis=1)) - rod.rest_turn
        bend = rod.bending / rod.segment * float(np.sum(1.0 - np.cos(turns)))
        gap = edges[0] + self._turned(self._q, np.array([rod.segment, self._needle.clamp[1]]))
        return stretch + bend + self._needle.clamp[0] * float(gap @ gap)

    def set_surface(self, surface: Surface) -> None:
        """Touch other things from now on; needle and thread must be outside of them.

        Raises:
            ConfigurationError: the surface is not one.
        """
        if surface.skin != self._skin:
            raise ConfigurationError("surface.skin", surface.skin, f"{self._skin:g} m, as before")
        shapes = surface.packed()
        self._buffers = make_buffers(self.properties.segments, _contacts(shapes))
        self._shapes = shapes
        # The last two states may be farther apart than a step that touches something can follow.
        self._before, self._last_dt = self._q.copy(), 0.0

    def step(self, currents: ArrayLike, dt: float, max_iterations: float = math.inf) -> float:
        """Move on under coil currents, which are held; return for how long [s].

        Args:
            currents: signed, one for each coil, shape (k,) [A].
            dt: time, in which the rig takes as many steps as it needs [s].
            max_iterations: of Newton, those of steps that fail too, after which no other step begins: less than dt has
                passed then.

        Raises:
            InvalidInputError: a value is not finite, or of the wrong shape.
            SolverError: Newton's iteration did not converge, however small the step; the state is that of the last
                step that did.
        """
        amperes = _finite("rig.currents", currents, (len(self.field.coils) if self.field else 0,))
        span = _positive("rig.dt", dt)
        if not np.array_equal(amperes, self._held):
            # Speeds jump with currents: a formula that looks back over the jump would lag by part of a step.
            self._held, self._last_dt = amperes.copy(), 0.0
        return self._integrate(span, amperes, None, max_iterations)

    def drive(self, tail: ArrayLike, heading: float, dt: float) -> None:
        """Move the needle at constant velocity and turn rate, and the thread with it.

        Args:
            tail: where the tail is after dt, (x, y) [m].
            heading: the same, by whichever way round is shorter [rad].
            dt: [s].

        Raises:
            InvalidInputError: a value is not finite, or of the wrong shape.
            SolverError: see `step`.
        """
        goal = np.concatenate([[_number("rig.heading", heading)], _finite("rig.tail", tail, (2,))])
        goal[0] = self._q[0] + math.remainder(goal[0] - self._q[0], 2.0 * math.pi)
        self._integrate(_positive("rig.dt", dt), None, goal)

    def _integrate(
        self,
        dt: float,
        currents: NDArray[np.float64] | None,
        goal: NDArray[np.float64] | None,
        max_iterations: float = math.inf,
    ) -> float:
        """Take steps until dt is over, or the iterations are used up; a step that does not converge is halved."""
        regular = dt / max(math.ceil(dt / self._largest_step - 1e-9), 1)
        done, h, tries = 0.0, regular, 0
        self.iterations = self.substeps = self.halvings = 0
        begin = self._q[:3].copy()
        while (left := dt - done) > 1e-12 * dt:
            # At least one step is taken, or fails for good: nothing is tried again and again in call after call.
            if done and self.iterations + MAX_ITERATIONS * self.halvings >= max_iterations:
                return done
            if self._last_dt > 0.0:
                h = min(h, GREATEST_GROWTH * self._last_dt)
            # What is left is taken whole or in two like steps, never with a sliver at the end.
            if left < 1.5 * h:
                h = left if left < 1.01 * h else 0.5 * left
            if goal is not None:
                self._buffers.trial[:3] = begin + (done + h) / dt * (goal - begin)
            if self._take(h, currents):
                done, h, tries = done + h, regular, 0
                continue
            tries += 1
            if tries > MAX_HALVINGS:
                self.converged = False
                raise SolverError("rig", "no convergence", self._move, TOLERANCE)
            self.halvings += 1
            h *= 0.5
        return dt

    def _take(self, h: float, currents: NDArray[np.float64] | None) -> bool:
        """Take one step; return whether it converged, and change nothing if not."""
        ratio = h / self._last_dt if self._last_dt > 0.0 else 0.0
        if currents is not None and self.field is not None:
            find_poles(self._q, self._before, ratio, self.needle.tip, self._poles)
            self._flux[:] = (currents @ self.field.per_current(self._poles).reshape(-1, 6)).reshape(2, 3)[:, :2]
        start = self._q.copy()
        iterations, self._move, residual = advance(
            self._q,
            self._before,
            h,
            ratio,
            self._flux,
            self._needle,
            self._rod,
            self._shapes,
            self._buffers,
            currents is None,
            TOLERANCE,
        )
        if iterations < 0:
            return False
        self._before[:], self._last_dt = start, h
        self.time, self.residual, self.converged = self.time + h, residual, True
        self.iterations, self.substeps = self.iterations + iterations, self.substeps + 1
        return True

    def _tip_of(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(q[1:3] + self._turned(q, self.needle.tip))

    @staticmethod
    def _turned(q: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
        c, s = math.cos(q[0]), math.sin(q[0])
        return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def _contacts(shapes: Shapes) -> int:
    """Return with how many things one point can have to do at once at the most."""
    return len(shapes.discs) + len(shapes.corners) + 2


def _finite(name: str, given: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    values = np.asarray(given, dtype=np.float64)
    if values.shape != shape or not np.isfinite(values).all():
        raise InvalidInputError(name, values.tolist(), f"{shape[0]} finite numbers")
    return values


def _number(name: str, given: float) -> float:
    if not math.isfinite(given):
        raise InvalidInputError(name, given, "a finite number")
    return float(given)


def _positive(name: str, given: float) -> float:
    if not (math.isfinite(given) and given > 0.0):
        raise InvalidInputError(name, given, "a positive number")
    return float(given)
