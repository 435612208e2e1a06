"""What a file of recorded messages offers, whatever its format."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from magnetosuture_thread.bags.damage import Damage

CDR = "cdr"  # how ROS 2 writes messages


@dataclass(frozen=True)
class Definition:
    """How a bag defines a type.

    Attributes:
        type_name: for example `nav_msgs/msg/Path`.
        encoding: `ros2msg` or `ros2idl`; empty where the bag does not define it.
        text: the definition, with those of all types in it.
    """

    type_name: str
    encoding: str = ""
    text: str = ""


@dataclass(frozen=True)
class Connection:
    """What one publisher, or one kind of publisher, said on a topic.

    Attributes:
        topic: as it was recorded.
        definition: of its type.
        serialization: of its messages; `cdr` in ROS 2.
        offered: its quality of service and other words of the recorder, kept for repair.
    """

    topic: str
    definition: Definition
    serialization: str = CDR
    offered: Mapping[str, str] = field(default_factory=dict, hash=False)

    @property
    def type_name(self) -> str:
        """Return the name of its type."""
        return self.definition.type_name


class Item(NamedTuple):
    """A recorded message as it is in a file: time [ns], who said it, bytes."""

    time: int
    connection: Connection
    data: bytes


class Storage(Protocol):
    """A file of recorded messages, looked through and found readable.

    Attributes:
        path: the file.
        connections: by number.
        counts: number of messages that can be read, by connection.
        start: time of the first of them [ns]; 0 if there are none.
        end: time of the last of them [ns].
        notes: what our writer said of the bag.
        damage: what is broken; None if all is whole.
        unchecked: why damage may not have been noticed, in one line; empty if it would have been.
        facts: about the file, for a person: name and value, for example chunks and compression.
    """

    path: Path
    connections: dict[int, Connection]
    counts: dict[int, int]
    start: int
    end: int
    notes: dict[str, str]
    damage: Damage | None
    unchecked: str
    facts: dict[str, str]

    def items(self, connections: Collection[int], start: int, end: int) -> Iterator[Item]:
        """Go through the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was looked through, or cannot be read any more.
        """


def in_order(parts: Iterable[tuple[int, Callable[[], Iterator[Item]]]]) -> Iterator[Item]:
    """Merge parts into one sequence by time; of parts that do not overlap, one is in memory at a time.

    Args:
        parts: the time before which a part holds nothing, and what gives its items by time. Sorted by that time.
    """
    waiting = iter(parts)
    following = next(waiting, None)
    heap: list[tuple[int, int, Item, Iterator[Item]]] = []
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
