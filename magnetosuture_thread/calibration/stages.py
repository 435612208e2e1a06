"""How far a calibration is."""

from __future__ import annotations

from collections.abc import Callable

from magnetosuture_thread.calibration.replays import Best

SHARES = {"starts": 0.2, "fit": 0.4, "identified": 0.15, "held out": 0.25}  # of the time
EASED = 0.8  # of a stage is gone through with the replays expected, the rest ever more slowly


class Stages:
    """Tells how far a search is, as well as that can be known.

    Args:
        best: the best so far.
        progress: is told the share done, which never falls.
        log: is told a line at the end of each stage.
    """

    def __init__(self, best: Best, progress: Callable[[float], None], log: Callable[[str], None]) -> None:
        self._best, self._progress, self._say = best, progress, log
        self._begin = self._width = 0.0
        self._done, self._expected = 0, 1

    def begin(self, stage: str, replays: int) -> None:
        """Begin a stage that takes about so many replays."""
        self._begin += self._width
        self._width, self._done, self._expected = SHARES[stage], 0, max(1, replays)
        self._progress(self._begin)

    def told(self, replays: int) -> None:
        """Count replays."""
        self._done += replays
        share = self._done / self._expected
        self._progress(self._begin + self._width * (EASED * share if share < 1.0 else 1.0 - (1.0 - EASED) / share))

    def end(self, line: str) -> None:
        """Say what a stage came to."""
        best = self._best
        self._say(f"{line}; least distance of the nodes {best.error:.3g} % of the length after {best.replays} replays")

    def done(self) -> None:
        """Say that all is done."""
        self._progress(1.0)
