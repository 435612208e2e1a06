"""What was found in an mcap file: its intact pieces, the channels, and what is broken."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.records import Channel, Metadata, Schema

from magnetosuture_thread.bags.damage import Place


class Piece(NamedTuple):
    """A chunk, or a run of messages that are in no chunk.

    Attributes:
        offset: where its bytes begin: those after a chunk's head, or the first message's head.
        length: number of bytes.
        is_chunk: whether it is a chunk.
        checked: whether it has a checksum of its own.
        crc: checksum of the records in it, calculated.
        size: bytes of the records in it.
        start: time of its first message [ns].
        end: time of its last message [ns].
        channels: that have messages in it.
    """

    offset: int
    length: int
    is_chunk: bool
    checked: bool
    crc: int
    size: int
    start: int
    end: int
    channels: frozenset[int]


@dataclass
class Told:
    """Channels and their types as they are told in some part of a file.

    Attributes:
        schemas: by number.
        channels: by number.
        schemas_in_two_ways: numbers of those that are told differently again; there should be none.
        channels_in_two_ways: numbers of those.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas_in_two_ways: set[int] = field(default_factory=set)
    channels_in_two_ways: set[int] = field(default_factory=set)

    def tell(self, record: Schema | Channel) -> None:
        """Take a channel or a type."""
        if isinstance(record, Schema):
            if self.schemas.setdefault(record.id, record) != record:
                self.schemas_in_two_ways.add(record.id)
        elif self.channels.setdefault(record.id, record) != record:
            self.channels_in_two_ways.add(record.id)


@dataclass
class Findings:
    """What a walk through a file found.

    Attributes:
        pieces: in the file's order.
        counts: messages by channel, in all pieces.
        unchecked_counts: those of them in pieces without a checksum.
        told: of channels and their types, by pieces with a checksum (True) and by all else (False).
        metadata: records of words about the file.
        compressions: of the chunks.
        broken: places that could not be read.
        chunks_lost: number of chunks among them, as far as it is seen.
        ended: whether the data's last record was reached.
        stopped: where the walk came to its end.
        data_crc: checksum of all data that the file tells; 0 if it tells none.
        data_is_right: whether that is right.
        private: whether there are records of a kind that only their writer knows.
    """

    pieces: list[Piece] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    unchecked_counts: Counter[int] = field(default_factory=Counter)
    told: dict[bool, Told] = field(default_factory=lambda: {True: Told(), False: Told()})
    metadata: list[Metadata] = field(default_factory=list)
    compressions: set[str] = field(default_factory=set)
    broken: list[Place] = field(default_factory=list)
    chunks_lost: int = 0
    ended: bool = False
    stopped: int = 0
    data_crc: int = 0
    data_is_right: bool = False
    private: bool = False

    def tell(self, record: Schema | Channel, checked: bool) -> None:
        """Take what a piece tells of a channel or its type."""
        self.told[checked].tell(record)
