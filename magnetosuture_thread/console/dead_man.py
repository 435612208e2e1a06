"""Dead man's switch: jog commands continue only while fresh jog messages arrive.

Pure: it reads no clock; times are monotonic [s].
"""

from __future__ import annotations

import math

Velocity = tuple[float, float]
ZERO_VELOCITY: Velocity = (0.0, 0.0)
DRIFT_RATE = 1e-4  # at which the minimum delay is forgotten [s/s]; above the drift between two clocks


class DeadManSwitch:
    """Repeats the jogged velocity while it is fresh; then sends one zero, then nothing.

    Args:
        timeout: a jog message is fresh for this long [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._velocity: Velocity | None = None
        self._arrival = -math.inf
        self._pressed = False  # by the last message, even if that is stale
        self._latched = False

    @property
    def moving(self) -> bool:
        """Whether a command is active that a zero must end."""
        return self._velocity is not None

    @property
    def deadline(self) -> float:
        """Time at which the last jog message becomes stale [s]."""
        return self._arrival + self._timeout

    def press(self, velocity: Velocity, now: float) -> Velocity | None:
        """Register a jog message; return a command to send at once, or None.

        After a stop during a jog, nothing is sent until a release.
        """
        if velocity == ZERO_VELOCITY:
            return self.release()
        self._pressed = True
        if self._latched:
            return None
        changed = velocity != self._velocity
        self._velocity, self._arrival = velocity, now
        return velocity if changed else None

    def release(self) -> Velocity | None:
        """Register a release; return the zero to send at once, if any."""
        self._pressed = self._latched = False
        return self._end()

    def interrupt(self) -> Velocity | None:
        """End the motion without a release; return the zero to send at once, if any."""
        return self._end()

    def stop(self) -> Velocity | None:
        """End the motion and require a release if a jog was active; return the zero to send at once, if any."""
        self._latched = self._latched or self._pressed
        return self._end()

    def due(self, now: float) -> Velocity | None:
        """Return the command of this period: the jogged velocity, one zero when it is stale, then None."""
        if self._velocity is None:
            return None
        return self._velocity if now < self.deadline else self._end()

    def _end(self) -> Velocity | None:
        moving, self._velocity = self.moving, None
        return ZERO_VELOCITY if moving else None


class DelayEstimator:
    """Delay of messages on the network, relative to the fastest one.

    The page's clock has another origin, so the fastest message defines zero delay. A late jog message describes the
    past and must not move the needle.
    """

    def __init__(self) -> None:
        self._min_offset = math.inf  # arrival minus sending time of the fastest message [s]
        self._arrival = 0.0

    def update(self, sent: float, arrival: float) -> float:
        """Register a message and return its delay relative to the fastest one [s].

        Args:
            sent: by the page's monotonic clock [s].
            arrival: by the server's monotonic clock [s].
        """
        drift = DRIFT_RATE * max(0.0, arrival - self._arrival)
        self._min_offset, self._arrival = min(self._min_offset + drift, arrival - sent), arrival
        return arrival - sent - self._min_offset
