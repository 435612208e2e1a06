"""Errors and margin statistics of predicted threads, for evaluation, replay, closed loop, calibration and the rig."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magnetosuture_thread.barrier import BUILT_IN
from magnetosuture_thread.estimator import SlowParameter
from magnetosuture_thread.evaluation.estimation import (
    ESTIMATE_COLUMNS,
    DisturbanceLog,
    EstimationFigures,
    hidden_part,
)
from magnetosuture_thread.evaluation.frames import (
    MARGIN,
    MIN_DISTANCE,
    SILENT_PERIODS,
    WORST_ESTIMATES,
    Array,
    ErrorMap,
    FrameResult,
    Observation,
    TimeSeries,
    WorstFrame,
    WorstFrames,
)
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.interface import CAMERA, CURRENTS, NEEDLE_COMMAND, NEEDLE_POSE, PREDICTED_THREAD
from magnetosuture_thread.thread.margins import Margins

TARGETS = ("truth", "seen")  # what a prediction is compared with, the better one first
KINDS = {"prediction": "", "estimate": "estimate_"}  # of threads, and how the columns of their errors begin
COLUMNS = ("strain", "residual", "step_time", "tension", "pull", "true_pull", "pull_error", "seen_share")
MIN_KNOWN_SHARE = 0.5  # of the thread's length must be known, or there is no error
END_TOLERANCE = 1e-3  # of the length; the chords of a curve are always a little short, and its free end counts
MAX_REASONS = 12  # kept, why the needle was not found
CLOCK_TOLERANCE = 1.0  # s; stamps farther outside of the bag are of another clock


@dataclass(frozen=True)
class Percentiles:
    """Median, 99th percentile and maximum of a set of values."""

    median: float
    p99: float
    maximum: float

    @classmethod
    def of(cls, values: ArrayLike) -> Percentiles | None:
        """Return the percentiles of the finite values, or None if there are none."""
        given = np.asarray(values, dtype=np.float64)
        kept = given[np.isfinite(given)]
        if not len(kept):
            return None
        return cls(float(np.median(kept)), float(np.percentile(kept, 99)), float(kept.max()))


def finite_or_none(value: Any) -> Any:
    """Return None for a number that is not finite, anything else as it is: what goes into JSON."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def error_figures(errors: ArrayLike) -> dict[str, float] | None:
    """Return count, mean, median, p99 and maximum of errors in %; None if there are none."""
    given = np.asarray(errors, dtype=np.float64)
    percentiles = Percentiles.of(given)
    if percentiles is None:
        return None
    return {"count": int(np.isfinite(given).sum()), "mean": float(np.nanmean(given)), **asdict(percentiles)}


def stage_latencies(
    published: Mapping[str, Mapping[int, float]], arrived: Mapping[str, Mapping[int, float]], applied: Set[int]
) -> dict[str, Percentiles | None]:
    """Return the latency of each stage of the graph [s].

    Args:
        published: of each input topic, when the message of a stamp was published [s].
        arrived: of each output topic, when the first message of a stamp arrived [s].
        applied: stamps of the commands that were followed; the watchdog's zeros answer no command.
    """
    camera = {stamp: at for channel in CAMERA.values() for stamp, at in published.get(channel.name, {}).items()}
    commands = {stamp: at for stamp, at in published.get(NEEDLE_COMMAND.name, {}).items() if stamp in applied}
    poses, predictions = arrived.get(NEEDLE_POSE.name, {}), arrived.get(PREDICTED_THREAD.name, {})
    stages: dict[str, tuple[Mapping[int, float], Mapping[int, float]]] = {
        "frame to needle pose": (camera, poses),
        "pose to prediction": (poses, predictions),
        "frame to prediction": (camera, predictions),
        "command to currents": (commands, arrived.get(CURRENTS.name, {})),
    }
    return {
        stage: Percentiles.of([after[stamp] - before[stamp] for stamp in after if stamp in before])
        for stage, (before, after) in stages.items()
    }


