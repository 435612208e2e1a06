"""Frames of a run, measured and predicted, also by the messages of a graph; and what is kept: columns, error map."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.reading import margins_of, nanoseconds, plane_points, thread_observation
from magnetosuture_thread.estimator.disturbance import Disturbance
from magnetosuture_thread.estimator.estimator import ThreadEstimate
from magnetosuture_thread.geometry.obstacles import Obstacle
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.thread.margins import Margins, node_clearance
from magnetosuture_thread.thread.prediction import Prediction

Array = NDArray[np.float64]

_no_numbers, _no_points = partial(np.empty, 0), partial(np.empty, (0, 2))
MARGIN = "margin_"  # columns of margins, by the barrier's name
SILENT_PERIODS = 5.0  # usual intervals; a longer one without frames is a gap


@dataclass
class Observation:
    """Measured needle and thread of one camera frame, or of one recorded pose.

    Attributes:
        stamp: of the frame [ns].
        tail: the needle's tail, shape (2,) [m]; shape (0,) where the needle was not found.
        heading: unit vector from tail to tip, shape (2,); shape (0,) where the needle was not found.
        measured: the thread's centreline, from the tail on, shape (m, 2) [m]; m = 0 for none.
        ground_truth: of the thread, if the bag holds it, shape (m, 2) [m].
        true_pull: of the thread upon the needle, if the bag holds it, shape (2,) [N]; shape (0,) if not.
        reason: why the needle was not found.
        processing: time that the tracker took for the frame [s]; nan where the poses were recorded.
        observation: what is seen of the thread; None where a bag holds the centreline alone.
        deviation: standard deviations of tail [m] and heading [rad]; zeros if not known.
        recorded: the prediction that the bag holds of the frame, shape (n + 1, 2) [m]; no vertices if it holds none.
    """

    stamp: int
    tail: Array = field(default_factory=_no_numbers)
    heading: Array = field(default_factory=_no_numbers)
    measured: Points = field(default_factory=_no_points)
    ground_truth: Points = field(default_factory=_no_points)
    reason: str = ""
    processing: float = math.nan
    observation: ThreadObservation | None = None
    deviation: tuple[float, float] = (0.0, 0.0)
    true_pull: Array = field(default_factory=_no_numbers)
    recorded: Points = field(default_factory=_no_points)

    @property
    def found(self) -> bool:
        """Whether the needle was found."""
        return len(self.tail) > 0


@dataclass(frozen=True)
class EstimatedThread:
    """A thread's estimate, as far as it is kept.

    Attributes:
        vertices: shape (n + 1, 2) [m].
        corrected: whether a measurement went into it; otherwise it is only a prediction.
        squared: normalised innovation squared of each window of arc length, shape (w,); nan where nothing is measured.
        disturbances: what the model does not know.
        hidden: part of the thread that no point shows, 0 to 1.
    """

    vertices: Points
    corrected: bool = False
    squared: Array = field(default_factory=_no_numbers)
    disturbances: tuple[Disturbance, ...] = ()
    hidden: float = 1.0

    @classmethod
    def of(cls, estimate: ThreadEstimate | None, prediction: Prediction) -> EstimatedThread:
        """Return what is kept of an estimate; without one the prediction stands for it."""
        if estimate is None:
            return cls(prediction.positions)
        squared = _no_numbers() if estimate.innovations is None else estimate.innovations.normalised_squared
        return cls(estimate.positions, estimate.corrected, squared, estimate.disturbances, estimate.hidden)


@dataclass(kw_only=True)
class FrameResult(Observation):
    """Predicted and estimated thread of one frame, with what was measured in it.

    Attributes:
        vertices: predicted thread, shape (n + 1, 2) [m].
        strain: greatest absolute strain of a segment.
        residual: of the solves.
        step_time: of the model [s].
        tension: greatest tension of a segment [N]; nan where no force is known.
        pull: of the thread upon the needle, shape (2,) [N]; shape (0,) where no force is known.
        margins: None if they prove nothing.
        obstacles: in force.
        errors: prediction error by target, `truth` and `seen` [% of length]; set when it is computed.
        estimate: of the thread; None where there is none.
    """

    vertices: Points = field(default_factory=_no_points)
    strain: float = math.nan
    residual: float = math.nan
    step_time: float = math.nan
    tension: float = math.nan
    pull: Array = field(default_factory=_no_numbers)
    margins: Margins | None = None
    obstacles: tuple[Obstacle, ...] = ()
    errors: dict[str, float] = field(default_factory=dict)
    estimate: EstimatedThread | None = None

    @classmethod
    def of(
        cls, observation: Observation, prediction: Prediction, margins: Margins | None, step_time: float
    ) -> FrameResult:
        """Return a prediction with the observation that it is of.

        Args:
            observation: with a needle.
            prediction: of it.
            margins: of the prediction, if they prove anything.
            step_time: that the prediction took [s].
        """
        forces = prediction.forces
        return cls(
            **vars(observation),
            vertices=prediction.positions,
            strain=float(np.abs(prediction.strain).max(initial=0.0)),
            residual=prediction.residual,
            step_time=step_time,
            tension=math.nan if forces is None else forces.peak_tension,
            pull=_no_numbers() if forces is None else np.asarray(forces.needle_force),
            margins=margins,
        )

    def target_curve(self, target: str) -> Points:
        """Return what the prediction is compared with, of `truth` and `seen`."""
        return self.ground_truth if target == "truth" else self.measured

    def columns(self) -> dict[str, float]:
        """Return the figures of the frame that need no other curve, by their columns' names."""
        row = {"strain": self.strain, "residual": self.residual, "step_time": self.step_time, "tension": self.tension}
        forces = {"pull": self.pull, "true_pull": self.true_pull}
        if len(self.pull) == len(self.true_pull):
            forces["pull_error"] = self.pull - self.true_pull
        row |= {name: math.hypot(*force) for name, force in forces.items() if len(force) == 2}
        if self.margins is not None:
            row |= {f"{MARGIN}{least.barrier}": float(least.clearance[0]) for least in self.margins.minima}
        if self.estimate is not None:
            known = self.estimate.squared[np.isfinite(self.estimate.squared)]
            row |= {"corrected": float(self.estimate.corrected), "innovations": len(known)}
            row["innovation_squared"] = float(known.mean()) if len(known) else math.nan
        return row

    @property
    def clearance(self) -> Array:
        """Minimum clearance of an obstacle or the wall for each node, shape (n + 1,) [m]; inf where none is near."""
        count = len(self.vertices)
        return np.full(count, np.inf) if self.margins is None else node_clearance(self.margins, count)


