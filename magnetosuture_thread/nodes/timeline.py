"""Simulated time of a replay or of the simulated rig."""

from __future__ import annotations

import math
import time
from typing import Any


class Timeline:
    """Maps simulated to real time; before it begins, and while it is paused, simulated time stands still.

    Args:
        start: the simulated time to begin with [ns].
        rate: how much faster than real time it runs.

    Attributes:
        start: as given.
        stood: real time of all pauses that are over [s].
        lag: simulated time that was left out, as the computer was too slow for it [s].
        skipped: simulated time that was left out, as nothing happens in it [s].
    """

    def __init__(self, start: int, rate: float) -> None:
        self.start = start
        self._rate = rate
        self._began: float | None = None
        self._paused: float | None = None
        self.stood = self.lag = self.skipped = 0.0

    def begin(self) -> None:
        """Begin, or begin anew, at the start."""
        self._began, self.stood, self.skipped = time.perf_counter(), 0.0, 0.0
        self._paused = self._began if self._paused is not None else None

    @property
    def paused(self) -> bool:
        """Whether it is paused."""
        return self._paused is not None

    def pause(self, still: bool) -> None:
        """Pause the time, or resume it."""
        now = time.perf_counter()
        if still and self._paused is None:
            self._paused = now
        elif not still and self._paused is not None:
            if self._began is not None:
                self.stood += now - self._paused
            self._paused = None

    def on_pause(self, asked: Any, answer: Any) -> Any:
        """Pause the time, or resume it, as a service SetBool."""
        self.pause(asked.data)
        answer.success = True
        answer.message = f"{'paused' if asked.data else 'goes on'} at {self.elapsed():.2f} s"
        return answer

    def running(self) -> float:
        """Return for how long it has been running, by real time, since it began [s]."""
        if self._began is None:
            return 0.0
        now = time.perf_counter() if self._paused is None else self._paused
        return now - self._began - self.stood

    def elapsed(self) -> float:
        """Return the simulated time since the start [s]."""
        return self.running() * self._rate - self.lag + self.skipped

    def skip_to(self, simulated: int) -> None:
        """Leave out the time until a simulated time [ns]."""
        self.skipped += (simulated - self.now()) * 1e-9

    def now(self) -> int:
        """Return the simulated time [ns]."""
        return self.start + round(self.elapsed() * 1e9)

    def left(self, simulated: int) -> float:
        """Return how long it takes until a simulated time [ns], in real time [s]; for ever while it is paused."""
        if self._paused is not None:
            return math.inf
        return ((simulated - self.start) * 1e-9 - self.skipped) / self._rate - self.running()
