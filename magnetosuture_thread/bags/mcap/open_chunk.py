"""A chunk that is being filled, and the bytes that records are written as."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from itertools import chain
from typing import Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema

from magnetosuture_thread.bags.mcap.layout import HEAD, MESSAGE

_MESSAGE = struct.Struct("<BQHIQQ")  # the head of a message's record, and what is before the data
_INDEX = struct.Struct("<BQHI")  # the head of an index of messages, its channel, and its size


class Waiting(NamedTuple):
    """A message that waits: number of its channel, which one of it, time [ns], CDR bytes."""

    channel: int
    sequence: int
    time: int
    data: bytes


class Filled(NamedTuple):
    """What a chunk will hold.

    Attributes:
        data: its records, unpacked.
        entries: time and place in it of each message, by channel.
        first: time of the first message [ns].
        last: time of the last message [ns].
    """

    data: bytes
    entries: dict[int, list[tuple[int, int]]]
    first: int
    last: int


class OpenChunk:
    """Messages that wait to be written.

    Nothing but a list that grows: whatever interrupts a recorder between two messages or within one, as Ctrl-C may,
    what waits is whole.

    Attributes:
        size: number of bytes of the messages so far.
    """

    def __init__(self) -> None:
        self._messages: list[Waiting] = []
        self._first = self._last = 0
        self.size = 0

    def __len__(self) -> int:
        """Return the number of messages that wait."""
        return len(self._messages)

    @property
    def span(self) -> int:
        """Return the time from the first message to the last [ns]."""
        return self._last - self._first

    def add(self, message: Waiting) -> None:
        """Take a message."""
        time, is_first = message.time, not self._messages
        self._messages.append(message)
        self.size += len(message.data)
        if is_first or time < self._first:
            self._first = time
        if is_first or time > self._last:
            self._last = time

    def filled(self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]) -> Filled:
        """Return what the chunk will hold: the messages, with the channels and types that they need."""
        content: list[bytes] = []
        size = 0
        entries: dict[int, list[tuple[int, int]]] = {}
        told: set[int] = set()
        for number, sequence, time, data in self._messages:
            if number not in entries:
                channel = channels[number]
                if channel.schema_id and channel.schema_id not in told:
                    content.append(as_bytes(schemas[channel.schema_id]))
                    size += len(content[-1])
                    told.add(channel.schema_id)
                content.append(as_bytes(channel))
                size += len(content[-1])
                entries[number] = []
            entries[number].append((time, size))
            content += (_MESSAGE.pack(Opcode.MESSAGE, MESSAGE.size + len(data), number, sequence, time, time), data)
            size += _MESSAGE.size + len(data)
        times = [message.time for message in self._messages]
        return Filled(b"".join(content), entries, min(times), max(times))


def index_of(channel: int, entries: list[tuple[int, int]]) -> bytes:
    """Return the record that tells time and place of a channel's messages in a chunk."""
    places = struct.pack(f"<{2 * len(entries)}Q", *chain.from_iterable(entries))
    return _INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX.size - HEAD.size + len(places), channel, len(places)) + places


def taken_from(builder: Any) -> bytes:
    """Return what a builder holds, and empty it."""
    data: bytes = builder.end()  # which has no types
    return data


def as_bytes(*records: McapRecord) -> bytes:
    """Return records as they are in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return taken_from(builder)
