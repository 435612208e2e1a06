"""Counts what a replay plays, what the graph makes of it, and what gets lost on the way."""

from __future__ import annotations

from collections import Counter

from magnetosuture_thread.interface import CAMERA, MARGINS, NEEDLE_POSE, PREDICTED_THREAD
from magnetosuture_thread.nodes.topics import DIAGNOSTICS, UNNUMBERED

FRAMES = frozenset(channel.name for channel in CAMERA.values())


class Losses:
    """Keeps count of a replay.

    Attributes:
        played: messages published, by topic.
        frames_taken: camera frames that the tracker says it has taken.
    """

    def __init__(self) -> None:
        self.played: Counter[str] = Counter()
        self.frames_taken = 0
        self._refused: dict[str, int] = {}
        self._poses: set[int] = set()
        self._answered: set[int] = set()
        self._numbers: dict[str, int] = {}
        self._taken: Counter[str] = Counter()

    @property
    def frames_played(self) -> int:
        """Return the camera frames published."""
        return sum(count for topic, count in self.played.items() if topic in FRAMES)

    @property
    def frames_waiting(self) -> bool:
        """Whether the tracker has not taken all frames yet."""
        return self.frames_taken < self.frames_played

    @property
    def poses_waiting(self) -> bool:
        """Whether a pose has not been answered yet; one that the model refuses never is."""
        return bool(self._poses - self._answered)

    def heard(self, topic: str, stamp: int | None, number: int | None) -> None:
        """Count an output of the graph.

        Args:
            topic: its name.
            stamp: of the frame that it is about [ns].
            number: that its publisher gave it, if the middleware tells.
        """
        if number is not None and number != UNNUMBERED:
            self._numbers[topic] = max(self._numbers.get(topic, 0), number)
            self._taken[topic] += 1
        if stamp is not None and topic == NEEDLE_POSE.name:
            self._poses.add(stamp)
        if stamp is not None and topic in (PREDICTED_THREAD.name, MARGINS.name):
            self._answered.add(stamp)

    def count_diagnostics(self, data: bytes) -> None:
        """Count a node's status on /diagnostics."""
        for status in DIAGNOSTICS.decode(data).status:
            values = {value.key: value.value for value in status.values}
            node = status.name.split(":")[0]
            if node == "vision_tracker":
                self.frames_taken = max(self.frames_taken, int(values.get("frames", "0")))
            self._refused[node] = int(values.get("refused", "0"))

    def dropped(self) -> dict[str, int]:
        """Return how many messages got lost, by the way on which."""
        unanswered = len(self._poses - self._answered) - self._refused.get("thread_model", 0)
        unheard = sum(max(0, number - self._taken[topic]) for topic, number in self._numbers.items())
        counts = {"poses without an answer": max(0, unanswered), "outputs lost by the recording": unheard}
        if self.frames_played:
            counts = {"frames not taken by vision_tracker": self.frames_played - self.frames_taken, **counts}
        return counts
