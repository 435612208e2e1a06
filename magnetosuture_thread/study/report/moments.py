"""The worst moments of a bag, apart from one another, found while it goes by."""

from __future__ import annotations

import math
from dataclasses import dataclass

from magnetosuture_thread.geometry.obstacles import Obstacle
from magnetosuture_thread.study.replayed import Instant

MOST = 5
APART = 1.0  # s
BIN = 0.5  # s; of each bin the worst frame is looked at


@dataclass(frozen=True)
class Moment:
    """A frame in which the prediction is far off.

    Attributes:
        time: since the bag's start [s].
        error: of the prediction [% of length].
        instant: what was predicted, seen and true.
        obstacles: that were in force.
    """

    time: float
    error: float
    instant: Instant
    obstacles: tuple[Obstacle, ...] = ()


class WorstMoments:
    """Keeps the frames with the greatest errors, few of them however long the bag is.

    Args:
        most: moments to find.
        apart: least time between two of them [s].
    """

    def __init__(self, most: int = MOST, apart: float = APART) -> None:
        self._most = most
        self._apart = apart
        # A moment takes out the bins within `apart` of it, on both sides: no more of the worst bins are needed.
        self._enough = most * (2 * math.ceil(apart / BIN) + 3)
        self._bins: dict[int, Moment] = {}

    def add(self, time: float, error: float, instant: Instant, obstacles: tuple[Obstacle, ...] = ()) -> None:
        """Take one frame, with the obstacles in force; one without an error is passed over."""
        if not math.isfinite(error):
            return
        bin_ = math.floor(time / BIN)
        held = self._bins.get(bin_)
        if held is not None and held.error >= error:
            return
        self._bins[bin_] = Moment(time, error, instant, obstacles)
        if len(self._bins) > 2 * self._enough:
            kept = sorted(self._bins.items(), key=lambda item: -item[1].error)[: self._enough]
            # The bin that is being filled stays: its worst frame may be still to come.
            self._bins = dict(kept) | {bin_: self._bins[bin_]}

    def found(self) -> list[Moment]:
        """Return the worst moments, the worst first."""
        chosen: list[Moment] = []
        for moment in sorted(self._bins.values(), key=lambda moment: (-moment.error, moment.time)):
            if all(abs(moment.time - other.time) >= self._apart for other in chosen):
                chosen.append(moment)
            if len(chosen) == self._most:
                break
        return chosen
