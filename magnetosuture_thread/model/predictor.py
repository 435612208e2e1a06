"""The predictor: follows the needle's poses by their stamps and says where the thread is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, chain_inside
from magnetosuture_thread.model.barriers import BarrierRows
from magnetosuture_thread.model.formulations import Drive, Formulation, StepSolution, ThreadState
from magnetosuture_thread.model.program import SOLVED, Residuals
from magnetosuture_thread.model.succession import gone_on
from magnetosuture_thread.model.thread import Thread

FARTHEST = 10.0  # m; nothing that a dish could hold is farther away
STARTED = "started"  # status of a prediction that no step led to
LONGEST_WAY = 0.5  # segments; of a driven node in a sub-step


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
        scene_version: of the scene that it was predicted in; empty where the model knows none.
        vertices: all nodes, shape (n + 1, d) [m].
        stretch: each segment's length from end to end over what it should be, less one, shape (n,).
        interval: time since the previous prediction [s].
        substeps: number of steps it was divided into.
        solver: the solver's name.
        status: the solver's own word; where one did not solve at once, what had to be tried.
        residual: the largest scaled residual of the solves.
        converged: whether every step ended where the barriers themselves hold, not only their linearisations;
            if not, the margins are those of a thread that is not where the equations say.
        judge: works out the margins.
    """

    stamp: float
    formulation: str
    scene_version: str
    vertices: Points
    stretch: NDArray[np.float64]
    interval: float
    substeps: int
    solver: str
    status: str
    residual: float
    converged: bool
    judge: Callable[[], list[BarrierRows]] = field(repr=False, compare=False)

    @cached_property
    def margins(self) -> list[BarrierRows]:
        """Every barrier, a `BarrierRows` for each kind, in SI units; worked out when it is first asked for."""
        return self.judge()