class TimeSeries:
    """Columns of numbers that grow by a row a frame, at 8 bytes a number.

    An hour at 30 frames a second is 0.9 MB a column; threads and pictures are not kept here. A column begins when it
    first has a value, and is nan before.
    """

    def __init__(self) -> None:
        self._times = array("d")
        self._columns: dict[str, array[float]] = {}

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._times)

    def add(self, time: float, values: Mapping[str, float]) -> None:
        """Add a row at a time since the bag's start [s]; a column that is not named is nan there."""
        for name in values:
            self._columns.setdefault(name, array("d", [math.nan]) * len(self))
        self._times.append(time)
        for name, column in self._columns.items():
            column.append(values.get(name, math.nan))

    @property
    def times(self) -> Array:
        """Return the time of each row [s]."""
        return np.array(self._times)

    def column(self, name: str) -> Array:
        """Return a column; nan throughout if nothing was added to it."""
        return np.array(self._columns[name]) if name in self._columns else np.full(len(self), math.nan)

    def known(self, name: str) -> Array:
        """Return the finite numbers of a column."""
        values = self.column(name)
        return values[np.isfinite(values)]


class WorstFrame(NamedTuple):
    """The frame in which the prediction is farthest from what it is compared with.

    Attributes:
        time: since the bag's start [s].
        error: of the prediction [% of length].
        frame: what was predicted, estimated, measured and true.
    """

    time: float
    error: float
    frame: FrameResult


