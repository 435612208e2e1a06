"""Time series in little memory: columns of numbers, the error along the thread, and the worst frames."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from magnetosuture_thread.evaluation.frames import FrameResult

Column = NDArray[np.float64]

LINE_GAP = 5.0  # times the usual interval; a line is broken where nothing came for longer
MAP_GAP = 3.0  # the same, of the error map
MAP_COLUMNS = 300
WORST_FRAMES = 5
MIN_DISTANCE = 1.0  # s; between two of the worst frames
MARGIN = "margin_"  # columns of margins, by the barrier's name
BIN = 0.5  # s; of each bin the worst frame is kept


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
            self._columns[name] = array("d", [float("nan")] * len(self._times))
        self._times.append(time)
        for name, column in self._columns.items():
            column.append(values.get(name, float("nan")))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self._columns)

    @property
    def times(self) -> Column:
        """Return the time of each row [s]."""
        return np.array(self._times)

    def column(self, name: str) -> Column:
        """Return a column."""
        return np.array(self._columns[name])

    def has(self, name: str) -> bool:
        """Return whether a column holds any number."""
        return bool(np.isfinite(self.column(name)).any())


def thinned(times: Column, columns: Mapping[str, Column], limit: int) -> tuple[Column, dict[str, Column]]:
    """Return the envelope of columns: of each run of rows the least and the greatest value, in the order they came.

    Rows are left as they are where there are no more than `limit`. Otherwise each run gives two points, at its first
    time and at its middle, so that all columns share their times and a value is off by less than a run.

    Args:
        times: rising, shape (m,) [s].
        columns: each of shape (m,); nan for none.
        limit: of points, at least 2.
    """
    count = len(times)
    if count <= limit:
        return times, dict(columns)
    run = -(-count // (limit // 2))
    runs = -(-count // run)
    first = np.arange(runs) * run
    at = np.column_stack([times[first], times[np.minimum(first + run // 2, count - 1)]]).ravel()
    return at, {name: _extremes(column, run, runs) for name, column in columns.items()}


def _extremes(column: Column, run: int, runs: int) -> Column:
    padded = np.full(run * runs, np.nan)
    padded[: len(column)] = column
    table = padded.reshape(runs, run)
    none = np.isnan(table)
    low = np.argmin(np.where(none, np.inf, table), axis=1)
    high = np.argmax(np.where(none, -np.inf, table), axis=1)
    pair = np.column_stack([np.minimum(low, high), np.maximum(low, high)])
    return np.take_along_axis(table, pair, axis=1).ravel()


def with_gaps(times: Column, columns: Mapping[str, Column]) -> tuple[Column, dict[str, Column]]:
    """Return columns with a nan in each long gap, so that no line is drawn over a time of which nothing is known."""
    if len(times) < 3:
        return times, dict(columns)
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > LINE_GAP * float(np.median(steps))) + 1
    middles = 0.5 * (times[gaps - 1] + times[gaps])
    return np.insert(times, gaps, middles), {name: np.insert(column, gaps, np.nan) for name, column in columns.items()}


class ErrorGrid(NamedTuple):
    """The greatest error by time and arc length.

    Attributes:
        times: of each column [s].
        lengths: arc length of each row, from the needle's tail on [m].
        errors: shape (rows, columns) [% of the thread's length]; nan where nothing is known.
    """

    times: Column
    lengths: Column
    errors: Column


class ErrorMap:
    """Accumulates the error along the thread: when it is full, neighbouring columns become one, with the greater error.

    Args:
        length: of the thread [m].
        columns: of the map.
    """

    def __init__(self, length: float, columns: int = MAP_COLUMNS) -> None:
        self._length = length
        self._limit = 2 * columns
        self._frames = 1  # of a column
        self._filled = 0  # frames in the last column
        self._times: list[float] = []
        self._columns: list[Column] = []

    def add(self, time: float, errors: Column) -> None:
        """Take the errors of one frame's nodes, in % of the length."""
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

    def grid(self) -> ErrorGrid | None:
        """Return the map, an empty column in each long gap; None if there is nothing."""
        if not self._columns:
            return None
        times, errors = np.array(self._times), np.column_stack(self._columns)
        rows = errors.shape[0]
        lengths = self._length * np.arange(1, rows + 1) / rows
        if len(times) > 2:
            steps = np.diff(times)
            usual = float(np.median(steps))
            gaps = np.flatnonzero(steps > MAP_GAP * usual) + 1
            # A column just after the gap's beginning and one just before its end: both are empty.
            times = np.insert(
                times, np.repeat(gaps, 2), np.column_stack([times[gaps - 1] + usual, times[gaps] - usual]).ravel()
            )
            errors = np.insert(errors, np.repeat(gaps, 2), np.nan, axis=1)
        return ErrorGrid(times, lengths, errors)


@dataclass(frozen=True)
class WorstFrame:
    """A frame in which the prediction is far off.

    Attributes:
        time: since the bag's start [s].
        error: of the prediction [% of length].
        frame: what was predicted, measured and true.
    """

    time: float
    error: float
    frame: FrameResult


class WorstFrames:
    """Keeps the frames with the greatest errors, few of them however long the bag is.

    Args:
        count: of frames to find.
        apart: least time between two of them [s].
    """

    def __init__(self, count: int = WORST_FRAMES, apart: float = MIN_DISTANCE) -> None:
        self._count = count
        self._apart = apart
        # A frame takes out the bins within `apart` of it, on both sides: no more of the worst bins are needed.
        self._enough = count * (2 * math.ceil(apart / BIN) + 3)
        self._bins: dict[int, WorstFrame] = {}

    def add(self, time: float, error: float, frame: FrameResult) -> None:
        """Take one frame; one without an error is passed over."""
        if not math.isfinite(error):
            return
        bin_ = math.floor(time / BIN)
        held = self._bins.get(bin_)
        if held is not None and held.error >= error:
            return
        self._bins[bin_] = WorstFrame(time, error, frame)
        if len(self._bins) > 2 * self._enough:
            kept = sorted(self._bins.items(), key=lambda item: -item[1].error)[: self._enough]
            # The bin that is being filled stays: its worst frame may be still to come.
            self._bins = dict(kept) | {bin_: self._bins[bin_]}

    def found(self) -> list[WorstFrame]:
        """Return the worst frames, the worst first."""
        chosen: list[WorstFrame] = []
        for worst in sorted(self._bins.values(), key=lambda worst: (-worst.error, worst.time)):
            if all(abs(worst.time - other.time) >= self._apart for other in chosen):
                chosen.append(worst)
            if len(chosen) == self._count:
                break
        return chosen
