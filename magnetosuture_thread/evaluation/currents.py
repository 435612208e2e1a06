"""The coils' currents of a replay beside the recorded ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from magnetosuture_thread.evaluation.frames import Array
from magnetosuture_thread.messages.reading import nanoseconds

CURRENT_VALID = 0.05  # s; a recorded current counts as in force for this long


@dataclass(frozen=True)
class CurrentDifference:
    """How far the currents of a replay are from the recorded ones, at the times of the replay's.

    In places the coils can give the same velocity in two ways, far apart, and change from one to the other
    within a hundredth of a second: the greatest differences are of such moments.

    Attributes:
        compared: how many replayed currents have a recorded one beside them.
        difference: of a coil, median [A].
        p99: 99th percentile [A].
        greatest: [A].
        recorded: root of the mean square of the recorded currents, to judge the difference by [A].
        stopped_apart: share of the compared of which one is a stop and the other is not.
    """

    compared: int
    difference: float
    p99: float
    greatest: float
    recorded: float
    stopped_apart: float


class CurrentSeries:
    """Currents over time, from messages in any order of arrival."""

    def __init__(self) -> None:
        self._received: dict[int, tuple[Array, bool]] = {}

    def add(self, message: Any) -> None:
        """Add a message CoilCurrents, of ROS or of the bags' type store."""
        stamp = nanoseconds(message.header.stamp)
        self._received[stamp] = np.asarray(message.current, dtype=np.float64), bool(message.stop)

    def against(self, recorded: CurrentSeries) -> CurrentDifference | None:
        """Compare with what was recorded; None where nothing can be."""
        theirs = np.array(sorted(recorded._received))
        apart, sizes, stops = [], [], []
        for stamp, (currents, stopped) in sorted(self._received.items()):
            index = int(np.searchsorted(theirs, stamp, side="right")) - 1
            if index < 0 or stamp - theirs[index] > CURRENT_VALID * 1e9:
                continue
            other, other_stopped = recorded._received[int(theirs[index])]
            if other.shape != currents.shape:
                continue
            apart.append(currents - other)
            sizes.append(other)
            stops.append(stopped != other_stopped)
        if not apart:
            return None
        difference = np.abs(np.array(apart))
        return CurrentDifference(
            compared=len(difference),
            difference=float(np.median(difference)),
            p99=float(np.percentile(difference, 99)),
            greatest=float(difference.max()),
            recorded=float(np.sqrt(np.mean(np.array(sizes) ** 2))),
            stopped_apart=float(np.mean(stops)),
        )