def with_gaps(times: Array, values: Array) -> tuple[Array, Array]:
    """Return times and columns of values with a nan at both ends of each long gap, so that nothing is drawn over it.

    Args:
        times: shape (m,) [s].
        values: shape (..., m).
    """
    if len(times) < 3:
        return times, values
    steps = np.diff(times)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > SILENT_PERIODS * usual) + 1
    ends = np.column_stack([times[gaps - 1] + usual, times[gaps] - usual]).ravel()
    at = np.repeat(gaps, 2)
    return np.insert(times, at, ends), np.insert(values, at, np.nan, axis=-1)


class ErrorMap:
    """Accumulates the error along the thread: when it is full, neighbouring columns become one, with the greater error.

    Args:
        length: of the thread [m].
    """

    def __init__(self, length: float) -> None:
        self._length, self._limit = length, 600  # columns, at which it is full
        self._frames = 1  # of a column
        self._count = 0  # frames in all columns
        self._times: list[float] = []
        self._columns: list[Array] = []

    def add(self, time: float, errors: Array) -> None:
        """Add the errors of one frame's nodes, in % of the length."""
        if self._count == self._limit * self._frames:
            self._columns = [np.fmax(a, b) for a, b in zip(self._columns[::2], self._columns[1::2], strict=True)]
            self._times, self._frames = self._times[::2], 2 * self._frames
        if self._count % self._frames:
            self._columns[-1] = np.fmax(self._columns[-1], errors)
        else:
            self._times.append(time)
            self._columns.append(errors)
        self._count += 1

    def grid(self) -> tuple[Array, Array, Array] | None:
        """Return the greatest error by time and arc length, empty in each long gap; None if there is nothing.

        Returns:
            Times of the columns [s]; arc lengths of the rows, from the needle's tail on [m]; errors, shape
            (rows, columns) [% of the thread's length].
        """
        if not self._columns:
            return None
        times, errors = with_gaps(np.array(self._times), np.column_stack(self._columns))
        rows = errors.shape[0]
        return times, self._length * np.arange(1, rows + 1) / rows, errors


@dataclass(frozen=True)
class CurrentDifference:
    """Difference of the currents of a replay from the recorded ones, at the times of the replay's.

    In places the coils can give the same velocity in two ways, far apart, and change from one to the other
    within a hundredth of a second: the greatest differences are of such moments.

    Attributes:
        compared: how many replayed currents have a recorded one beside them.
        difference: of a coil, median [A].
        p99: 99th percentile [A].
        greatest: [A].
        recorded: root of the mean square of the recorded currents, to judge the difference by [A].
        stopped_apart: share of the compared of which one is a stop and the other is not.
    """

    compared: int
    difference: float
    p99: float
    greatest: float
    recorded: float
    stopped_apart: float


class CurrentSeries:
    """Currents over time, from messages in any order of arrival."""

    def __init__(self) -> None:
        self._received: dict[int, tuple[Array, bool]] = {}

    def add(self, message: Any) -> None:
        """Add a message CoilCurrents, of ROS or of the bags' type store."""
        stamp = nanoseconds(message.header.stamp)
        self._received[stamp] = np.asarray(message.current, dtype=np.float64), bool(message.stop)

    def against(self, recorded: CurrentSeries) -> CurrentDifference | None:
        """Compare with the currents in force when recorded; None where nothing can be."""
        stamps, replayed = np.array(sorted(recorded._received), np.int64), sorted(self._received)
        pairs = []
        for stamp, index in zip(replayed, np.searchsorted(stamps, replayed, side="right") - 1, strict=True):
            if index >= 0 and stamp - stamps[index] <= 50_000_000:  # ns, for which currents are in force
                now, then = self._received[stamp], recorded._received[int(stamps[index])]
                if now[0].shape == then[0].shape:
                    pairs.append((now, then))
        if not pairs:
            return None
        difference = np.abs([now[0] - then[0] for now, then in pairs])
        median, p99, greatest = np.percentile(difference, (50, 99, 100)).tolist()
        level = rms(np.array([then[0] for _, then in pairs]))
        stopped_apart = float(np.mean([now[1] != then[1] for now, then in pairs]))
        return CurrentDifference(len(pairs), median, p99, greatest, level, stopped_apart)


