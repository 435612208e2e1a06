"""Figures of the estimate itself: consistency of its innovations, hidden parts of the thread, disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from magnetosuture_thread.estimator import Disturbance, SlowParameter
from magnetosuture_thread.estimator.stiffness import STIFFNESS_OVER_DRAG
from magnetosuture_thread.evaluation.frames import SILENT_PERIODS, Array, FrameResult, TimeSeries
from magnetosuture_thread.geometry.polyline import arc_lengths

ESTIMATE_COLUMNS = ("hidden", "corrected", "innovations", "innovation_squared")
MIN_WINDOW = 4.95  # s; over which innovations are tested: 5 s or more, or all that there is
BAND = 0.95  # of the means of a consistent filter are within
WHOLE = 0.97  # of the length; a thread of which so much is measured is not hidden
MAX_DISTURBANCES = 1000  # that are kept


def hidden_part(frame: FrameResult, length: float) -> float:
    """Return the part of the thread that a frame's measurement does not show, 0 to 1.

    All of it is hidden where nothing was measured, or where no measurement went into the frame's estimate. Nothing is
    where the observation is complete. A centreline alone, or pieces, show as much as they are long; where neither was
    kept, it is what the estimate says.

    Args:
        frame: with what was measured in it.
        length: of the thread [m].
    """
    if frame.estimate is not None and not frame.estimate.corrected:
        return 1.0
    if frame.observation is None:
        if frame.estimate is not None and not len(frame.measured):
            return frame.estimate.hidden
        pieces = [frame.measured]
    elif frame.observation.complete:
        return 0.0
    else:
        pieces = [piece.points for piece in frame.observation.pieces]
    pieces = [points[np.isfinite(points).all(axis=1)] for points in pieces]
    measured = sum(float(arc_lengths(points)[-1]) for points in pieces if len(points) > 1)
    return max(0.0, 1.0 - measured / length)


@dataclass(frozen=True)
class HiddenShares:
    """How much of the thread was hidden, for how long. Each frame counts for the time until the next one.

    Attributes:
        time: share of the time in which a part of the thread was hidden: more than 3 % of its length.
        all_time: share of the time in which all of it was: the estimate is a prediction only.
        length: part of the length that was hidden, mean over the time.
    """

    time: float
    all_time: float
    length: float

    @classmethod
    def of(cls, series: TimeSeries) -> HiddenShares | None:
        """Return the shares; None if no frame has an estimate."""
        hidden, corrected = series.column("hidden"), series.column("corrected")
        known = np.isfinite(hidden) & np.isfinite(corrected)
        if not known.any():
            return None
        weights = _durations(series.times)[known]
        hidden, corrected = hidden[known], corrected[known]
        return cls(
            float(np.average(hidden > 1.0 - WHOLE, weights=weights)),
            float(np.average(corrected == 0.0, weights=weights)),
            float(np.average(hidden, weights=weights)),
        )


def _durations(times: Array) -> Array:
    """Return the time from each frame to the next; the usual interval for the last one and before a gap [s]."""
    steps = np.diff(times)
    steps = steps[steps > 0.0]
    usual = float(np.median(steps)) if len(steps) else 1.0
    durations = np.append(np.diff(times), usual)
    return np.where((durations > 0.0) & (durations <= SILENT_PERIODS * usual), durations, usual)


def mean_band(count: ArrayLike) -> tuple[Array, Array]:
    """Return between what 95 % of the means of so many squared standard normal values are.

        chi2_N^{-1}(0.025) / N,    chi2_N^{-1}(0.975) / N

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
    5.4. Deviation: none.
    """
    given = np.asarray(count, dtype=np.float64)
    low, high = (chdtri(given, 0.5 - side * 0.5 * BAND) / given for side in (-1.0, 1.0))
    return np.asarray(low), np.asarray(high)


@dataclass(frozen=True)
class Consistency:
    """Normalised innovations squared in equal windows of 5 s or more, and the band of 95 % of such means.

    Innovations are what the camera says against the prediction from the last estimate, for sixteen parts of the
    thread's length; each is divided by the standard deviation that the filter expects of it. A mean of 1 says that the
    filter knows how wrong it is; one above the band that it trusts itself too much.

    Attributes:
        begins: of each window, since the bag's start, shape (k,) [s].
        width: of each [s].
        means: of the normalised innovations squared, shape (k,); nan where nothing was measured.
        low: lower end of the band of each, shape (k,).
        high: upper end of it, shape (k,).
        mean: of all normalised innovations squared.
    """

    begins: Array
    width: float
    means: Array
    low: Array
    high: Array
    mean: float

    @classmethod
    def of(cls, series: TimeSeries) -> Consistency | None:
        """Return the consistency of a run; None if no measurement went into an estimate."""
        squared, counts, times = series.column("innovation_squared"), series.column("innovations"), series.times
        known = np.isfinite(squared)
        if not known.any():
            return None
        squared, counts, times = squared[known], counts[known], times[known]
        first, last = float(times.min()), float(times.max())
        windows = max(1, math.floor((last - first) / MIN_WINDOW))
        width = max((last - first) / windows, 1e-3)
        index = np.minimum(np.floor((times - first) / width).astype(np.int64), windows - 1)
        total = np.bincount(index, squared * counts, windows)
        count = np.bincount(index, counts, windows)
        with np.errstate(invalid="ignore"):
            means = np.where(count > 0, total / np.maximum(count, 1.0), np.nan)
        low, high = mean_band(np.where(count > 0, count, np.nan))
        begins = first + width * np.arange(windows, dtype=np.float64)
        return cls(np.asarray(begins), width, means, low, high, float((squared * counts).sum() / counts.sum()))

    @property
    def ends(self) -> Array:
        """End of each window, shape (k,) [s]."""
        return self.begins + self.width

    @property
    def windows(self) -> int:
        """Number of windows in which anything was measured."""
        return int(np.isfinite(self.means).sum())

    @property
    def within(self) -> int:
        """Number of windows whose mean is within its band."""
        return int(((self.low <= self.means) & (self.means <= self.high)).sum())

    @property
    def share(self) -> float:
        """Share of the windows whose mean is within its band."""
        return self.within / self.windows

    @property
    def band(self) -> tuple[float, float]:
        """The band of a usual window: the median of both ends."""
        return float(np.nanmedian(self.low)), float(np.nanmedian(self.high))

    @staticmethod
    def json_of(consistency: Consistency | None) -> dict[str, float | None]:
        """Return the figures as plain values, None where there is none."""
        given = consistency
        return {
            "normalised_innovation_squared_mean": given.mean if given else None,
            "band_95_low": given.band[0] if given else None,
            "band_95_high": given.band[1] if given else None,
            "window_s": given.width if given else None,
            "windows": given.windows if given else 0,
            "windows_within_band": given.within if given else 0,
            "windows_within_band_share": given.share if given else None,
        }


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

    def to_json(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


class DisturbanceLog:
    """Collects the disturbances of a run; those with one beginning are one event.

    Attributes:
        events: by their beginning.
        count: of all, also of those beyond the number that is kept.
    """

    def __init__(self) -> None:
        self.events: list[DisturbanceEvent] = []
        self.count = 0
        self._since = math.nan

    def add(self, time: float, frame: FrameResult) -> None:
        """Add a frame at a time since the bag's start [s]."""
        found = frame.estimate.disturbances if frame.estimate is not None else ()
        if not found:
            self._since = math.nan
            return
        strongest = max(found, key=lambda each: each.significance)
        begin = time - (frame.stamp * 1e-9 - strongest.since)
        if strongest.since == self._since:
            if len(self.events) == self.count:
                self.events[-1] = _extended(self.events[-1], _event(strongest, begin, time))
            return
        self._since = strongest.since
        self.count += 1
        if len(self.events) < MAX_DISTURBANCES:
            self.events.append(_event(strongest, begin, time))


