"""The gate that every velocity command of an input passes: checked, and timed out.

Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.sources import SourceWatch
from magnetosuture_thread.coils.stamps import check_stamp
from magnetosuture_thread.errors import InvalidInputError

Vector = NDArray[np.float64]


class CommandGate:
    """Holds the last good command of one input for as long as it is good.

    Args:
        timeout: a command is good for this long after its arrival, and its stamp may be this old [s].
        topic: of the input, for errors and reasons.
    """

    def __init__(self, timeout: float, topic: str = "needle/servo_cv") -> None:
        self._timeout = timeout
        self._topic = topic
        self._sources = SourceWatch()
        self._velocity = np.zeros(2)
        self._stamp = -math.inf
        self._arrival = -math.inf

    def accept(self, velocity: Vector, stamp: float, number: int, now: float, arrival: float) -> None:
        """Take a command, or refuse it and keep the last one until that times out.

        Args:
            velocity: of the needle's tip in the dish plane, shape (2,) [m/s].
            stamp: when it was made [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].

        Raises:
            InvalidInputError: it is not finite, too old, from the future, older than the last one, or
                somebody else commands too.
        """
        speaking = self._sources.hear(number, arrival)
        if not np.all(np.isfinite(velocity)):
            raise InvalidInputError(f"{self._topic}.twist.linear", velocity.tolist(), "finite numbers [m/s]")
        check_stamp(self._topic, stamp, now, self._stamp, self._timeout)
        if speaking > 1:
            raise InvalidInputError(self._topic, f"{speaking} publishers at once", "one")
        self._velocity = np.array(velocity, dtype=np.float64)
        self._stamp, self._arrival = stamp, arrival

    def forget(self) -> None:
        """Drop the last command: only one that comes from now on counts."""
        self._arrival = -math.inf

    @property
    def velocity(self) -> Vector:
        """The last good command, shape (2,) [m/s]."""
        return self._velocity

    @property
    def stamp(self) -> float:
        """Its stamp [s], -inf before the first."""
        return self._stamp

    def disputed(self, arrival: float) -> bool:
        """Return whether several publish at once at a monotonic time [s]."""
        return self._sources.count(arrival) > 1

    @property
    def unused(self) -> bool:
        """Whether there was no good command since the last `forget`."""
        return self._arrival == -math.inf

    def closed(self, now: float, arrival: float) -> str:
        """Say why no command is to be followed at a time; empty if one is.

        A command ends by its stamp, so that what it took to get here counts, and by its arrival, as the
        stamps' clock may stand still.

        Args:
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        if self.disputed(arrival):
            return f"several publishers of {self._topic} at once"
        if self._arrival == -math.inf:
            return "no command yet"
        good = max(arrival - self._arrival, now - self._stamp) <= self._timeout
        return "" if good else f"no command for {self._timeout:g} s"
