"""Frames of a run, measured and predicted, and what is kept of them: columns, error map, worst frames."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.estimator import Disturbance, SlowParameter, ThreadEstimate
from magnetosuture_thread.geometry.obstacles import Obstacle
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.margins import Margins, node_clearance
from magnetosuture_thread.thread.prediction import Prediction
from magnetosuture_thread.thread_observation import ThreadObservation

Array = NDArray[np.float64]

MIN_DISTANCE = 1.0  # s; between two of the worst frames
MARGIN = "margin_"  # columns of margins, by the barrier's name
BIN = 0.5  # s; of each bin the worst frame is kept
SILENT_PERIODS = 5.0  # usual intervals; a longer one without frames is a gap


def _no_points() -> Points:
    return np.empty((0, 2))


@dataclass(frozen=True)
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
    """

    stamp: int
    tail: Array = field(default_factory=lambda: np.empty(0))
    heading: Array = field(default_factory=lambda: np.empty(0))
    measured: Points = field(default_factory=_no_points)
    ground_truth: Points = field(default_factory=_no_points)
    reason: str = ""
    processing: float = math.nan
    observation: ThreadObservation | None = None
    deviation: tuple[float, float] = (0.0, 0.0)
    true_pull: Array = field(default_factory=lambda: np.empty(0))

    @property
    def found(self) -> bool:
        """Whether the needle was found."""
        return len(self.tail) > 0


@dataclass(frozen=True)
class EstimatedThread:
    """What is kept of a thread's estimate.

    Attributes:
        vertices: shape (n + 1, 2) [m].
        corrected: whether a measurement went into it; otherwise it is only a prediction.
        squared: normalised innovation squared of each window of arc length, shape (w,); nan where nothing is measured.
        disturbances: what the model does not know.
        hidden: part of the thread that no point shows, 0 to 1.
        learned: slow parameters, where any are learned.
    """

    vertices: Points
    corrected: bool = False
    squared: Array = field(default_factory=lambda: np.empty(0))
    disturbances: tuple[Disturbance, ...] = ()
    hidden: float = 1.0
    learned: tuple[SlowParameter, ...] = ()

    @classmethod
    def of(cls, estimate: ThreadEstimate) -> EstimatedThread:
        """Return what is kept of an estimate."""
        return cls(
            estimate.positions,
            estimate.corrected,
            np.empty(0) if estimate.innovations is None else estimate.innovations.normalised_squared,
            estimate.disturbances,
            estimate.hidden,
            estimate.slow_parameters,
        )


@dataclass
class FrameResult:
    """Predicted and estimated thread of one frame, beside the measured one and the ground truth.

    Attributes:
        stamp: of the frame [ns].
        vertices: predicted thread, shape (n + 1, 2) [m].
        strain: greatest absolute strain of a segment.
        residual: of the solves.
        step_time: of the model [s].
        tension: greatest tension of a segment [N]; nan where no force is known.
        pull: of the thread upon the needle, shape (2,) [N]; shape (0,) where no force is known.
        true_pull: the same by the ground truth, shape (2,) [N]; shape (0,) where the bag does not hold it.
        margins: None if they prove nothing.
        in_contact: whether the thread touches an obstacle or the wall.
        measured: the thread's centreline, shape (m, 2) [m].
        ground_truth: of the thread, if the bag holds it, shape (m, 2) [m].
        tail: the needle's measured tail, shape (2,) [m].
        heading: the needle's measured angle [rad].
        obstacles: in force.
        recorded: the prediction that the bag holds of the same frame, shape (n + 1, 2) [m].
        errors: prediction error by target, `truth` and `seen` [% of length]; set when it is computed.
        estimate: of the thread; None where there is none.
        observation: pieces of the thread that were measured; None where there is the centreline alone.
    """

    stamp: int
    vertices: Points = field(default_factory=_no_points)
    strain: float = math.nan
    residual: float = math.nan
    step_time: float = math.nan
    tension: float = math.nan
    pull: Array = field(default_factory=lambda: np.empty(0))
    margins: Margins | None = None
    in_contact: bool = False
    measured: Points = field(default_factory=_no_points)
    ground_truth: Points = field(default_factory=_no_points)
    tail: Points = field(default_factory=lambda: np.empty(0))
    heading: float = math.nan
    obstacles: tuple[Obstacle, ...] = ()
    recorded: Points | None = None
    errors: dict[str, float] = field(default_factory=dict)
    estimate: EstimatedThread | None = None
    observation: ThreadObservation | None = None
    true_pull: Array = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of(
        cls,
        observation: Observation,
        prediction: Prediction,
        margins: Margins | None,
        step_time: float,
        *,
        estimate: ThreadEstimate | None = None,
        estimated: bool = False,
        recorded: Points | None = None,
        obstacles: tuple[Obstacle, ...] = (),
    ) -> FrameResult:
        """Return a prediction beside the observation that it is of.

        Args:
            observation: with a needle.
            prediction: of it.
            margins: of the prediction, if they prove anything.
            step_time: that the prediction took [s].
            estimate: of the same frame.
            estimated: whether the thread is estimated in this run; without an estimate the prediction stands for it.
            recorded: the prediction of the same frame that the bag holds.
            obstacles: in force.
        """
        kept = EstimatedThread.of(estimate) if estimate is not None else None
        forces = prediction.forces
        return cls(
            stamp=observation.stamp,
            vertices=prediction.positions,
            strain=float(np.maximum.reduce(np.abs(prediction.strain), initial=0.0)),
            residual=prediction.residual,
            step_time=step_time,
            tension=math.nan if forces is None else forces.peak_tension,
            pull=np.empty(0) if forces is None else np.asarray(forces.needle_force),
            margins=margins,
            in_contact=margins is not None and bool(margins.in_contact),
            measured=observation.measured,
            ground_truth=observation.ground_truth,
            tail=observation.tail,
            heading=math.atan2(observation.heading[1], observation.heading[0]),
            obstacles=obstacles,
            recorded=recorded,
            estimate=EstimatedThread(prediction.positions) if kept is None and estimated else kept,
            observation=observation.observation,
            true_pull=observation.true_pull,
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

    An hour at 30 frames a second is 0.9 MB a column; threads and pictures are not kept here.

    Args:
        names: of the columns.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._times = array("d")
        self._columns = {name: array("d") for name in names}

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._times)

    def add(self, time: float, values: Mapping[str, float]) -> None:
        """Add a row; a column that is not named is nan there.

        Args:
            time: since the bag's start [s].
            values: by column; a column of a user's barrier (`MARGIN`) begins when it first has a value.

        Raises:
            KeyError: there is no such column.
        """
        for name in values.keys() - self._columns.keys():
            if not name.startswith(MARGIN):
                raise KeyError(f"no such columns: {name}")
            self._columns[name] = array("d", [math.nan] * len(self._times))
        self._times.append(time)
        for name, column in self._columns.items():
            column.append(values.get(name, math.nan))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self._columns)

    @property
    def times(self) -> Array:
        """Return the time of each row [s]."""
        return np.array(self._times)

    def column(self, name: str) -> Array:
        """Return a column."""
        return np.array(self._columns[name])

    def known(self, name: str) -> Array:
        """Return the finite numbers of a column; none of one that there is not."""
        values = np.array(self._columns.get(name, ()), dtype=np.float64)
        return values[np.isfinite(values)]