class ThreadPredictor:
    """Predicts a thread from the needle's poses.

    Args:
        formulation: steps the thread.
        thread: the thread.
        longest_step: intervals are divided into steps of at most this [s].
        most_substeps: but into at most so many; then the steps get longer.
        held: nodes that stay where they are at the start, as where tissue holds the thread.
        wall_radius: inner radius of the dish, in the plane, within which a thread starts; inf without one [m].
        scene_version: of the scene that the formulation knows; empty where it knows none.
    """

    def __init__(
        self,
        formulation: Formulation,
        thread: Thread,
        *,
        longest_step: float = 0.02,
        most_substeps: int = 200,
        held: Sequence[int] = (),
        wall_radius: float = math.inf,
        scene_version: str = "",
    ) -> None:
        for node in held:
            _check_node("held node", node, thread)
        self.thread = thread
        self._formulation = formulation
        self._longest_step = longest_step
        self._most_substeps = most_substeps
        self._held = tuple(sorted(set(held)))
        self._room_radius = wall_radius - 0.5 * thread.diameter
        self._scene_version = scene_version
        self._pose: NeedlePose | None = None
        self._state: ThreadState | None = None

    @property
    def started(self) -> bool:
        """Whether the thread has a shape to go on from."""
        return self._state is not None

    def warm_up(self) -> None:
        """Step a straight thread, so that no kernel is compiled in the first callback."""
        dimension = self._formulation.dimension
        east = np.eye(dimension)[0]
        path = -self.thread.segment_length * np.arange(self.thread.segments + 1)[:, None] * east
        begun = self.start_at(NeedlePose(0.0, np.zeros(dimension), east), path)
        assert begun.margins  # which are worked out by kernels of their own
        with suppress(SolverError):  # an obstacle that lies here says nothing of a thread that lies elsewhere
            for count in (1, 2):
                self.step(NeedlePose(count * self._longest_step, np.zeros(dimension), east))
        self.reset()

    def reset(self) -> None:
        """Forget the thread's shape; the next call must be `start`."""
        self._pose = self._state = None

    def start(self, pose: NeedlePose, centreline: Points) -> Prediction:
        """Take the thread's shape from a centreline, seen or assumed, from tail to end.

        Args:
            pose: the needle at the same instant.
            centreline: polyline, shape (m, d), m >= 2 [m]; if it is shorter than the thread, the
                thread goes on straight, and where the wall is in its way, along the wall.

        Raises:
            InvalidInputError: the pose or the centreline is not finite, or the centreline is shorter
                than a segment or begins farther than one from the tail.
        """
        check_pose(pose)
        if len(centreline) < 2 or not np.all(np.abs(centreline) <= FARTHEST):
            raise InvalidInputError(
                "centreline", f"{len(centreline)} points", f"at least 2 finite points, at most {FARTHEST:g} m from 0"
            )
        gap, unit = float(np.linalg.norm(centreline[0] - pose.tail)), self.thread.segment_length
        if gap > unit:
            raise InvalidInputError("centreline", f"{gap:.2e} m from the needle's tail", f"at most {unit:.2e} m")
        path = np.vstack([pose.tail, centreline[1:]])
        if arc_lengths(path)[-1] < unit:
            raise InvalidInputError("centreline", f"{arc_lengths(path)[-1]:.2e} m long", f"at least {unit:.2e} m")
        return self.start_at(pose, chain_inside(path, self.thread.segments, unit, self._room_radius))

    def start_at(self, pose: NeedlePose, vertices: Points) -> Prediction:
        """Take the thread's nodes as they are.

        Args:
            pose: the needle at the same instant.
            vertices: all nodes, shape (n + 1, d) [m].

        Raises:
            InvalidInputError: the pose or a node is not finite, there are not n + 1 nodes, or the first is
                farther than a segment from the tail.
        """
        check_pose(pose)
        wanted = (self.thread.segments + 1, len(pose.tail))
        if vertices.shape != wanted or not np.all(np.isfinite(vertices)):
            raise InvalidInputError("thread's nodes", f"shape {vertices.shape}", f"finite, shape {wanted} [m]")
        gap = float(np.linalg.norm(vertices[0] - pose.tail))
        if gap > self.thread.segment_length:
            nearest = f"at most {self.thread.segment_length:.2e} m"
            raise InvalidInputError("thread's first node", f"{gap:.2e} m from the needle's tail", nearest)
        self._state = ThreadState.at_rest(np.array(vertices, dtype=np.float64, order="C"))
        self._pose = pose
        return self._prediction(pose, 0.0, 0, None, Residuals(0.0, 0.0, 0.0), True)

    def follow_on(self, other: ThreadPredictor) -> None:
        """Go on from where another predictor's thread is, and as it moves, if it has started."""
        self._pose = other._pose
        self._state = gone_on(other._state, other.thread, self.thread) if other._state is not None else None

    def step(self, pose: NeedlePose, driven: Mapping[int, Points] | None = None) -> Prediction:
        """Follow the needle to its next pose.

        The real interval between the stamps is stepped over, in sub-steps along the straight line
        between the two poses: so many that neither the time nor the way of a driven node, half a segment,
        is too long for one. Where a solve fails, the thread stays as it was at the last pose.

        Args:
            pose: the needle.
            driven: where other nodes are at the same instant, if their motion is measured: positions of
                shape (d,) by index [m].

        Raises:
            InvalidInputError: the pose is not finite, or not later than the last one; or a driven node is
                none of the thread's, or not finite.
            SolverError: a solution's residual is above the tolerance.
        """
        if self._pose is None or self._state is None:
            raise InvalidInputError("needle pose", "a pose before the start", "a centreline first")
        check_pose(pose)
        last, state = self._pose, self._state
        interval = pose.stamp - last.stamp
        if interval <= 0.0:
            raise InvalidInputError("needle pose stamp", f"{pose.stamp:.6f} s", f"later than {last.stamp:.6f} s")
        ends = {0: pose.tail, **{node: state.positions[node] for node in self._held}}
        for node, position in (driven or {}).items():
            _check_node("driven node", node, self.thread)
            if np.shape(position) != pose.tail.shape or not np.all(np.abs(position) <= FARTHEST):
                where = np.asarray(position).tolist()
                raise InvalidInputError(f"position of node {node}", where, f"finite, at most {FARTHEST:g} m from 0")
            ends[node] = position
        nodes = tuple(ends)
        begin, end = state.positions[list(nodes)], np.array([ends[node] for node in nodes])
        way = max(map(math.dist, begin.tolist(), end.tolist()))
        wanted = max(interval / self._longest_step, way / (LONGEST_WAY * self.thread.segment_length), 1.0)
        substeps = min(self._most_substeps, math.ceil(wanted - 1e-9))
        residuals, worst, converged = Residuals(0.0, 0.0, 0.0), None, True
        for index in range(1, substeps + 1):
            part = index / substeps
            heading = _between(last.heading, pose.heading, part)
            done = self._formulation.step(
                state, Drive(nodes, begin + part * (end - begin), heading), interval / substeps
            )
            state, residuals = done.state, residuals.or_worse(done.residuals)
            converged = converged and done.converged
            worst = done if worst is None or worst.status == SOLVED else worst
        self._pose, self._state = pose, state
        return self._prediction(pose, interval, substeps, worst, residuals, converged)

    def _prediction(
        self,
        pose: NeedlePose,
        interval: float,
        substeps: int,
        step: StepSolution | None,
        residuals: Residuals,
        converged: bool,
    ) -> Prediction:
        assert self._state is not None
        positions = self._state.positions
        along = positions[1:] - positions[:-1]
        lengths = np.sqrt(np.einsum("ij,ij->i", along, along))
        return Prediction(
            stamp=pose.stamp,
            formulation=self._formulation.name,
            scene_version=self._scene_version,
            vertices=positions,
            stretch=lengths / self._formulation.rest_lengths(positions, pose.heading) - 1.0,
            interval=interval,
            substeps=substeps,
            solver=step.solver if step else "none",
            status=step.status if step else STARTED,
            residual=residuals.largest,
            converged=converged,
            judge=partial(self._formulation.margins, positions, pose.heading),
        )