class GraphCollector:
    """Puts messages side by side by the stamp of the frame that they are about.

    Takes decoded messages, of ROS or of the bags' type store alike: only fields are read.

    Attributes:
        poses: frames in which the needle was found.
        applied: stamps of the commands that were followed, not stopped [ns].
        health: what each node reported last of itself.
    """

    def __init__(self) -> None:
        self._frames: dict[int, FrameResult] = {}
        self.poses = 0
        self.applied: set[int] = set()
        self.health: dict[str, str] = {}

    def add(self, topic: str, message: Any) -> None:
        """Add one message; topics that concern no frame are ignored, and a later message of a frame counts."""
        match topic:
            case interface.DIAGNOSTICS.recorded:
                self.health.update({status.name.split(":")[0]: status.message for status in message.status})
            case interface.CURRENTS.recorded if not message.stop:
                self.applied.add(nanoseconds(message.command))
            case interface.NEEDLE_POSE.recorded:
                self.poses += 1
            case interface.MEASURED_THREAD.recorded:
                self._of(message).measured = plane_points(stamped.pose.position for stamped in message.poses)
            case interface.GROUND_TRUTH_THREAD.recorded:
                self._of(message).ground_truth = plane_points(stamped.pose.position for stamped in message.poses)
            case interface.GROUND_TRUTH_PULL.recorded:
                self._of(message).true_pull = _in_plane(message.wrench.force)
            case interface.THREAD_OBSERVATION.recorded:
                try:
                    observation = thread_observation(message, interface.THREAD_OBSERVATION.name)
                except InvalidInputError:
                    observation = ThreadObservation()
                self._of(message).observation = observation
            case interface.ESTIMATED_THREAD.recorded:
                self._of(message).estimate = _estimate(message)
            case interface.MARGINS.recorded if message.valid:
                self._of(message).margins = margins_of(message)
            case interface.PREDICTED_THREAD.recorded:
                frame = self._of(message)
                frame.vertices = plane_points(message.positions)
                frame.strain = float(np.abs(np.asarray(message.strain)).max(initial=0.0))
                frame.residual, frame.step_time = message.residual, message.step_time
                if len(tension := getattr(message, "tension", ())):  # older bags have none
                    frame.tension, frame.pull = float(np.max(tension)), _in_plane(message.needle_force)

    def _of(self, message: Any) -> FrameResult:
        """Return the frame that a message is about."""
        stamp = nanoseconds(message.header.stamp)
        return self._frames.setdefault(stamp, FrameResult(stamp))

    def frames(self, first: int = 0, last: int | None = None) -> list[FrameResult]:
        """Return the frames with a prediction, by time; their errors are set by `RunMetrics`.

        Args:
            first: stamp of the first one [ns].
            last: stamp of the last one; of all if None.
        """
        last = max(self._frames, default=0) if last is None else last
        return [frame for at, frame in sorted(self._frames.items()) if len(frame.vertices) and first <= at <= last]


def _estimate(message: Any) -> EstimatedThread:
    disturbances = []
    for contact in message.disturbances:
        place, direction, since = contact.position, contact.direction, nanoseconds(contact.since) * 1e-9
        vectors, force = (_in_plane(place), _in_plane(direction)), (contact.force, contact.significance)
        disturbances.append(Disturbance(contact.arc_length, contact.extent, *vectors, *force, since))
    degrees, vertices = int(message.innovation_degrees), plane_points(message.positions)
    squared = np.full(degrees, message.innovation_squared / max(degrees, 1))
    return EstimatedThread(vertices, not message.prediction_only, squared, tuple(disturbances), message.hidden)


def _in_plane(vector: Any) -> Array:
    return np.array([vector.x, vector.y])


def rms(values: Array) -> float:
    """Return the root of the mean square; nan of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
