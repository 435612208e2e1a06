"""Errors, margins and times of predicted threads; consistency, hidden parts and disturbances of their estimates."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Set
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from magnetosuture_thread.evaluation import frames
from magnetosuture_thread.evaluation.frames import Array, ErrorMap, FrameResult, TimeSeries, WorstFrame
from magnetosuture_thread.geometry.barrier import BUILT_IN
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.settings.interface import CAMERA, CURRENTS, NEEDLE_COMMAND, NEEDLE_POSE, PREDICTED_THREAD
from magnetosuture_thread.thread.margins import SOLID, BarrierMargins

TARGETS = ("truth", "seen")  # what a prediction is compared with, the better one first
KINDS = {"prediction": "", "estimate": "estimate_"}  # of threads, and how the columns of their errors begin
MIN_KNOWN_SHARE = 0.5  # of the thread's length must be known, or there is no error


@dataclass(frozen=True)
class Percentiles:
    """Median, 99th percentile and maximum of a set of values."""

    median: float
    p99: float
    maximum: float

    @classmethod
    def of(cls, values: ArrayLike) -> Percentiles | None:
        """Return the percentiles of the finite values, or None if there are none."""
        numbers = np.asarray(values, dtype=np.float64)
        finite = numbers[np.isfinite(numbers)]
        return cls(*np.percentile(finite, (50, 99, 100)).tolist()) if len(finite) else None


def finite_or_none(value: Any) -> Any:
    """Return None for a number that is not finite, anything else as it is: what goes into JSON."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plain_values(figures: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as they go into JSON, see `finite_or_none`."""
    return {key: finite_or_none(value) for key, value in asdict(figures).items()}


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
    poses, predictions, currents = (arrived.get(c.name, {}) for c in (NEEDLE_POSE, PREDICTED_THREAD, CURRENTS))
    stages: dict[str, tuple[Mapping[int, float], Mapping[int, float]]] = {
        "frame to needle pose": (camera, poses),
        "pose to prediction": (poses, predictions),
        "frame to prediction": (camera, predictions),
        "command to currents": (commands, currents),
    }
    return {
        stage: Percentiles.of([after[stamp] - before[stamp] for stamp in after if stamp in before])
        for stage, (before, after) in stages.items()
    }


def target_points(curve: Points, length: float, segments: int) -> tuple[Array, float]:
    """Return where the nodes should be, by a curve that starts at the needle's tail.

        X(s_i),    s_i = i L / n,    i = 1 ... n

    Args:
        curve: centreline, shape (m, 2) [m]; m may be 0.
        length: of the thread, L [m].
        segments: n.

    Returns:
        X, shape (n, 2) [m], nan past the end of the curve by more than 0.1 % of L; and the curve's length [m]. A node
        that is less past the end counts as at the end.
    """
    points = np.full((segments, 2), np.nan)
    if len(curve) < 2 or not np.isfinite(curve).all():
        return points, 0.0
    arc, at = arc_lengths(curve), length * np.arange(1, segments + 1) / segments
    known = at <= arc[-1] + 1e-3 * length  # the chords of a curve are a little short, and its free end counts
    points[known] = np.column_stack([np.interp(at[known], arc, axis) for axis in curve.T])
    return points, float(arc[-1])


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
    return np.asarray(100.0 / length * np.linalg.norm(vertices[..., 1:, :] - targets, axis=-1))


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
    if len(vertices) < 2:
        return math.nan
    targets, known = target_points(curve, length, len(vertices) - 1)
    if known < MIN_KNOWN_SHARE * length:
        return math.nan
    return float(node_errors(vertices, targets, length)[np.isfinite(targets[:, 0])].mean())