def target_points(curves: Sequence[Points], length: float, segments: int) -> tuple[Array, Array]:
    """Return where the nodes should be, by curves that start at the needle's tail.

        X(s_i),    s_i = i L / n,    i = 1 ... n

    Args:
        curves: centreline of each frame, shape (m, 2) [m]; m may differ, and be 0.
        length: of the thread, L [m].
        segments: n.

    Returns:
        X, shape (b, n, 2) [m], nan past the end of a curve by more than 0.1 % of L; and the curves' lengths, shape
        (b,) [m]. A node that is less past the end counts as at the end.
    """
    points, lengths = np.full((len(curves), segments, 2), np.nan), np.zeros(len(curves))
    at = length * np.arange(1, segments + 1) / segments
    for index, curve in enumerate(curves):
        if len(curve) < 2 or not np.isfinite(curve).all():
            continue
        arc = arc_lengths(curve)
        lengths[index] = arc[-1]
        known = at <= arc[-1] + END_TOLERANCE * length
        for axis in (0, 1):
            points[index, known, axis] = np.interp(at[known], arc, curve[:, axis])
    return points, lengths


def node_errors(vertices: Points, targets: Points, length: float) -> Array:
    """Return how far each node is from where it should be, in % of the thread's length.

        e_i = 100 |x_i - X(s_i)| / L,    i = 1 ... n

    Args:
        vertices: predicted nodes, shape (..., n + 1, 2) [m].
        targets: X of each but the first, shape (..., n, 2) [m]; see `target_points`.
        length: L [m].

    Returns:
        Shape (..., n); nan where X is not known.
    """
    offset = vertices[..., 1:, :] - targets
    return np.asarray(100.0 / length * np.hypot(offset[..., 0], offset[..., 1]))


def mean_over_nodes(errors: Array, known: NDArray[np.bool_]) -> Array:
    """Return the mean over the last axis of errors that are known; nan where none is."""
    count = known.sum(axis=-1)
    total = np.where(known, errors, 0.0).sum(axis=-1)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def prediction_error_percent(vertices: Points, curve: Points, length: float) -> float:
    """Return how far a prediction is from a thread, in % of the thread's length.

        error = mean over i = 1 ... n of e_i,    e_i as in `node_errors`

    Nodes past the end of the curve, where the camera lost the thread, are left out.

    Args:
        vertices: predicted nodes, shape (n + 1, 2) [m].
        curve: where the thread was, shape (m, 2) [m].
        length: L [m].

    Returns:
        The error; nan where less than half of the thread is known.

    Source: reference set, "How a prediction is scored". Deviation: none where the curve is whole.
    """
    targets, lengths = target_points([curve], length, len(vertices) - 1)
    return _mean_error(node_errors(vertices, targets[0], length), targets[0], float(lengths[0]) / length)


def _mean_error(errors: Array, targets: Array, share: float) -> float:
    """Return the mean error of the nodes that have a target; nan where too small a share of the length is known."""
    return float(mean_over_nodes(errors, np.isfinite(targets[:, 0]))) if share >= MIN_KNOWN_SHARE else math.nan


@dataclass(frozen=True)
class SensorSilence:
    """Time without frames, or recorded poses: gaps of more than `SILENT_PERIODS` usual intervals.

    Attributes:
        gaps: how many.
        total: of all gaps [s].
        max_gap: the longest gap [s].
        at: when the longest gap begins, since the bag's start [s]; nan for none.
    """

    gaps: int = 0
    total: float = 0.0
    max_gap: float = 0.0
    at: float = math.nan

    @classmethod
    def of(cls, times: Array, begin: float, end: float) -> SensorSilence:
        """Return the gaps between frames, and before the first and after the last, where they are of one clock.

        Args:
            times: of the frames, since the bag's start [s].
            begin: of what is evaluated [s].
            end: of it [s].
        """
        times = np.sort(times)
        if len(times) < 2:  # no interval is usual
            return cls(1, end - begin, end - begin, begin) if end > begin else cls()
        within = begin - CLOCK_TOLERANCE <= times[0] and times[-1] <= end + CLOCK_TOLERANCE
        edges = np.concatenate([[begin], times, [end]]) if within else times
        steps = np.diff(edges)
        gaps = steps[steps > SILENT_PERIODS * float(np.median(np.diff(times)))]
        if not len(gaps):
            return cls()
        longest = int(np.argmax(steps))
        return cls(len(gaps), float(gaps.sum()), float(steps[longest]), float(edges[longest]))


