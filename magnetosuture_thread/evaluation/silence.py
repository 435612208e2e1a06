"""Time in which a sensor was silent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.evaluation.frames import Array

SILENT_PERIODS = 5.0  # usual intervals, beyond which nothing that came is a gap
CLOCK_TOLERANCE = 1.0  # s; stamps farther outside of the bag are of another clock


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
        usual = float(np.median(np.diff(times)))
        within = begin - CLOCK_TOLERANCE <= times[0] and times[-1] <= end + CLOCK_TOLERANCE
        edges = np.concatenate([[begin], times, [end]]) if within else times
        steps = np.diff(edges)
        gaps = steps[steps > SILENT_PERIODS * usual]
        if not len(gaps):
            return cls()
        longest = int(np.argmax(steps))
        return cls(len(gaps), float(gaps.sum()), float(steps[longest]), float(edges[longest]))
