"""Numbers over time: kept in little memory, and thinned so that a page stays quick and no peak is lost."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]

GAP = 5.0  # times the usual interval; a line is broken where nothing came for longer


class Timeline:
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
            values: by column.

        Raises:
            KeyError: there is no such column.
        """
        if unknown := values.keys() - self._columns.keys():
            raise KeyError(f"no such columns: {', '.join(sorted(unknown))}")
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


def broken(times: Column, columns: Mapping[str, Column]) -> tuple[Column, dict[str, Column]]:
    """Return columns with a nan in each long gap, so that no line is drawn over a time of which nothing is known."""
    if len(times) < 3:
        return times, dict(columns)
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > GAP * float(np.median(steps))) + 1
    middles = 0.5 * (times[gaps - 1] + times[gaps])
    return np.insert(times, gaps, middles), {name: np.insert(column, gaps, np.nan) for name, column in columns.items()}
