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
from magnetosuture_thread.evaluation import pull
from magnetosuture_thread.evaluation.error_map import ErrorMap
from magnetosuture_thread.evaluation.estimation import (
    ESTIMATE_COLUMNS,
    DisturbanceLog,
    EstimationFigures,
    hidden_part,
)
from magnetosuture_thread.evaluation.frames import (
    MARGIN,
    MIN_DISTANCE,
    WORST_ESTIMATES,
    Array,
    FrameResult,
    Observation,
    TimeSeries,
    WorstFrame,
    WorstFrames,
    estimated_nodes,
)
from magnetosuture_thread.evaluation.silence import SensorSilence as SensorSilence
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import CAMERA, CURRENTS, NEEDLE_COMMAND, NEEDLE_POSE, PREDICTED_THREAD
from magnetosuture_thread.model.estimator import SlowParameter

TARGETS = ("truth", "seen")  # what a prediction is compared with, the better one first
KINDS = {"prediction": "", "estimate": "estimate_"}  # of threads, and how the columns of their errors begin
MIN_KNOWN_SHARE = 0.5  # of the thread's length must be known, or there is no error
END_TOLERANCE = 1e-3  # of the length; the chords of a curve are always a little short, and its free end counts
BATCH = 128  # frames that are compared together
MAX_REASONS = 12  # kept, why the needle was not found


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
    known = np.array([len(curve) > 1 and bool(np.isfinite(curve).all()) for curve in curves], dtype=bool)
    points, lengths = np.full((len(curves), segments, 2), np.nan), np.zeros(len(curves))
    there = np.flatnonzero(known)
    if not len(there):
        return points, lengths
    # All curves are laid one behind the other, so that one interpolation serves them all.
    shown = [curve for curve, is_known in zip(curves, known.tolist(), strict=True) if is_known]
    counts, vertices = np.array([len(curve) for curve in shown]), np.concatenate(shown)
    last = np.cumsum(counts) - 1
    steps = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
    steps[last[:-1]] = length  # a gap between one curve and the next
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    begins, ends = arc[last - counts + 1], arc[last]
    lengths[there] = ends - begins
    at = length * np.arange(1, segments + 1) / segments
    wanted = np.minimum(begins[:, None] + at, ends[:, None])
    within = at <= lengths[there, None] + END_TOLERANCE * length
    for axis in (0, 1):
        points[there, :, axis] = np.where(within, np.interp(wanted, arc, vertices[:, axis]), np.nan)
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


def prediction_errors(vertices: Points, curves: Sequence[Points], length: float) -> tuple[Array, Array, Array]:
    """Return how far predictions are from threads, in % of the thread's length.

        error = mean over i = 1 ... n of e_i,    e_i as in `node_errors`

    Nodes past the end of a curve, where the camera lost the thread, are left out.

    Args:
        vertices: predicted nodes of each frame, shape (b, n + 1, 2) [m].
        curves: where the thread was in each, shape (m, 2) [m].
        length: L [m].

    Returns:
        The errors, shape (b,), nan where less than half of a thread is known; e_i, shape (b, n); and the known part
        of each thread, 0 to 1, shape (b,).

    Source: reference set, "How a prediction is scored". Deviation: none where the curve is whole.
    """
    targets, lengths = target_points(curves, length, vertices.shape[1] - 1)
    errors = node_errors(vertices, targets, length)
    mean = mean_over_nodes(errors, np.isfinite(targets[..., 0]))
    mean = np.where(lengths >= MIN_KNOWN_SHARE * length, mean, np.nan)
    return mean, errors, np.minimum(1.0, lengths / length)


def prediction_error_percent(vertices: Points, curve: Points, length: float) -> float:
    """Return how far one prediction is from a thread; see `prediction_errors`."""
    return float(prediction_errors(vertices[None], [curve], length)[0][0])


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
    """

    def __init__(
        self, length: float, start: int = 0, targets: Iterable[str] = TARGETS, *, recorded: bool = False
    ) -> None:
        self.targets = tuple(target for target in TARGETS if target in targets)
        errors = [f"error_{target}" for target in self.targets]
        of_bag = [f"recorded_{name}" for name in errors] if recorded else []
        margins = [f"{MARGIN}{barrier}" for barrier in BUILT_IN]
        others = ["strain", "residual", "step_time", "tension", *pull.COLUMNS, "seen_share", *ESTIMATE_COLUMNS]
        of_estimate = [f"{kind}_{name}" for kind in ("estimate", "max_node", "max_node_estimate") for name in errors]
        self._series = TimeSeries([*errors, *of_estimate, *of_bag, *margins, *others])
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
        self._fresh: list[FrameResult] = []
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
        """Add the prediction of a frame; its errors are set when they are computed."""
        if frame.margins is not None:
            for row in frame.margins.minima:
                held, value = self._minimum.get(row.barrier), frame.margins[row.barrier].minimum
                if held is None or row.clearance[0] < held.clearance:
                    place = int(row.node[0]), int(row.obstacle[0]), self._time(frame.stamp)
                    value = value if held is None else min(value, held.value)
                    self._minimum[row.barrier] = MinimumMargin(row.barrier, float(row.clearance[0]), value, *place)
                elif value < held.value:
                    self._minimum[row.barrier] = replace(held, value=value)
            self.contact_frames += frame.in_contact
        self.disturbances.add(self._time(frame.stamp), frame)
        if frame.estimate is not None and frame.estimate.learned:
            self.learned = frame.estimate.learned
        if self._fresh and len(frame.vertices) != len(self._fresh[0].vertices):  # the model's segments have changed
            self.compare()
        self._fresh.append(frame)
        if len(self._fresh) >= BATCH:
            self.compare()

    @property
    def series(self) -> TimeSeries:
        """Columns of all frames with a prediction, by time."""
        self.compare()
        return self._series

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
        self.compare()
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

    def compare(self) -> None:
        """Compare the frames that have come with their targets, and keep of them only numbers."""
        frames, self._fresh = self._fresh, []
        if not frames:
            return
        self._first = self._first or frames[0]
        threads = {"prediction": np.stack([frame.vertices for frame in frames]), "estimate": estimated_nodes(frames)}
        rows = [frame.columns() | {"hidden": hidden_part(frame, self._length)} for frame in frames]
        for target in TARGETS:
            curves = [frame.target_curve(target) for frame in frames]
            compared = {kind: prediction_errors(nodes, curves, self._length) for kind, nodes in threads.items()}
            for index, (frame, row) in enumerate(zip(frames, rows, strict=True)):
                if target == "seen":
                    row["seen_share"] = float(compared["prediction"][2][index])
                if target not in self.targets:
                    continue
                for kind, (means, errors, _) in compared.items():
                    mean, time, column = float(means[index]), self._time(frame.stamp), f"{KINDS[kind]}error_{target}"
                    row[column] = mean
                    if math.isfinite(mean):
                        row[f"max_node_{column}"] = float(np.nanmax(errors[index]))
                        self._maps[kind, target].add(time, errors[index].copy())
                        self._worst[kind, target].add(time, mean, frame)
                frame.errors[target] = row[f"error_{target}"]
                if frame.recorded is not None:
                    error = prediction_error_percent(frame.recorded, curves[index], self._length)
                    row[f"recorded_error_{target}"] = error
        for frame, row in zip(frames, rows, strict=True):
            self._series.add(self._time(frame.stamp), row)

    def _time(self, stamp: int) -> float:
        return (stamp - self._start) * 1e-9