@dataclass(frozen=True)
class SensorSilence:
    """Time without frames, or recorded poses: gaps of more than `frames.SILENT_PERIODS` usual intervals.

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

    def __str__(self) -> str:
        """Return the gaps in words; empty if there are none."""
        longest = f"{self.max_gap:.1f} s at the longest, from {self.at:.2f} s on"
        return f"without frames for {self.total:.1f} s, {longest}" if self.gaps else ""

    @classmethod
    def of(cls, times: Array, begin: float, end: float) -> SensorSilence:
        """Return the gaps between frames, and before the first and after the last.

        Frames that are not within what is evaluated are of another clock, as of a camera that stamped one with 0; where
        most are, only the gaps between them tell anything.

        Args:
            times: of the frames, since the bag's start [s].
            begin: of what is evaluated [s].
            end: of it [s].
        """
        times = np.sort(times)
        if len(times) < 2:  # no interval is usual
            return cls(1, end - begin, end - begin, begin) if end > begin else cls()
        within = times[(times >= begin - 1.0) & (times <= end + 1.0)]
        times = within if 2 * len(within) > len(times) else times
        edges = np.concatenate([[begin], times, [end]]) if times is within else times
        steps = np.diff(edges)
        gaps = steps[steps > frames.SILENT_PERIODS * float(np.median(np.diff(times)))]
        if not len(gaps):
            return cls()
        longest = int(np.argmax(steps))
        return cls(len(gaps), float(gaps.sum()), float(steps[longest]), float(edges[longest]))


@dataclass(frozen=True)
class MinimumMargin:
    """The minimum margin of one barrier, and where it was.

    Attributes:
        kind: name of the barrier.
        clearance: least distance of all rows at all times [m].
        value: least h of them, which may be another row's, in the unit of its barrier.
        node: index, of the row that `promised` is of.
        obstacle: index, the same; -1 where there is none.
        time: since the bag's start [s], the same.
    """

    kind: str
    clearance: float
    value: float
    node: int
    obstacle: int
    time: float

    @property
    def promised(self) -> float:
        """Margin that is kept at 0 or more [m]: beside a shape or the wall h of the nodes, else the clearance."""
        return self.value if self.kind in SOLID else self.clearance

    @property
    def chord(self) -> float | None:
        """Clearance of the deepest chord between two nodes, if it lies in a shape, as on a round one [m]; or None."""
        return self.clearance if self.clearance < min(0.0, self.promised) - 1e-9 else None


def hidden_part(frame: FrameResult, length: float) -> float:
    """Return the part of the thread that a frame's measurement does not show, 0 to 1.

    All of it is hidden where nothing was measured, or where no measurement went into the frame's estimate. Nothing is
    where the observation is complete. A centreline alone, or pieces, show as much as they are long; where neither was
    kept, it is what the estimate says.

    Args:
        frame: with what was measured in it.
        length: of the thread [m].
    """
    observation, estimate = frame.observation, frame.estimate
    if estimate is not None and not estimate.corrected:
        return 1.0
    if observation is not None and observation.complete:
        return 0.0
    if observation is None and estimate is not None and not len(frame.measured):
        return estimate.hidden
    pieces = [frame.measured] if observation is None else [piece.points for piece in observation.pieces]
    pieces = [points[np.isfinite(points).all(axis=1)] for points in pieces]
    measured = sum(float(arc_lengths(points)[-1]) for points in pieces if len(points) > 1)
    return max(0.0, 1.0 - measured / length)


@dataclass(frozen=True)
class HiddenShares:
    """Hidden shares of thread and time. Each frame counts for the time until the next one.

    Attributes:
        hidden_time_share: of the time, with a part of the thread hidden: more than 3 % of its length; None without
            estimates, as the others.
        all_hidden_time_share: of the time, with all of it hidden: the estimate is a prediction only.
        hidden_length_share: part of the length that was hidden, mean over the time.
    """

    hidden_time_share: float | None = None
    all_hidden_time_share: float | None = None
    hidden_length_share: float | None = None

    @classmethod
    def of(cls, series: TimeSeries) -> HiddenShares:
        """Return the shares."""
        hidden, corrected = series.column("hidden"), series.column("corrected")
        known = np.isfinite(hidden) & np.isfinite(corrected)
        if not known.any():
            return cls()
        steps = np.diff(series.times)
        usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
        durations = np.append(steps, usual)  # the usual interval for the last one, and before a gap
        durations = np.where((durations > 0.0) & (durations <= frames.SILENT_PERIODS * usual), durations, usual)
        shares = np.array([hidden > 0.03, corrected == 0.0, hidden])[:, known]
        return cls(*np.average(shares, axis=1, weights=durations[known]).tolist())


def mean_band(count: Array) -> tuple[Array, Array]:
    """Return between what 95 % of the means of so many squared standard normal values are.

        chi2_N^{-1}(0.025) / N,    chi2_N^{-1}(0.975) / N

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
    5.4. Deviation: none.
    """
    return np.asarray(chdtri(count, 0.975) / count), np.asarray(chdtri(count, 0.025) / count)


@dataclass(frozen=True)
class Consistency:
    """Normalised innovations squared in equal windows of 5 s or more, and the band of 95 % of such means.

    Innovations are what the camera says against the prediction from the last estimate, for sixteen parts of the
    thread's length; each is divided by the standard deviation that the filter expects of it. A mean of 1 says that the
    filter knows how wrong it is; one above the band that it trusts itself too much.

    Attributes:
        normalised_innovation_squared_mean: of all; None if no measurement went into an estimate, as the other figures.
        band_95_low: of a usual window: the median of all lower ends.
        band_95_high: the same of the upper ends.
        window_s: width of each window [s].
        windows: number of windows in which anything was measured.
        windows_within_band: number of windows whose mean is within its band.
        windows_within_band_share: of those in which anything was measured.
    """

    normalised_innovation_squared_mean: float | None = None
    band_95_low: float | None = None
    band_95_high: float | None = None
    window_s: float | None = None
    windows: int = 0
    windows_within_band: int = 0
    windows_within_band_share: float | None = None

    @classmethod
    def of(cls, series: TimeSeries) -> Consistency:
        """Return the consistency of a run."""
        table = np.array([series.times, series.column("innovation_squared"), series.column("innovations")])
        times, squared, counts = table[:, np.isfinite(table[1])]
        if not len(times):
            return cls()
        first, last = float(times.min()), float(times.max())
        windows = max(1, math.floor((last - first) / 4.95))
        width = max((last - first) / windows, 1e-3)
        index = np.minimum(np.floor((times - first) / width).astype(np.int64), windows - 1)
        count = np.bincount(index, counts, windows).astype(np.float64)
        count[count == 0.0] = np.nan
        means, (low, high) = np.bincount(index, squared * counts, windows) / count, mean_band(count)
        band, mean = np.nanmedian([low, high], axis=1).tolist(), float((squared * counts).sum() / counts.sum())
        known, within = int(np.isfinite(means).sum()), int(((low <= means) & (means <= high)).sum())
        return cls(mean, band[0], band[1], width, known, within, within / known)


@dataclass(frozen=True)
class DisturbanceEvent:
    """Something that the model does not know and that acted on the thread, from when it was found until it was over.

    Attributes:
        begin_s: since the bag's start [s].
        end_s: since the bag's start [s].
        arc_length_m: of the middle of the force, from the needle's tail [m].
        extent_m: length of the stretch of thread that it acts on [m].
        x_m: of the middle, in the dish frame [m].
        y_m: of the middle, in the dish frame [m].
        direction_rad: of the force, from the x axis [rad].
        force_n: [N]
        significance: in standard deviations; the largest, and all of the above except the times are of that frame.
    """

    begin_s: float
    end_s: float
    arc_length_m: float
    extent_m: float
    x_m: float
    y_m: float
    direction_rad: float
    force_n: float
    significance: float


def compare_errors(series: TimeSeries) -> dict[str, dict[str, float | None]]:
    """Return the errors of `prediction` and `estimate`, under the same names; None where there is none.

    `error_ground_truth_mean_percent` is the mean over time of the mean over nodes, `..._max_percent` its maximum over
    time, and `..._max_node_percent` the maximum over nodes and time, in % of the length; `error_measured_...` are the
    same against the measured centreline. The estimate at a frame has used that frame's measurement.

    Args:
        series: columns of a run.
    """
    errors: dict[str, dict[str, float | None]] = {kind: {} for kind in KINDS}
    for kind, prefix in KINDS.items():
        for name, target in (("ground_truth", "truth"), ("measured", "seen")):
            means, nodes = series.known(f"{prefix}error_{target}"), series.known(f"max_node_{prefix}error_{target}")
            errors[kind] |= {
                f"error_{name}_mean_percent": float(means.mean()) if len(means) else None,
                f"error_{name}_max_percent": float(means.max()) if len(means) else None,
                f"error_{name}_max_node_percent": float(nodes.max()) if len(nodes) else None,
            }
    return errors


@dataclass(frozen=True)
class EstimationFigures:
    """Figures of a run's estimate beside the errors.

    Attributes:
        corrected: number of frames whose estimate took a measurement; of the others it is a prediction only.
        consistency: of the innovations.
        hidden: how much of the thread was hidden.
        disturbances: what the model does not know, by its beginning.
    """

    corrected: int = 0
    consistency: Consistency = field(default_factory=Consistency)
    hidden: HiddenShares = field(default_factory=HiddenShares)
    disturbances: tuple[DisturbanceEvent, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, None where there is none."""
        figures = {"corrected_frames": self.corrected, "consistency": {**vars(self.consistency)}, **vars(self.hidden)}
        return figures | {"disturbances": len(self.disturbances)}


