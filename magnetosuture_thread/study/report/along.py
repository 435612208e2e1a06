"""Where along the thread a prediction is off, over time, in a table that does not grow with the bag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at

MOST_COLUMNS = 300
SHORT = 1e-3  # of the thread's length
GAP = 3.0  # times the usual interval


def node_errors(vertices: Points, curve: Points, length: float) -> NDArray[np.float64]:
    """Return how far each node is from where it should be, in % of the thread's length.

        e_i = 100 |x_i - X(s_i)| / L,    s_i = i L / n,    i = 1 ... n

    Their mean is the prediction error of `study.score`, but for a node less than 0.1 % of the length past the curve's
    end: the score leaves it out, here it counts, as the chords of a curve are always a little short.

    Args:
        vertices: predicted nodes, shape (n + 1, d) [m].
        curve: where the thread was, from the needle's tail on, shape (m, d) [m].
        length: L [m].

    Returns:
        Shape (n,), nan for a node past the end of the curve.
    """
    segments = len(vertices) - 1
    at = length * np.arange(1, segments + 1) / segments
    known = float(arc_lengths(curve)[-1]) if len(curve) > 1 else 0.0
    within = at <= known + SHORT * length
    errors = np.full(segments, np.nan)
    if within.any():
        errors[within] = np.linalg.norm(vertices[1:][within] - points_at(curve, at[within]), axis=1)
    return np.asarray(100.0 * errors / length)


@dataclass(frozen=True)
class Along:
    """A map of the greatest error by time and arc length.

    Attributes:
        times: of each column [s].
        lengths: arc length of each row, from the needle's tail on [m].
        errors: shape (rows, columns) [% of the thread's length]; nan where nothing is known.
    """

    times: NDArray[np.float64]
    lengths: NDArray[np.float64]
    errors: NDArray[np.float64]


class AlongThread:
    """Gathers the map frame by frame: when it is full, neighbouring columns become one, with the greater error.

    Args:
        length: of the thread [m].
        most: columns of the map.
    """

    def __init__(self, length: float, most: int = MOST_COLUMNS) -> None:
        self._length = length
        self._most = most
        self._frames = 1  # of a column
        self._filled = 0  # frames in the last column
        self._times: list[float] = []
        self._columns: list[NDArray[np.float64]] = []

    def add(self, time: float, errors: NDArray[np.float64]) -> None:
        """Take the errors of one frame's nodes; see `node_errors`."""
        if not np.isfinite(errors).any():
            return
        if self._columns and self._filled < self._frames:
            self._columns[-1] = np.fmax(self._columns[-1], errors)
            self._filled += 1
            return
        if len(self._columns) == 2 * self._most:
            self._columns = [np.fmax(a, b) for a, b in zip(self._columns[::2], self._columns[1::2], strict=True)]
            self._times = self._times[::2]
            self._frames *= 2
        self._times.append(time)
        self._columns.append(errors)
        self._filled = 1

    def map(self) -> Along | None:
        """Return the map, an empty column in each long gap; None if there is nothing."""
        if not self._columns:
            return None
        times, errors = np.array(self._times), np.column_stack(self._columns)
        rows = errors.shape[0]
        lengths = self._length * np.arange(1, rows + 1) / rows
        if len(times) > 2:
            steps = np.diff(times)
            usual = float(np.median(steps))
            gaps = np.flatnonzero(steps > GAP * usual) + 1
            # A column just after the gap's beginning and one just before its end: both are empty.
            times = np.insert(
                times, np.repeat(gaps, 2), np.column_stack([times[gaps - 1] + usual, times[gaps] - usual]).ravel()
            )
            errors = np.insert(errors, np.repeat(gaps, 2), np.nan, axis=1)
        return Along(times, lengths, errors)
