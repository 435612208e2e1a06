"""Checks of stamped inputs: the age and order of stamps, and the number of publishers on a topic."""

from __future__ import annotations

from magnetosuture_thread.errors import InvalidInputError

CLOCK_TOLERANCE = 0.05  # s; clocks of two machines may differ by this much
SILENCE_TIMEOUT = 0.5  # s; a publisher without a message for this long is gone
MAX_GAP = 100  # consecutive messages that may get lost


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
