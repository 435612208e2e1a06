"""Common interface of the storage formats: connections, messages in the order of time, and reports of damage."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from mcap.records import Attachment, Metadata


@dataclass(frozen=True)
class CorruptRegion:
    """A corrupt region of a file.

    Attributes:
        file: its name.
        start: first corrupt byte.
        end: the byte after the last.
        what: description, for example `a chunk with a wrong checksum`.
        first: messages may be missing from this time on [ns]; None where it is unknown or none are missing.
        last: ... to this time [ns].
    """

    file: str
    start: int
    end: int
    what: str
    first: int | None = None
    last: int | None = None

    def __str__(self) -> str:
        """Return file, bytes and description in one line."""
        where = f"byte {self.start}" if self.end <= self.start else f"bytes {self.start} to {self.end}"
        return f"{self.file}, {where}: {self.what}"


@dataclass(frozen=True)
class DamageReport:
    """All corrupt regions of a bag and what was lost.

    Attributes:
        regions: the corrupt regions.
        chunks: chunks known to be lost; more may be lost where the end of the file is missing.
        bytes: bytes that could not be used.
        messages: messages lost; None where the number is unknown.
    """

    regions: tuple[CorruptRegion, ...]
    chunks: int
    bytes: int
    messages: int | None

    def __str__(self) -> str:
        """Return a summary in one line."""
        others = len(self.regions) - 1
        where = f"{self.regions[0]}" + (f", and {others} other place{'s' * (others > 1)}" if others else "")
        if self.messages == 0:
            return f"is damaged ({where}), but no message is lost"
        lost = "an unknown number of messages" if self.messages is None else pluralize(self.messages, "message")
        chunks = f" in {pluralize(self.chunks, 'chunk')}" if self.chunks else ""
        verb = "is" if self.messages in (1, None) else "are"
        return f"is damaged ({where}): {lost}{chunks} {verb} lost, all else is read"


def pluralize(count: int, noun: str) -> str:
    """Return a count with its noun, for example `2 chunks`."""
    return f"{count} {noun}{'s' * (count != 1)}"


def merge_reports(reports: Iterable[DamageReport | None]) -> DamageReport | None:
    """Return the damage of several files as one report; None if all files are intact."""
    damaged = [report for report in reports if report is not None]
    if not damaged:
        return None
    lost = [report.messages for report in damaged]
    known = [count for count in lost if count is not None]
    return DamageReport(
        regions=tuple(region for report in damaged for region in report.regions),
        chunks=sum(report.chunks for report in damaged),
        bytes=sum(report.bytes for report in damaged),
        messages=sum(known) if len(known) == len(lost) else None,
    )


CDR = "cdr"  # how ROS 2 writes messages
ROS2_PROFILE = "ros2"  # of mcap files of ROS 2


@dataclass(frozen=True)
class MessageDefinition:
    """The definition of a message type in a bag.

    Attributes:
        type_name: for example `nav_msgs/msg/Path`.
        encoding: `ros2msg` or `ros2idl`; empty where the bag does not define it.
        text: the definition, with those of all types in it. Of another encoding it may be binary: bytes that are no
            UTF-8 are kept as surrogates (`surrogateescape`), so that it can be written as it was.
    """

    type_name: str
    encoding: str = ""
    text: str = ""


@dataclass(frozen=True)
class Connection:
    """The messages of one publisher, or of one kind of publisher, on a topic.

    Attributes:
        topic: as it was recorded.
        definition: of its type.
        serialization: of its messages; `cdr` in ROS 2.
        metadata: quality of service and other entries of the recorder, kept for repair.
    """

    topic: str
    definition: MessageDefinition
    serialization: str = CDR
    metadata: Mapping[str, str] = field(default_factory=dict, hash=False)

    @property
    def type_name(self) -> str:
        """Return the name of its type."""
        return self.definition.type_name


class StoredMessage(NamedTuple):
    """A message as it is stored in a file.

    Attributes:
        time: when it was recorded [ns].
        connection: that it was recorded from.
        data: as stored, which may be packed.
        publish_time: when it was published [ns]; None where the format has no such time.
        sequence: number given by its publisher; None where the format has none.
    """

    time: int
    connection: Connection
    data: bytes
    publish_time: int | None = None
    sequence: int | None = None


class BagStorage(Protocol):
    """A file of recorded messages, verified and open for reading.

    Attributes:
        path: the file.
        connections: by number.
        counts: number of messages that can be read, by connection.
        start: time of the first of them [ns]; 0 if there are none.
        end: time of the last of them [ns].
        notes: notes of our writer.
        damage: what is corrupt and lost; None if nothing is.
        unchecked: why damage may not have been noticed, in one line; empty if it would have been.
        facts: properties of the file for a person, for example chunks and compression.
        profile: which conventions the file follows, as mcap names them.
        library: that wrote it; empty where the format does not say.
    """

    path: Path
    connections: dict[int, Connection]
    counts: dict[int, int]
    start: int
    end: int
    notes: dict[str, str]
    damage: DamageReport | None
    unchecked: str
    facts: dict[str, str]
    profile: str
    library: str

    def extras(self, dropped: Counter[str]) -> Iterator[Attachment | Metadata]:
        """Yield attachments and foreign metadata records; what cannot be vouched for is counted by reason."""

    def messages(self, connections: Collection[int], start: int, end: int) -> Iterator[StoredMessage]:
        """Yield the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was verified, or cannot be read any more.
        """


def merge_by_time(parts: Iterable[tuple[int, Callable[[], Iterator[StoredMessage]]]]) -> Iterator[StoredMessage]:
    """Yield the messages of all parts by time; of parts that do not overlap, one is in memory at a time.

    Args:
        parts: start time of each part, and a function that yields its messages by time. Sorted by start time.
    """
    waiting = iter(parts)
    following = next(waiting, None)
    heap: list[tuple[int, int, StoredMessage, Iterator[StoredMessage]]] = []
    number = 0
    while heap or following is not None:
        while following is not None and (not heap or following[0] <= heap[0][0]):
            items = following[1]()
            first = next(items, None)
            if first is not None:
                heapq.heappush(heap, (first.time, number, first, items))
            number += 1
            following = next(waiting, None)
        if not heap:
            continue
        _, part, item, items = heapq.heappop(heap)
        yield item
        # What comes before anything of another part needs no sorting.
        until = min(heap[0][0] if heap else math.inf, following[0] if following is not None else math.inf)
        for item in items:
            if item.time >= until:
                heapq.heappush(heap, (item.time, part, item, items))
                break
            yield item
