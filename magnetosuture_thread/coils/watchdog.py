"""Checks and timeouts of the bridge's inputs: stamps, publishers, velocity commands, the thread model's margins.

Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.texts import shortened

Vector = NDArray[np.float64]

CLOCK_TOLERANCE = 0.05  # s; clocks of two machines may differ by this much
SILENCE_TIMEOUT = 0.5  # s; a publisher without a message for this long is gone
MAX_GAP = 100  # consecutive messages that may get lost
AGE_WINDOW = 5.0  # s
SCENE_GRACE_PERIOD = 0.5  # s for which model and bridge may be on different versions of the scene during a change


def check_stamp(topic: str, stamp: float, now: float, last: float, max_age: float) -> None:
    """Reject a message with an invalid stamp.

    Args:
        topic: of the message, for the error.
        stamp: of the message [s].
        now: the same clock now [s].
        last: stamp of the previous message, -inf if there was none. One from the future, as after time was set
            back, is not compared with [s].
        max_age: maximum age of the stamp [s].

    Raises:
        InvalidInputError: the stamp is not set, too old, from the future, or older than the last one.
    """
    field = f"{topic}.header.stamp"
    if stamp <= 0.0 or now <= 0.0:
        raise InvalidInputError(
            field, f"{stamp:g} s at the time {now:g} s", "a time: 0 is none in ROS, as before /clock"
        )
    if now - stamp > max_age:
        raise InvalidInputError(field, f"{now - stamp:.3f} s old", f"at most {max_age:g} s")
    if stamp - now > CLOCK_TOLERANCE:
        raise InvalidInputError(field, f"{stamp - now:.3f} s ahead", f"at most {CLOCK_TOLERANCE:g} s")
    if stamp < last <= now + CLOCK_TOLERANCE:
        raise InvalidInputError(field, f"{stamp:.6f} s", f"no earlier than the last one's {last:.6f} s")


class StampAges:
    """Keeps how old messages were when they arrived, by topic.

    The minimum age of the last seconds is the network's shortest delay plus how far the sender's clock is behind; a
    negative one says that it is ahead, by that much at least.
    """

    def __init__(self) -> None:
        self._ages: dict[str, deque[tuple[float, float]]] = {}

    def add(self, topic: str, age: float, arrival: float) -> None:
        """Register a message, accepted or not.

        Args:
            topic: of the message.
            age: time of its arrival minus its stamp, by the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        entries = self._ages.setdefault(topic, deque())
        while entries and entries[-1][1] >= age:  # later and less: those before will not be the minimum again
            entries.pop()
        entries.append((arrival, age))
        self._drop_old(entries, arrival)

    def minimum(self, arrival: float) -> dict[str, float]:
        """Return the minimum age of each topic with a message in the last `AGE_WINDOW` before a monotonic time [s]."""
        for entries in self._ages.values():
            self._drop_old(entries, arrival)
        return {topic: entries[0][1] for topic, entries in self._ages.items() if entries}

    @staticmethod
    def _drop_old(entries: deque[tuple[float, float]], arrival: float) -> None:
        while entries and arrival - entries[0][0] > AGE_WINDOW:
            entries.popleft()


class PublisherCounter:
    """Counts the publishers that are active on a topic, by the sequence numbers of their messages.

    Two publishers that command one needle would work against each other. Messages do not name their sender, but
    each publisher numbers its own from 1 on. A message continues the publisher whose last number is just before
    its own; without such a publisher it comes from a new one.
    """

    def __init__(self) -> None:
        self._publishers: list[tuple[int, float]] = []  # last number, and its arrival

    def update(self, number: int, arrival: float) -> int:
        """Register a message and return the number of active publishers.

        Args:
            number: of the message, counted by its publisher.
            arrival: a monotonic time [s].
        """
        self._drop_silent(arrival)
        before = [publisher for publisher in self._publishers if 0 < number - publisher[0] <= MAX_GAP]
        if before:
            self._publishers.remove(max(before))
        self._publishers.append((number, arrival))
        return len(self._publishers)

    def count(self, arrival: float) -> int:
        """Return the number of active publishers at a monotonic time [s]."""
        self._drop_silent(arrival)
        return len(self._publishers)

    def _drop_silent(self, arrival: float) -> None:
        self._publishers = [entry for entry in self._publishers if arrival - entry[1] <= SILENCE_TIMEOUT]


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


class PredictionMonitor:
    """Keeps the last valid margins of the thread model. Pure: times come in, in seconds.

    Args:
        timeout: margins are valid for this long after their stamp and their arrival [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._stamp = self._arrival = -math.inf  # of the last valid margins
        self._last_arrival = -math.inf  # of the last margins, valid or not
        self._slowdown = 1.0
        self._version: str | None = None
        self._agreed = math.inf  # when model and bridge last had one version; initially when both were known

    def update(self, stamp: float, valid: bool, slowdown: float, scene_version: str, arrival: float) -> None:
        """Register the model's margins; invalid ones leave the last valid ones until these are stale.

        Raises:
            InvalidInputError: slowdown or stamp is out of range.
        """
        if valid and not (0.0 <= slowdown <= 1.0):
            raise InvalidInputError("thread/margins.slowdown", slowdown, "a factor from 0 to 1")
        if not math.isfinite(stamp):
            raise InvalidInputError("thread/margins.header.stamp", stamp, "a time [s]")
        self._last_arrival, self._version = arrival, shortened(scene_version)
        if valid:
            self._stamp, self._arrival, self._slowdown = stamp, arrival, slowdown

    def stale_reason(self, now: float, arrival: float) -> str:
        """Return why there is no prediction at a time of the stamps' clock and a monotonic time; empty if there is."""
        if self._arrival == -math.inf:
            return "no thread prediction yet" if self._last_arrival == -math.inf else "no valid thread prediction yet"
        age = max(arrival - self._arrival, now - self._stamp)
        return "" if age <= self._timeout else f"no thread prediction for {self._timeout:g} s"

    @property
    def slowdown(self) -> float:
        """The last valid factor on the needle's speed."""
        return self._slowdown

    def scene_mismatch(self, scene_version: str, arrival: float) -> str:
        """Return a text if the model has had another scene for too long; empty if not, or if the model is silent.

        Args:
            scene_version: the bridge's.
            arrival: a monotonic time [s].
        """
        if self._version is None or arrival - self._last_arrival > max(self._timeout, SCENE_GRACE_PERIOD):
            return ""
        if self._version == scene_version or self._agreed == math.inf:
            self._agreed = arrival
        if arrival - self._agreed <= SCENE_GRACE_PERIOD:
            return ""
        return f"scene: thread_model has {self._version or 'none'}, coil_bridge has {scene_version or 'none'}"