@dataclass(frozen=True)
class WorstFrame:
    """A frame in which the prediction, or the estimate, is far off.

    Attributes:
        time: since the bag's start [s].
        error: of it [% of length].
        frame: what was predicted, estimated, measured and true.
        of: `prediction` or `estimate`.
    """

    time: float
    error: float
    frame: FrameResult
    of: str = "prediction"


class WorstFrames:
    """Keeps the frames with the greatest errors, few of them however long the bag is.

    Args:
        count: of frames to find.
        apart: minimum time between two of them [s].
        of: whose errors are added, `prediction` or `estimate`.
    """

    def __init__(self, count: int = 5, apart: float = MIN_DISTANCE, of: str = "prediction") -> None:
        self._count, self._apart, self._of = count, apart, of
        # A frame takes out the bins within `apart` of it, on both sides: no more of the worst bins are needed.
        self._enough = count * (2 * math.ceil(apart / BIN) + 3)
        self._bins: dict[int, WorstFrame] = {}

    def add(self, time: float, error: float, frame: FrameResult) -> None:
        """Add one frame; one without an error is passed over."""
        bin_ = math.floor(time / BIN)
        held = self._bins.get(bin_)
        if not math.isfinite(error) or (held is not None and held.error >= error):
            return
        self._bins[bin_] = WorstFrame(time, error, frame, self._of)
        if len(self._bins) > self._enough + 1:  # the bin that is being filled stays
            del self._bins[min(self._bins.keys() - {bin_}, key=lambda other: self._bins[other].error)]

    def found(self) -> list[WorstFrame]:
        """Return the worst frames, the worst first."""
        chosen: list[WorstFrame] = []
        for worst in sorted(self._bins.values(), key=lambda worst: (-worst.error, worst.time)):
            if all(abs(worst.time - other.time) >= self._apart for other in chosen):
                chosen.append(worst)
        return chosen[: self._count]


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
        columns: of the map.
    """

    def __init__(self, length: float, columns: int = 300) -> None:
        self._length, self._limit = length, 2 * columns
        self._frames = 1  # of a column
        self._filled = 0  # frames in the last column
        self._times: list[float] = []
        self._columns: list[Array] = []

    def add(self, time: float, errors: Array) -> None:
        """Add the errors of one frame's nodes, in % of the length."""
        if not np.isfinite(errors).any():
            return
        if self._columns and self._filled < self._frames:
            self._columns[-1] = np.fmax(self._columns[-1], errors)
            self._filled += 1
            return
        if len(self._columns) == self._limit:
            self._columns = [np.fmax(a, b) for a, b in zip(self._columns[::2], self._columns[1::2], strict=True)]
            self._times = self._times[::2]
            self._frames *= 2
        self._times.append(time)
        self._columns.append(errors)
        self._filled = 1

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