def _event(found: Disturbance, begin: float, time: float) -> DisturbanceEvent:
    x, y = found.position.tolist()
    angle = math.atan2(found.direction[1], found.direction[0])
    return DisturbanceEvent(begin, time, found.arc_length, found.extent, x, y, angle, found.force, found.significance)


def _extended(event: DisturbanceEvent, later: DisturbanceEvent) -> DisturbanceEvent:
    larger = max(event, later, key=lambda each: each.significance)
    return replace(larger, begin_s=event.begin_s, end_s=later.end_s)


def compare_errors(series: TimeSeries) -> dict[str, dict[str, float | None]]:
    """Return the errors of `prediction` and `estimate`, under the same names; None where there is none.

    `error_ground_truth_mean_percent` is the mean over time of the mean over nodes, `..._max_percent` its maximum over
    time, and `..._max_node_percent` the maximum over nodes and time, in % of the length; `error_measured_...` are the
    same against the measured centreline. The estimate at a frame has used that frame's measurement.

    Args:
        series: columns of a run.
    """
    return {
        kind: {name: _figure(series, column.format(own=own), function) for name, (column, function) in _ERRORS.items()}
        for kind, own in (("prediction", ""), ("estimate", "estimate_"))
    }


_ERRORS: dict[str, tuple[str, Callable[[Array], Any]]] = {
    "error_ground_truth_mean_percent": ("{own}error_truth", np.mean),
    "error_ground_truth_max_percent": ("{own}error_truth", np.max),
    "error_ground_truth_max_node_percent": ("max_node_{own}error_truth", np.max),
    "error_measured_mean_percent": ("{own}error_seen", np.mean),
    "error_measured_max_percent": ("{own}error_seen", np.max),
    "error_measured_max_node_percent": ("max_node_{own}error_seen", np.max),
}