class RunMetrics:
    """Accumulates errors, margins and times of a run.

    Of each frame only numbers are kept, and of a few frames the threads: memory grows by 210 bytes a frame.

    Args:
        length: of the thread [m].
        start: time that is 0 in the figures [ns].
        targets: what the predictions are compared with, of `truth` and `seen`.

    Attributes:
        length: as given [m].
        targets: as given, the better one first.
        observed: columns `processing` [s] and `tracked`, 0 or 1, of all frames.
        reasons: why the needle was not found in the others.
        contact_frames: those in which the thread touches an obstacle or the wall.
        disturbances: that the estimate reported; those with one beginning are one event.
        series: columns of all frames with a prediction, by time.
    """

    def __init__(self, length: float, start: int = 0, targets: Iterable[str] = TARGETS) -> None:
        self.targets = tuple(target for target in TARGETS if target in targets)
        self.series, self.observed = TimeSeries(), TimeSeries()
        self.contact_frames = 0
        self.reasons: Counter[str] = Counter()
        self.disturbances: list[DisturbanceEvent] = []
        self.length, self._start = length, start
        self._disturbed_since = math.nan
        self._minimum: dict[str, MinimumMargin] = {}
        self._maps = {target: ErrorMap(length) for target in self.targets}
        self._worst: dict[str, WorstFrame] = {}

    @classmethod
    def of(cls, length: float, frames: Iterable[FrameResult], start: int = 0) -> RunMetrics:
        """Return the figures of frames by time."""
        metrics = cls(length, start)
        for frame in frames:
            metrics.add(frame)
        return metrics

    def observe(self, observation: frames.Observation) -> None:
        """Count a frame, or a recorded pose, and whether its needle was found."""
        columns = {"processing": observation.processing, "tracked": float(observation.found)}
        self.observed.add(self._time(observation.stamp), columns)
        if not observation.found:
            reason = observation.reason or "not said"
            self.reasons[reason if reason in self.reasons or len(self.reasons) < 12 else "others"] += 1

    @property
    def tracked(self) -> int:
        """Number of frames with a needle."""
        return int(self.observed.column("tracked").sum())

    def add(self, frame: FrameResult) -> None:
        """Add the prediction of a frame, and set its errors."""
        time = self._time(frame.stamp)
        self._worst.setdefault("", WorstFrame(time, math.nan, frame))
        if frame.margins is not None:
            self.contact_frames += bool(frame.margins.in_contact)
            for rows in filter(len, frame.margins.barriers):
                self._lower_minimum(time, rows)
        self._add_disturbance(time, frame)
        columns = frame.columns() | {"hidden": hidden_part(frame, self.length)} | self._compare(time, frame)
        self.series.add(time, columns)

    def _lower_minimum(self, time: float, rows: BarrierMargins) -> None:
        """Lower the minimum of a barrier to that of a frame."""
        at = int(rows.value.argmin()) if rows.barrier in SOLID else rows.closest
        place = (int(rows.node[at]), int(rows.obstacle[at]), time)
        new = MinimumMargin(rows.barrier, rows.minimum_clearance, rows.minimum, *place)
        old = self._minimum.get(rows.barrier, new)
        lower = new if new.promised < old.promised else old
        value, clearance = min(new.value, old.value), min(new.clearance, old.clearance)
        self._minimum[rows.barrier] = replace(lower, value=value, clearance=clearance)

    def _add_disturbance(self, time: float, frame: FrameResult) -> None:
        """Add the strongest disturbance of a frame to the event that it belongs to, or as a new one."""
        disturbances = frame.estimate.disturbances if frame.estimate is not None else ()
        strongest = max(disturbances, key=attrgetter("significance"), default=None)
        before, self._disturbed_since = self._disturbed_since, strongest.since if strongest else math.nan
        if strongest is None:
            return
        (x, y), angle = strongest.position.tolist(), math.atan2(*strongest.direction.tolist()[::-1])
        begin, force = time - (frame.stamp * 1e-9 - strongest.since), (strongest.force, strongest.significance)
        event = DisturbanceEvent(begin, time, strongest.arc_length, strongest.extent, x, y, angle, *force)
        if strongest.since == before:
            last = self.disturbances.pop()
            event = replace(max(last, event, key=attrgetter("significance")), begin_s=last.begin_s, end_s=time)
        self.disturbances.append(event)

    def _compare(self, time: float, frame: FrameResult) -> dict[str, float]:
        """Return the columns of a frame's errors."""
        row: dict[str, float] = {}
        threads = {"prediction": frame.vertices}
        if frame.estimate is not None and frame.estimate.vertices.shape == frame.vertices.shape:
            threads["estimate"] = frame.estimate.vertices
        for target in TARGETS:
            curve = frame.target_curve(target)
            points, known = target_points(curve, self.length, len(frame.vertices) - 1)
            if target == "seen":
                row["seen_share"] = min(1.0, known / self.length)
            if target not in self.targets:
                continue
            for kind, vertices in threads.items() if known >= MIN_KNOWN_SHARE * self.length else ():
                errors, column = node_errors(vertices, points, self.length), f"{KINDS[kind]}error_{target}"
                there = errors[np.isfinite(points[:, 0])]
                if not np.isfinite(there).all():
                    continue  # a prediction with a node that is nowhere
                row[column], row[f"max_node_{column}"] = float(there.mean()), float(there.max())
                if kind == "prediction":
                    self._maps[target].add(time, errors)
            error = frame.errors[target] = row.get(f"error_{target}", math.nan)
            if error > (self._worst[target].error if target in self._worst else -1.0):
                self._worst[target] = WorstFrame(time, error, frame)
            if len(frame.recorded):
                row[f"recorded_error_{target}"] = prediction_error_percent(frame.recorded, curve, self.length)
        return row

    @property
    def minimum_margins(self) -> dict[str, MinimumMargin]:
        """The minimum margin of each barrier that was there, the built-in ones first."""
        names = [name for name in BUILT_IN if name in self._minimum]
        return {name: self._minimum[name] for name in [*names, *sorted(self._minimum.keys() - set(names))]}

    @property
    def target(self) -> str:
        """Target of error map and worst frames: the truth where there is any; empty for none."""
        return next((target for target in self.targets if len(self.series.known(f"error_{target}"))), "")

    @property
    def error_map(self) -> ErrorMap | None:
        """Map of the prediction's error along the thread."""
        return self._maps.get(self.target)

    @property
    def worst(self) -> WorstFrame | None:
        """The frame in which the prediction is farthest off; the first one where nothing is known, None without any."""
        return self._worst.get(self.target)

    def errors(self, prefix: str = "error") -> dict[str, dict[str, float] | None]:
        """Return count, mean, median, p99 and maximum of the columns `PREFIX_TARGET` in %, by target; or None."""
        figures: dict[str, dict[str, float] | None] = {}
        for target in self.targets:
            known = self.series.known(f"{prefix}_{target}")
            spread = Percentiles.of(known)
            figures[target] = {"count": len(known), "mean": float(known.mean()), **asdict(spread)} if spread else None
        return figures

    @property
    def estimation(self) -> EstimationFigures:
        """Figures of the run's estimate beside the errors."""
        corrected = int(np.nansum(self.series.column("corrected")))
        consistency, hidden = Consistency.of(self.series), HiddenShares.of(self.series)
        return EstimationFigures(corrected, consistency, hidden, tuple(self.disturbances))

    def maximum(self, column: str) -> float:
        """Return the greatest value of a column; nan if there is none."""
        known = self.series.known(column)
        return float(known.max()) if len(known) else math.nan

    def mean(self, column: str) -> float:
        """Return the mean of a column; nan if there is none."""
        known = self.series.known(column)
        return float(known.mean()) if len(known) else math.nan

    @property
    def pull_error_percent(self) -> float:
        """Root mean square of the predicted pull upon the needle less the true one, in % of the true pull's peak.

        Over the frames with both; nan where there are none, or where nothing pulls.
        """
        peak, errors = self.maximum("true_pull"), self.series.known("pull_error")
        return 100.0 * frames.rms(errors) / peak if len(errors) and peak > 0.0 else math.nan

    def _time(self, stamp: int) -> float:
        return (stamp - self._start) * 1e-9
