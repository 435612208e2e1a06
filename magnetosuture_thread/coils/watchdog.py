"""Command watchdog: validates the velocity commands of one input and times them out.

Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.input_checks import PublisherCounter, check_stamp
from magnetosuture_thread.errors import InvalidInputError

Vector = NDArray[np.float64]


class CommandWatchdog:
    """Keeps the last valid command of one input until it is stale.

    Args:
        timeout: a command is valid for this long after its arrival, and its stamp may be this old [s].
        topic: of the input, for errors and reasons.
    """

    def __init__(self, timeout: float, topic: str = "needle/servo_cv") -> None:
        self._timeout = timeout
        self._topic = topic
        self._publishers = PublisherCounter()
        self._velocity = np.zeros(2)
        self._stamp = -math.inf
        self._arrival = -math.inf

    def update(self, velocity: Vector, stamp: float, number: int, now: float, arrival: float) -> None:
        """Accept a command, or reject it and keep the last one until that is stale.

        Args:
            velocity: of the needle's tip in the dish plane, shape (2,) [m/s].
            stamp: when it was made [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].

        Raises:
            InvalidInputError: the command is not finite, too old, from the future, older than the last one, or
                there are several publishers.
        """
        publishers = self._publishers.update(number, arrival)
        if not np.all(np.isfinite(velocity)):
            raise InvalidInputError(f"{self._topic}.twist.linear", velocity.tolist(), "finite numbers [m/s]")
        check_stamp(self._topic, stamp, now, self._stamp, self._timeout)
        if publishers > 1:
            raise InvalidInputError(self._topic, f"{publishers} publishers at once", "one")
        self._velocity = np.array(velocity, dtype=np.float64)
        self._stamp, self._arrival = stamp, arrival

    def clear(self) -> None:
        """Drop the last command; only later ones are valid."""
        self._arrival = -math.inf

    @property
    def velocity(self) -> Vector:
        """The last valid command, shape (2,) [m/s]."""
        return self._velocity

    @property
    def stamp(self) -> float:
        """Stamp of the last valid command [s], -inf before the first."""
        return self._stamp

    def has_conflict(self, arrival: float) -> bool:
        """Return whether several publishers are active at a monotonic time [s]."""
        return self._publishers.count(arrival) > 1

    @property
    def is_empty(self) -> bool:
        """Whether there was no valid command since the last `clear`."""
        return self._arrival == -math.inf

    def stale_reason(self, now: float, arrival: float) -> str:
        """Return why there is no valid command at a time; empty if there is one.

        A command becomes stale by its stamp, which includes its transport, and by its arrival, as the stamps'
        clock may stand still.

        Args:
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        if self.has_conflict(arrival):
            return f"several publishers of {self._topic} at once"
        if self._arrival == -math.inf:
            return "no command yet"
        age = max(arrival - self._arrival, now - self._stamp)
        return "" if age <= self._timeout else f"no command for {self._timeout:g} s"
