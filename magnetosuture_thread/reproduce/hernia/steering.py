"""A thread that is steered in the model alone: the needle is a point, and goes as fast as the filter lets it.

The loop itself, recorded commands replayed in it, and the figures of such a run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.prediction import NeedlePose, Prediction
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.safety import FilteredCommand, NeedleSafetyFilter
from magnetosuture_thread.scene import Scene

RATE = 33.0  # Hz, of the paper's simulation
COMMAND_TIMEOUT = 0.1  # s; a command that no other follows ends, as at the coil bridge
SHOWN = (0.0, 12.0, 17.0, 27.0, 35.0, 55.0)  # s; the six instants of the paper's figure
FIRST_NODES = 5  # whose barriers the paper plots
_MAX_DISTANCE = 1.0  # m; farther than any obstacle of a dish
MAX_COMMAND = 1.0  # m/s; what commands more was meant in another unit
_AHEAD = np.array([1.0, 0.0])  # a point has no heading, and a thread that turns freely asks for none


@dataclass(frozen=True)
class SteeredInstant:
    """A steered thread at one instant.

    Attributes:
        time: since the start [s].
        prediction: of the thread.
        margins: of the prediction.
        command: that led here, filtered; None at the start.
        took: wall-clock time of the whole step, filter, prediction and margins [s].
    """

    time: float
    prediction: Prediction
    margins: Margins
    command: FilteredCommand | None
    took: float


class SteeredThread:
    """The loop of an operator, the needle's filter and the thread, without a rig.

        u_0 = filter(beta^count v_0),    x_0 <- x_0 + dt u_0,    then the thread's step

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback". Deviation: the friction by which
    v_0 is slowed is that of the thread where it is now, as in the source; the thread's step sees the needle where it
    has moved to.

    Args:
        settings: of the thread among its obstacles.
        centreline: where the thread lies at the start, from the needle on, shape (m, 2) [m].
        needle: the filter of a needle that is a point.

    Raises:
        ConfigurationError: an obstacle cannot be used.
        InvalidInputError: the thread cannot begin there.
    """

    def __init__(self, settings: ThreadModelSettings, centreline: Points, needle: NeedleSafetyFilter) -> None:
        self._session = ThreadSession(replace(settings, initial_shape="measured", estimator=False), needle.scene)
        self._needle = needle
        self._stamp = 0
        self._tail = np.asarray(centreline[0], dtype=np.float64)
        for _ in self._session.on_measured_thread(0, centreline):
            pass
        self.now = self._advance(None, 0.0)

    def step(self, interval: float, commanded: NDArray[np.float64]) -> SteeredInstant:
        """Move the needle as it is commanded, as far as it may, and let the thread follow.

        Args:
            interval: dt [s].
            commanded: v_0, shape (2,) [m/s].

        Raises:
            InvalidInputError: the velocity is not finite, or beyond 1 m/s.
            SolverError: a program had no solution, or its linearisation did not converge.
        """
        began = time.perf_counter()
        if not (np.isfinite(commanded).all() and math.hypot(*commanded.tolist()) <= MAX_COMMAND):
            expected = f"finite numbers, at most {MAX_COMMAND:g} m/s"
            raise InvalidInputError("needle velocity", commanded.tolist(), expected)
        slowdown = self.now.margins.friction.slowdown
        command = self._needle.filter(commanded, self._tail, _AHEAD, slowdown=slowdown)
        self._tail = self._tail + interval * command.filtered
        self._stamp += round(interval * 1e9)
        self.now = self._advance(command, began)
        return self.now

    def _advance(self, command: FilteredCommand | None, began: float) -> SteeredInstant:
        outcome = self._session.on_pose(self._stamp, NeedlePose(self._stamp * 1e-9, self._tail, _AHEAD))
        if outcome.problem is not None:
            raise outcome.problem
        prediction, margins = outcome.prediction, outcome.margins
        assert prediction is not None
        if margins is None:
            raise SolverError(prediction.solver, prediction.status, prediction.residual, 0.0)
        took = time.perf_counter() - began if command is not None else 0.0
        return SteeredInstant(self._stamp * 1e-9, prediction, margins, command, took)


@dataclass(frozen=True)
class RecordedCommands:
    """Velocity commands that an operator gave.

    Attributes:
        times: of each command, rising, shape (m,) [s].
        velocities: shape (m, 2) [m/s].
    """

    times: NDArray[np.float64]
    velocities: NDArray[np.float64]

    @property
    def duration(self) -> float:
        """From the start to the last command [s]."""
        return float(self.times[-1]) if len(self.times) else 0.0

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the velocity commanded at a time [s], shape (2,) [m/s]; zero where no command is valid."""
        index = int(np.searchsorted(self.times, time + 1e-9, side="right")) - 1
        if index < 0 or time - self.times[index] > COMMAND_TIMEOUT + 1e-9:
            return np.zeros(2)
        return np.asarray(self.velocities[index])


@dataclass(frozen=True)
class HerniaSummary:
    """The figures of a run.

    Attributes:
        setup: name of the setup.
        formulation: of the thread model.
        nodes: n.
        duration: [s].
        rate: of the steps [Hz].
        deepest: of a node or the needle in an obstacle, 0 if none ever was in one [m].
        chord_deepest: the same of the middle of a chord between two nodes [m].
        stretch: greatest of a segment, either way [-].
        most_friction: greatest number of nodes under friction at once.
        slowest: least factor on the needle's speed.
        median_step: wall-clock time of a whole step: filter, thread and margins [s].
        high_step: its 99th percentile [s].
        instants: what was so at the times that are shown.
    """

    setup: str
    formulation: str
    nodes: int
    duration: float
    rate: float
    deepest: float
    chord_deepest: float
    stretch: float
    most_friction: int
    slowest: float
    median_step: float
    high_step: float
    instants: tuple[dict[str, Any], ...]

    @property
    def real_time_factor(self) -> float:
        """How many times the median step fits into its period."""
        return 1.0 / (self.rate * self.median_step)

    def to_json(self) -> dict[str, Any]:
        """Return the figures, as JSON has them."""
        simulated = "the thread model alone, the needle a point"
        return {**asdict(self), "room": self.real_time_factor, "simulated": simulated}