def _figure(series: TimeSeries, name: str, function: Callable[[Array], Any]) -> float | None:
    values = series.column(name) if name in series.names else np.empty(0)
    values = values[np.isfinite(values)]
    return float(function(values)) if len(values) else None


@dataclass(frozen=True)
class EstimationFigures:
    """What a run tells of its estimate beside the errors.

    Attributes:
        corrected: number of frames whose estimate took a measurement; of the others it is a prediction only.
        consistency: of the innovations; None where no measurement went in.
        hidden: how much of the thread was hidden; None where nothing was estimated.
        disturbances: what the model does not know, by its beginning.
        disturbance_count: of all, also of those that are not kept.
        learned: slow parameters in the end, where any are learned.
    """

    corrected: int = 0
    consistency: Consistency | None = None
    hidden: HiddenShares | None = None
    disturbances: tuple[DisturbanceEvent, ...] = ()
    disturbance_count: int = 0
    learned: tuple[SlowParameter, ...] = ()

    @classmethod
    def of(
        cls, series: TimeSeries, disturbances: DisturbanceLog, learned: tuple[SlowParameter, ...] = ()
    ) -> EstimationFigures:
        """Return the figures of a run."""
        return cls(
            int(np.nansum(series.column("corrected"))),
            Consistency.of(series),
            HiddenShares.of(series),
            tuple(disturbances.events),
            disturbances.count,
            learned,
        )

    @property
    def estimated(self) -> bool:
        """Whether the thread was estimated at all."""
        return self.hidden is not None

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, None where there is none."""
        hidden = self.hidden
        return {
            "corrected_frames": self.corrected,
            "consistency": Consistency.json_of(self.consistency),
            "hidden_time_share": hidden.time if hidden else None,
            "all_hidden_time_share": hidden.all_time if hidden else None,
            "hidden_length_share": hidden.length if hidden else None,
            "disturbances": self.disturbance_count,
            "learned": _learned(self.learned),
        }


def _learned(parameters: tuple[SlowParameter, ...]) -> dict[str, float | None]:
    """Return value and 95 % interval of the stiffness over drag, None where it is not learned."""
    found = parameters[0] if parameters else None
    return {
        f"{STIFFNESS_OVER_DRAG}{suffix}": getattr(found, of) if found else None
        for suffix, of in (("", "value"), ("_95_low", "low"), ("_95_high", "high"))
    }
