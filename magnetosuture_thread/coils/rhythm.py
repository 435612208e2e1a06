"""How evenly a loop runs."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

KEPT = 2000


class Rhythm:
    """Keeps the last intervals of a loop and says by how much they differ from its period.

    Args:
        period: of the loop [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._last: float | None = None
        self._off: deque[float] = deque(maxlen=KEPT)

    def tick(self, arrival: float) -> None:
        """Say that the loop runs at a monotonic time [s]."""
        if self._last is not None:
            self._off.append(abs(arrival - self._last - self._period))
        self._last = arrival

    @property
    def milliseconds(self) -> tuple[float, float, float]:
        """By how much an interval differs from the period: median, 99th percentile, greatest [ms]; NaN of none."""
        if not self._off:
            return math.nan, math.nan, math.nan
        middle, high, most = 1e3 * np.percentile(np.array(self._off), [50.0, 99.0, 100.0])
        return float(middle), float(high), float(most)
