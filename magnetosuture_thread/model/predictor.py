"""The predictor: follows the needle's poses by their stamps and says where the thread is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, chain_along
from magnetosuture_thread.model.barriers import BarrierRows
from magnetosuture_thread.model.formulations import RodFormulation
from magnetosuture_thread.model.solvers import OsqpSolver
from magnetosuture_thread.model.thread import Thread

FARTHEST = 10.0  # m; nothing that a dish could hold is farther away


@dataclass(frozen=True)
class NeedlePose:
    """The needle at one instant, in the dish frame.

    Attributes:
        stamp: [s]
        tail: the blunt end, where the thread is attached, shape (d,) [m].
        heading: unit vector from tail to tip, shape (d,).
    """

    stamp: float
    tail: Points
    heading: Points


@dataclass(frozen=True)
class Prediction:
    """The thread at one instant.

    Attributes:
        stamp: [s]
        formulation: name of the formulation.
        vertices: all nodes, shape (n + 1, d) [m].
        stretch: segment length over rest length, less one, shape (n,).
        margins: every barrier, a `BarrierRows` for each kind, in SI units.
        interval: time since the previous prediction [s].
        substeps: number of steps it was divided into.
        solver: the solver's name.
        status: the solver's own word.
        residual: the largest scaled residual of the solves.
    """

    stamp: float
    formulation: str
    vertices: Points
    stretch: NDArray[np.float64]
    margins: list[BarrierRows]
    interval: float
    substeps: int
    solver: str
    status: str
    residual: float


class ThreadPredictor:
    """Predicts a thread from the needle's poses.

    Args:
        thread: the thread.
        obstacles: discs in the dish frame [m].
        longest_step: intervals are divided into steps of at most this [s].
        most_substeps: but into at most so many; then the steps get longer.
        tolerance: the largest scaled residual with which a solution is accepted.
    """

    def __init__(
        self,
        thread: Thread,
        obstacles: Sequence[Disc] = (),
        *,
        longest_step: float = 1.0 / 66.0,
        most_substeps: int = 200,
        tolerance: float = 1e-5,
    ) -> None:
        self.thread = thread
        self._formulation = RodFormulation(thread, obstacles, OsqpSolver(), tolerance)
        self._longest_step = longest_step
        self._most_substeps = most_substeps
        self._pose: NeedlePose | None = None
        self._vertices: Points | None = None

    @property
    def started(self) -> bool:
        """Whether the thread has a shape to go on from."""
        return self._vertices is not None

    def reset(self) -> None:
        """Forget the thread's shape; the next call must be `start`."""
        self._pose = self._vertices = None

    def start(self, pose: NeedlePose, centreline: Points) -> Prediction:
        """Take the thread's shape from a centreline, seen or assumed, from tail to end.

        Args:
            pose: the needle at the same instant.
            centreline: polyline, shape (m, d), m >= 2 [m]; if it is shorter than the thread, the
                thread goes on straight.

        Raises:
            InvalidInputError: the pose or the centreline is not finite, or the centreline is shorter
                than a segment or begins farther than one from the tail.
        """
        check_pose(pose)
        if len(centreline) < 2 or not np.all(np.isfinite(centreline)):
            raise InvalidInputError("centreline", f"{len(centreline)} points", "at least 2 finite points [m]")
        gap, unit = float(np.linalg.norm(centreline[0] - pose.tail)), self.thread.segment_length
        if gap > unit:
            raise InvalidInputError("centreline", f"{gap:.2e} m from the needle's tail", f"at most {unit:.2e} m")
        path = np.vstack([pose.tail, centreline[1:]])
        if arc_lengths(path)[-1] < unit:
            raise InvalidInputError("centreline", f"{arc_lengths(path)[-1]:.2e} m long", f"at least {unit:.2e} m")
        self._vertices = chain_along(path, self.thread.segments, self.thread.segment_length)
        self._pose = pose
        return self._prediction(pose.stamp, 0.0, 0, "none", "started", 0.0)

    def step(self, pose: NeedlePose) -> Prediction:
        """Follow the needle to its next pose.

        The real interval between the stamps is stepped over, in sub-steps along the straight line
        between the two poses. Where a solve fails, the thread stays as it was at the last pose.

        Raises:
            InvalidInputError: the pose is not finite, or not later than the last one.
            SolverError: a solution's residual is above the tolerance.
        """
        if self._pose is None or self._vertices is None:
            raise InvalidInputError("needle pose", "a pose before the start", "a centreline first")
        check_pose(pose)
        last = self._pose
        interval = pose.stamp - last.stamp
        if interval <= 0.0:
            raise InvalidInputError("needle pose stamp", f"{pose.stamp:.6f} s", f"later than {last.stamp:.6f} s")
        substeps = min(self._most_substeps, max(1, math.ceil(interval / self._longest_step - 1e-9)))
        vertices = self._vertices
        residual = 0.0
        for index in range(1, substeps + 1):
            part = index / substeps
            tail = last.tail + part * (pose.tail - last.tail)
            heading = _between(last.heading, pose.heading, part)
            done = self._formulation.step(vertices, tail, heading, interval / substeps)
            vertices = done.positions
            residual = max(residual, done.residual)
        self._pose, self._vertices = pose, vertices
        return self._prediction(pose.stamp, interval, substeps, done.solver, done.status, residual)

    def _prediction(
        self, stamp: float, interval: float, substeps: int, solver: str, status: str, residual: float
    ) -> Prediction:
        assert self._vertices is not None
        lengths = np.linalg.norm(np.diff(self._vertices, axis=0), axis=1)
        return Prediction(
            stamp=stamp,
            formulation=self._formulation.name,
            vertices=self._vertices,
            stretch=lengths / self.thread.segment_length - 1.0,
            margins=self._formulation.margins(self._vertices),
            interval=interval,
            substeps=substeps,
            solver=solver,
            status=status,
            residual=residual,
        )


def check_pose(pose: NeedlePose) -> None:
    """Raise `InvalidInputError` unless the pose is finite, not absurdly far, and its heading a unit vector."""
    if not math.isfinite(pose.stamp):
        raise InvalidInputError("needle pose stamp", pose.stamp, "a finite time [s]")
    if not np.all(np.abs(pose.tail) <= FARTHEST):
        where = np.asarray(pose.tail).tolist()
        raise InvalidInputError("needle pose position", where, f"finite coordinates, at most {FARTHEST:g} m from 0")
    if not np.all(np.isfinite(pose.heading)) or abs(float(np.linalg.norm(pose.heading)) - 1.0) > 1e-3:
        raise InvalidInputError("needle pose heading", np.asarray(pose.heading).tolist(), "a unit vector")


def _between(first: Points, second: Points, part: float) -> Points:
    """Return the direction between two unit vectors; where they are opposite, the second."""
    mixed = (1.0 - part) * first + part * second
    size = float(np.linalg.norm(mixed))
    return np.asarray(mixed / size) if size > 1e-6 else second
