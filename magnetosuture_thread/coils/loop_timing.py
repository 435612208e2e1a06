"""Jitter of a periodic loop."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

MAX_INTERVALS = 2000


class LoopTiming:
    """Jitter statistics over the last intervals of a loop.

    Args:
        period: of the loop [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._last: float | None = None
        self._deviations: deque[float] = deque(maxlen=MAX_INTERVALS)

    def tick(self, arrival: float) -> None:
        """Register one run of the loop at a monotonic time [s]."""
        if self._last is not None:
            self._deviations.append(abs(arrival - self._last - self._period))
        self._last = arrival

    @property
    def jitter_ms(self) -> tuple[float, float, float]:
        """Deviation of an interval from the period: median, 99th percentile, maximum [ms]; NaN if unknown."""
        if not self._deviations:
            return math.nan, math.nan, math.nan
        median, p99, maximum = 1e3 * np.percentile(np.array(self._deviations), [50.0, 99.0, 100.0])
        return float(median), float(p99), float(maximum)