@dataclass(frozen=True)
class HerniaRun:
    """A whole run.

    Attributes:
        settings: of the thread.
        scene: dish and shapes.
        instants: one a step, by time; the first is the start.
        barriers: h_obs of the first nodes, shape (steps + 1, nodes, obstacles) [m].
        chord_depths: how deep the middles of chords are at each step, negative outside, shape (steps + 1,) [m].
    """

    settings: ThreadModelSettings
    scene: Scene
    instants: Sequence[SteeredInstant]
    barriers: NDArray[np.float64]
    chord_depths: NDArray[np.float64]

    def nearest(self, time: float) -> SteeredInstant:
        """Return the instant nearest to a time [s]."""
        return min(self.instants, key=lambda instant: abs(instant.time - time))

    @property
    def shown(self) -> list[SteeredInstant]:
        """The instants to show: those of the paper, or as many spread evenly over a run that ends before."""
        end = self.instants[-1].time
        times = SHOWN if end >= SHOWN[-1] else np.linspace(0.0, end, len(SHOWN)).tolist()
        return [self.nearest(time) for time in times]

    def summary(self, setup: str) -> HerniaSummary:
        """Return the figures; `setup` is the setup's name."""
        steps = self.instants[1:]
        took = np.array([step.took for step in steps])
        radius = 0.5 * self.settings.thread().diameter
        nearest = min((step.margins["obstacle"].minimum for step in self.instants), default=math.inf)
        counts = [len(step.margins.friction.nodes) for step in steps]
        return HerniaSummary(
            setup=setup,
            formulation=self.settings.formulation,
            nodes=self.settings.segments,
            duration=self.instants[-1].time,
            rate=RATE,
            deepest=max(0.0, -(nearest + radius)),
            chord_deepest=max(0.0, float(self.chord_depths.max())),
            stretch=max(float(np.abs(step.prediction.strain).max()) for step in self.instants),
            most_friction=max(counts),
            slowest=min(step.margins.friction.slowdown for step in steps),
            median_step=float(np.median(took)),
            high_step=float(np.percentile(took, 99.0)),
            instants=tuple(map(_instant_figures, self.shown)),
        )


def point_filter(scene: Scene, keep_out: float, approach_rate: float) -> NeedleSafetyFilter:
    """Return the filter of a needle that is a point and gets a new command in every step.

    Args:
        scene: dish and shapes.
        keep_out: least distance of the needle from wall and shapes [m].
        approach_rate: share of that distance by which it may approach [1/s].
    """
    return NeedleSafetyFilter(scene, keep_out=keep_out, approach_rate=approach_rate, hold_time=1.0 / RATE)


def replay_steering(
    settings: ThreadModelSettings,
    centreline: Points,
    commands: RecordedCommands,
    needle: NeedleSafetyFilter,
    progress: Callable[[float], None] = lambda share: None,
) -> HerniaRun:
    """Steer a thread as recorded.

    Args:
        settings: of thread and obstacles.
        centreline: where the thread lies at the start, from the needle on, shape (m, 2) [m].
        commands: of the operator.
        needle: see `point_filter`.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigurationError: an obstacle cannot be used.
        InvalidInputError: the thread cannot begin there, or a velocity cannot be used.
        SolverError: a step had no solution.
    """
    around = Workspace(needle.scene.obstacles, _MAX_DISTANCE)
    instants = list(_steps(SteeredThread(settings, centreline, needle), commands, progress))
    radius, obstacles = 0.5 * settings.thread().diameter, len(around.shapes)
    barriers = np.array(
        [_distances(around, instant.prediction.positions[1 : 1 + FIRST_NODES], obstacles) for instant in instants]
    )
    middles = [0.5 * (i.prediction.positions[1:] + i.prediction.positions[:-1]) for i in instants]
    depths = np.array([-_distances(around, points, obstacles).min(initial=_MAX_DISTANCE) for points in middles])
    return HerniaRun(settings, needle.scene, instants, barriers - radius, depths)


def _steps(
    thread: SteeredThread, commands: RecordedCommands, progress: Callable[[float], None]
) -> Iterator[SteeredInstant]:
    yield thread.now
    count = math.ceil((commands.duration + COMMAND_TIMEOUT) * RATE)
    for k in range(count):
        yield thread.step(1.0 / RATE, commands.at(k / RATE))
        progress((k + 1) / count)


def _distances(around: Workspace, points: Points, obstacles: int) -> NDArray[np.float64]:
    """Return the signed distance of each point from each obstacle, shape (m, obstacles) [m]."""
    near = around.near(points)
    distances = np.full((len(points), obstacles), _MAX_DISTANCE)
    np.minimum.at(distances, (near.node, near.obstacle), near.distance)
    return distances


def _instant_figures(instant: SteeredInstant) -> dict[str, Any]:
    friction, command = instant.margins.friction, instant.command
    return {
        "time": instant.time,
        "state": friction.state.name.lower(),
        "friction_nodes": list(friction.nodes),
        "slowdown": friction.slowdown,
        "asked": command.commanded.tolist() if command else [0.0, 0.0],
        "passed": command.filtered.tolist() if command else [0.0, 0.0],
        "needle": instant.prediction.positions[0].tolist(),
    }
