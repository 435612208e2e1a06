"""How many publishers speak on a topic at once, told from the numbers that the middleware gives their messages."""

from __future__ import annotations

SILENCE = 0.5  # s; who has said nothing for this long does not speak any more
GAP = 100  # messages in a row that may get lost


class SourceWatch:
    """Counts who speaks. Two that steer one needle would each undo what the other does.

    Messages do not say who sent them, but each publisher numbers its own from 1 on. A message goes on with
    the one whose last number is just before its own; if there is none, somebody else has begun to speak.
    """

    def __init__(self) -> None:
        self._speakers: list[tuple[int, float]] = []  # last number, and when

    def hear(self, number: int, arrival: float) -> int:
        """Take note of a message and return how many speak now.

        Args:
            number: of the message, counted by its publisher.
            arrival: a monotonic time [s].
        """
        self._forget(arrival)
        before = [speaker for speaker in self._speakers if 0 < number - speaker[0] <= GAP]
        if before:
            self._speakers.remove(max(before))
        self._speakers.append((number, arrival))
        return len(self._speakers)

    def count(self, arrival: float) -> int:
        """Return how many speak at a monotonic time [s]."""
        self._forget(arrival)
        return len(self._speakers)

    def _forget(self, arrival: float) -> None:
        self._speakers = [speaker for speaker in self._speakers if arrival - speaker[1] <= SILENCE]