@dataclass(frozen=True)
class MinimumMargin:
    """The minimum margin of one barrier, and where it was.

    Attributes:
        kind: name of the barrier.
        clearance: as a distance [m].
        value: least h of all rows at all times, which may be another row's, in the unit of its barrier.
        node: index.
        obstacle: index, -1 where there is none.
        time: since the bag's start [s].
    """

    kind: str
    clearance: float
    value: float
    node: int
    obstacle: int
    time: float


class RunMetrics:
    """Accumulates errors, margins and times of a run.

    Of each frame only numbers are kept, and of a few frames the threads: memory grows by 210 bytes a frame.

    Args:
        length: of the thread [m].
        start: time that is 0 in the figures [ns].
        targets: what the predictions are compared with, of `truth` and `seen`.
        recorded: whether the predictions that the bag itself holds are compared too.

    Attributes:
        targets: as given, the better one first.
        observed: column `processing` of all frames [s].
        tracked: frames with a needle.
        lost: from and to when the needle was not found [s].
        reasons: why not.
        contact_frames: those in which the thread touches an obstacle or the wall.
        disturbances: that the estimate reported.
        learned: slow parameters of the last estimate that has any.
        series: columns of all frames with a prediction, by time.
    """

    def __init__(
        self, length: float, start: int = 0, targets: Iterable[str] = TARGETS, *, recorded: bool = False
    ) -> None:
        self.targets = tuple(target for target in TARGETS if target in targets)
        errors = [f"error_{target}" for target in self.targets]
        kinds = ["", "estimate_", "max_node_", "max_node_estimate_", *(["recorded_"] if recorded else [])]
        margins = [f"{MARGIN}{barrier}" for barrier in BUILT_IN]
        names = [f"{kind}{name}" for kind in kinds for name in errors]
        self.series = TimeSeries([*names, *margins, *COLUMNS, *ESTIMATE_COLUMNS])
        self.observed = TimeSeries(["processing"])
        self.tracked = self.contact_frames = 0
        self.lost: list[list[float]] = []
        self.reasons: Counter[str] = Counter()
        self._found = True
        self._length, self._start = length, start
        self._minimum: dict[str, MinimumMargin] = {}
        self._maps = {(kind, target): ErrorMap(length) for kind in KINDS for target in self.targets}
        self._worst = {(kind, target): WorstFrames(of=kind) for kind in KINDS for target in self.targets}
        self.disturbances = DisturbanceLog()
        self.learned: tuple[SlowParameter, ...] = ()
        self._first: FrameResult | None = None

    def observe(self, observation: Observation) -> None:
        """Count a frame, or a recorded pose, and whether its needle was found."""
        time = self._time(observation.stamp)
        self.observed.add(time, {"processing": observation.processing})
        self.tracked += observation.found
        if not observation.found:
            reason = observation.reason or "not said"
            known = observation.reason in self.reasons or len(self.reasons) < MAX_REASONS
            self.reasons[reason if known else "others"] += 1
            if self._found:
                self.lost.append([time, time])
            self.lost[-1][1] = time
        self._found = observation.found

    def add(self, frame: FrameResult) -> None:
        """Add the prediction of a frame, and set its errors."""
        time = self._time(frame.stamp)
        self._first = self._first or frame
        if frame.margins is not None:
            self.contact_frames += frame.in_contact
            self._lower(time, frame.margins)
        self.disturbances.add(time, frame)
        if frame.estimate is not None and frame.estimate.learned:
            self.learned = frame.estimate.learned
        columns = frame.columns() | {"hidden": hidden_part(frame, self._length)} | self._compare(time, frame)
        self.series.add(time, columns)

    def _lower(self, time: float, margins: Margins) -> None:
        """Lower the minimum of each barrier to that of a frame."""
        for row in margins.minima:
            held, value = self._minimum.get(row.barrier), margins[row.barrier].minimum
            if held is None or row.clearance[0] < held.clearance:
                value = value if held is None else min(value, held.value)
                place = int(row.node[0]), int(row.obstacle[0]), time
                self._minimum[row.barrier] = MinimumMargin(row.barrier, float(row.clearance[0]), value, *place)
            elif value < held.value:
                self._minimum[row.barrier] = replace(held, value=value)

    def _compare(self, time: float, frame: FrameResult) -> dict[str, float]:
        """Return the columns of a frame's errors."""
        row: dict[str, float] = {}
        threads = {"prediction": frame.vertices}
        if frame.estimate is not None and frame.estimate.vertices.shape == frame.vertices.shape:
            threads["estimate"] = frame.estimate.vertices
        for target in TARGETS:
            curve = frame.target_curve(target)
            points, lengths = target_points([curve], self._length, len(frame.vertices) - 1)
            share = float(lengths[0]) / self._length
            if target == "seen":
                row["seen_share"] = min(1.0, share)
            if target not in self.targets:
                continue
            for kind, vertices in threads.items():
                errors = node_errors(vertices, points[0], self._length)
                mean, column = _mean_error(errors, points[0], share), f"{KINDS[kind]}error_{target}"
                row[column] = mean
                if math.isfinite(mean):
                    row[f"max_node_{column}"] = float(np.nanmax(errors))
                    self._maps[kind, target].add(time, errors)
                    self._worst[kind, target].add(time, mean, frame)
            frame.errors[target] = row[f"error_{target}"]
            if frame.recorded is not None:
                row[f"recorded_error_{target}"] = prediction_error_percent(frame.recorded, curve, self._length)
        return row

    @property
    def minimum_margins(self) -> dict[str, MinimumMargin]:
        """The minimum margin of each barrier that was there, the built-in ones first."""
        names = [name for name in BUILT_IN if name in self._minimum]
        return {name: self._minimum[name] for name in [*names, *sorted(self._minimum.keys() - set(names))]}

    @property
    def target(self) -> str:
        """What error map and worst frames are compared with: the truth where there is any; empty for nothing."""
        return next((target for target in self.targets if self.series.has(f"error_{target}")), "")

    @property
    def error_map(self) -> ErrorMap | None:
        """The map of the prediction's error along the thread."""
        return self._maps.get(("prediction", self.target))

    @property
    def estimate_map(self) -> ErrorMap | None:
        """The map of the estimate's error along the thread."""
        return self._maps.get(("estimate", self.target))

    def worst_frames(self) -> list[WorstFrame]:
        """Return the frames with the greatest errors of prediction, then of estimate, each time the worst first."""
        if not self.target:
            return []
        found, others = (self._worst[kind, self.target].found() for kind in KINDS)
        apart = [each for each in others if all(abs(each.time - one.time) >= MIN_DISTANCE for one in found)]
        return found + apart[:WORST_ESTIMATES]

    @property
    def worst_measured(self) -> FrameResult | None:
        """The frame farthest from what was measured; where nothing was, from the truth, else the first one."""
        worst = [each for target in reversed(self.targets) for each in self._worst["prediction", target].found()[:1]]
        return worst[0].frame if worst else self._first

    def errors(self, prefix: str = "error") -> dict[str, dict[str, float] | None]:
        """Return the figures of the columns `PREFIX_TARGET` that there are, by target; see `error_figures`."""
        columns = {target: f"{prefix}_{target}" for target in self.targets}
        return {
            target: error_figures(self.series.column(name))
            for target, name in columns.items()
            if name in self.series.names
        }

    @property
    def estimation(self) -> EstimationFigures:
        """What the run tells of its estimate beside the errors."""
        return EstimationFigures.of(self.series, self.disturbances, self.learned)

    def percentiles(self, column: str) -> Percentiles | None:
        """Return the percentiles of a column."""
        return Percentiles.of(self.series.column(column))

    def maximum(self, column: str) -> float:
        """Return the greatest value of a column; nan if there is none."""
        return float(np.nanmax(self.series.column(column))) if self.series.has(column) else math.nan

    def mean(self, column: str) -> float:
        """Return the mean of a column; nan if there is none."""
        return float(np.nanmean(self.series.column(column))) if self.series.has(column) else math.nan

    @property
    def pull_error_percent(self) -> float:
        """Root mean square of the predicted pull upon the needle less the true one, in % of the true pull's peak.

        Over the frames with both; nan where there are none, or where nothing pulls.
        """
        peak = self.maximum("true_pull")
        if not (self.series.has("pull_error") and peak > 0.0):
            return math.nan
        return 100.0 * float(np.sqrt(np.nanmean(self.series.column("pull_error") ** 2))) / peak

    def _time(self, stamp: int) -> float:
        return (stamp - self._start) * 1e-9