def _check_node(field: str, node: int, thread: Thread) -> None:
    """Raise `InvalidInputError` unless this is a node of the thread and not the needle's own."""
    if not 1 <= node <= thread.segments:
        raise InvalidInputError(field, node, f"a node from 1 to {thread.segments}; node 0 follows the needle")


def check_pose(pose: NeedlePose) -> None:
    """Raise `InvalidInputError` unless the pose is finite, not absurdly far, and its heading a unit vector."""
    # In plain floats: for two or three of them numpy takes ten times as long, in every step.
    if not math.isfinite(pose.stamp):
        raise InvalidInputError("needle pose stamp", pose.stamp, "a finite time [s]")
    tail, heading = np.asarray(pose.tail).tolist(), np.asarray(pose.heading).tolist()
    if not all(abs(value) <= FARTHEST for value in tail):
        raise InvalidInputError("needle pose position", tail, f"finite coordinates, at most {FARTHEST:g} m from 0")
    if not abs(math.hypot(*heading) - 1.0) <= 1e-3:
        raise InvalidInputError("needle pose heading", heading, "a unit vector")


def _between(first: Points, second: Points, part: float) -> Points:
    """Return the direction between two unit vectors; where they are opposite, the second."""
    mixed = [(1.0 - part) * a + part * b for a, b in zip(first.tolist(), second.tolist(), strict=True)]
    square = 0.0
    for value in mixed:  # `hypot`, and `sum` from Python 3.12 on, round in another way than numpy
        square += value * value
    size = math.sqrt(square)
    return np.array([value / size for value in mixed]) if size > 1e-6 else second
