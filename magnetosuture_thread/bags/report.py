"""Report on the content of a bag: topics, rates, gaps, frames and damage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.storage import CDR
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.messages.cdr import stamp_and_frame


@dataclass
class TopicReport:
    """Report on a topic.

    Attributes:
        topic: its name, remapped.
        types: of its messages; more than one is an error of the recorder.
        count: number of messages.
        first: when the first was recorded [s since the bag's start]; None without messages.
        last: when the last was [s since the bag's start].
        gap: greatest time between two messages [s].
        backward: number of messages whose stamp is before that of the one before them.
        unreadable: number of messages whose stamp cannot be read although their type has one.
        frames: frame ids of the messages.
        known: whether our graph uses the topic, and at least one of its messages can be used.
        problem: why it does not, although it has the name of one of our topics.
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
        """Mean rate of messages [Hz]; None without a second message."""
        if self.first is None or self.last is None or self.last <= self.first:
            return None
        return (self.count - 1) / (self.last - self.first)

    def add(self, record: RecordedMessage, time: float, *, is_cdr: bool) -> None:
        """Add a message that was recorded at a time [s since the bag's start]."""
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
        """Return the report in SI units; null where there is no value."""
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
    """Report on a bag.

    Attributes:
        bag: the bag.
        topics: by name.
        refused: number of messages that cannot be decompressed, by reason.
    """

    bag: Bag
    topics: list[TopicReport]
    refused: Counter[str]

    def to_json(self) -> dict[str, Any]:
        """Return the report in SI units; null where there is no value."""
        damage = self.bag.damage
        return {
            "bag": str(self.bag.path),
            "start_s": self.bag.start * 1e-9,
            "duration_s": self.bag.duration,
            "messages": sum(self.bag.counts.values()),
            "notes": self.bag.notes,
            "files": self.bag.facts,
            "unchecked": self.bag.unchecked or None,
            "unverified": self.bag.unverified or None,
            "remarks": self.bag.remarks,
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
                        "file": region.file,
                        "start_byte": region.start,
                        "end_byte": region.end,
                        "what": region.what,
                        "first_s": None if region.first is None else region.first * 1e-9,
                        "last_s": None if region.last is None else region.last * 1e-9,
                    }
                    for region in damage.regions
                ],
            },
            "topics": [topic.to_json() for topic in self.topics],
        }


def inspect_bag(bag: Bag, dish_frame: str, progress: Callable[[float], None] = lambda fraction: None) -> BagReport:
    """Read all messages of a bag and report on its content.

    Args:
        bag: to inspect.
        dish_frame: name of the dish frame in the bag.
        progress: called with the completed fraction, 0 to 1.
    """
    recording = Recording(bag, dish_frame=dish_frame)
    topics: dict[str, TopicReport] = {}
    for name in sorted(bag.counts):
        own = bag.conflicts.get(name) or (bag.topics[name],)
        problem = recording.problem_of(name)
        topics[name] = TopicReport(name, own, known=recording.uses(name) and not problem, problem=problem)
    refused: Counter[str] = Counter()
    for connection, record in bag.every_record(refused):
        time = (record.time - bag.start) * 1e-9
        topics[bag.name_of(connection)].add(record, time, is_cdr=connection.serialization == CDR)
        progress(time / max(bag.duration, 1e-9))
    return BagReport(bag, list(topics.values()), refused)
