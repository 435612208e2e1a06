"""What a bag holds, topic by topic, and what is odd about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from magnetosuture_thread.bags.reader import Bag, Record
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.storage import CDR
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.messages.cdr import stamp_and_frame


@dataclass
class TopicReport:
    """What was said on a topic.

    Attributes:
        topic: its name, remapped.
        types: of its messages; more than one is an error of the recorder's.
        count: number of messages.
        first: when the first was recorded [s since the bag's start]; None without messages.
        last: when the last was [s since the bag's start].
        gap: greatest time between two messages [s].
        backward: number of messages whose stamp is before that of the one before them.
        unreadable: number of messages whose stamp cannot be read though their type has one.
        frames: that the messages are in, as far as they have any.
        known: whether our graph takes it.
        problem: why it does not, though it has the name of one of our topics.
    """

    topic: str
    types: tuple[str, ...]
    count: int = 0
    first: float | None = None
    last: float | None = None
    gap: float = 0.0
    backward: int = 0
    unreadable: int = 0
    frames: set[str] = field(default_factory=set)
    known: bool = False
    problem: str = ""
    _stamp: int | None = None

    @property
    def rate(self) -> float | None:
        """Return the mean number of messages a second; None where there is no second message."""
        if self.first is None or self.last is None or self.last <= self.first:
            return None
        return (self.count - 1) / (self.last - self.first)

    def take(self, record: Record, time: float, *, is_cdr: bool) -> None:
        """Take a message that was recorded at a time [s since the bag's start]."""
        self.count += 1
        if self.last is not None:
            self.gap = max(self.gap, time - self.last)
        self.first = time if self.first is None else self.first
        self.last = time
        if not is_cdr or not record.decoder.has_header():
            return
        try:
            stamp, frame = stamp_and_frame(record.topic, record.data)
        except BagError:
            self.unreadable += 1
            return
        self.frames.add(frame)
        self.backward += self._stamp is not None and stamp < self._stamp
        self._stamp = stamp

    def to_json(self) -> dict[str, Any]:
        """Return what is written of it, in SI units; null for what has no value."""
        return {
            "topic": self.topic,
            "types": list(self.types),
            "messages": self.count,
            "rate_hz": self.rate,
            "first_s": self.first,
            "last_s": self.last,
            "greatest_gap_s": self.gap if self.count > 1 else None,
            "stamps_going_back": self.backward,
            "unreadable_stamps": self.unreadable,
            "frames": sorted(self.frames),
            "known": self.known,
            "problem": self.problem or None,
        }


@dataclass(frozen=True)
class BagReport:
    """What a bag holds.

    Attributes:
        bag: that was looked through.
        topics: by name.
        refused: how many messages cannot be unpacked, by the reason.
    """

    bag: Bag
    topics: list[TopicReport]
    refused: Counter[str]

    def to_json(self) -> dict[str, Any]:
        """Return what is written of it, in SI units; null for what has no value."""
        damage = self.bag.damage
        return {
            "bag": str(self.bag.path),
            "start_s": self.bag.start * 1e-9,
            "duration_s": self.bag.duration,
            "messages": sum(self.bag.counts.values()),
            "notes": self.bag.notes,
            "files": self.bag.facts,
            "unchecked": self.bag.unchecked or None,
            "refused": dict(self.refused),
            "damage": None
            if damage is None
            else {
                "text": str(damage),
                "chunks_lost": damage.chunks,
                "bytes_lost": damage.bytes,
                "messages_lost": damage.messages,
                "places": [
                    {
                        "file": place.file,
                        "start_byte": place.start,
                        "end_byte": place.end,
                        "what": place.what,
                        "first_s": None if place.first is None else place.first * 1e-9,
                        "last_s": None if place.last is None else place.last * 1e-9,
                    }
                    for place in damage.places
                ],
            },
            "topics": [topic.to_json() for topic in self.topics],
        }


def report(bag: Bag, dish_frame: str, progress: Callable[[float], None] = lambda share: None) -> BagReport:
    """Go through all messages of a bag, and say what it holds.

    Args:
        bag: to look through.
        dish_frame: name of its frame that is the dish's.
        progress: called with the share done, 0 to 1.
    """
    recording = Recording(bag, dish_frame=dish_frame)
    topics: dict[str, TopicReport] = {}
    for name in sorted(bag.counts):
        own = bag.conflicts.get(name) or (bag.topics[name],)
        topics[name] = TopicReport(name, own, known=recording.takes(name), problem=recording.problem_of(name))
    refused: Counter[str] = Counter()
    for connection, record in bag.every_record(refused):
        time = (record.time - bag.start) * 1e-9
        topics[bag.name_of(connection)].take(record, time, is_cdr=connection.serialization == CDR)
        progress(time / max(bag.duration, 1e-9))
    return BagReport(bag, list(topics.values()), refused)
