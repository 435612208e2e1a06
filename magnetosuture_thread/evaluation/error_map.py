"""The error along the thread over time, in a map of bounded size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from magnetosuture_thread.evaluation.frames import Array

MAP_GAP = 3.0  # times the usual interval; the error map is empty where nothing came for longer
MAP_COLUMNS = 300


class ErrorGrid(NamedTuple):
    """The greatest error by time and arc length.

    Attributes:
        times: of each column [s].
        lengths: arc length of each row, from the needle's tail on [m].
        errors: shape (rows, columns) [% of the thread's length]; nan where nothing is known.
    """

    times: Array
    lengths: Array
    errors: Array


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
