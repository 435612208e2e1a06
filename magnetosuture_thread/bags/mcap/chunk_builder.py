"""Builds a chunk from messages, and the message indices that follow it."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from itertools import chain
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from magnetosuture_thread.bags.mcap.records import MESSAGE_HEADER, RECORD_HEADER, encode_records

_MESSAGE = struct.Struct("<BQHIQQ")  # the header of a message's record, and what is before the data
_INDEX = struct.Struct("<BQHI")  # the header of a message index, its channel, and its size


class PendingMessage(NamedTuple):
    """A message that is not written yet: channel id, sequence number, time [ns], CDR bytes."""

    channel: int
    sequence: int
    time: int
    data: bytes


class BuiltChunk(NamedTuple):
    """The content of a chunk to be written.

    Attributes:
        data: its records, uncompressed.
        entries: time and offset of each message, by channel.
        first: time of the first message [ns].
        last: time of the last message [ns].
    """

    data: bytes
    entries: dict[int, list[tuple[int, int]]]
    first: int
    last: int


class ChunkBuilder:
    """Collects messages for a chunk.

    The only state is a list that grows: whatever interrupts a recorder between two messages or within one, as Ctrl-C
    may, the messages stay complete.

    Attributes:
        size: number of bytes of the messages so far.
    """

    def __init__(self) -> None:
        self._messages: list[PendingMessage] = []
        self._first = self._last = 0
        self.size = 0

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._messages)

    @property
    def span(self) -> int:
        """Time from the first message to the last [ns]."""
        return self._last - self._first

    def add(self, message: PendingMessage) -> None:
        """Add a message."""
        time, is_first = message.time, not self._messages
        self._messages.append(message)
        self.size += len(message.data)
        if is_first or time < self._first:
            self._first = time
        if is_first or time > self._last:
            self._last = time

    def build(self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]) -> BuiltChunk:
        """Return the content of the chunk: the messages, with the channels and schemas that they need."""
        content: list[bytes] = []
        size = 0
        entries: dict[int, list[tuple[int, int]]] = {}
        defined: set[int] = set()
        for number, sequence, time, data in self._messages:
            if number not in entries:
                channel = channels[number]
                if channel.schema_id and channel.schema_id not in defined:
                    content.append(encode_records(schemas[channel.schema_id]))
                    size += len(content[-1])
                    defined.add(channel.schema_id)
                content.append(encode_records(channel))
                size += len(content[-1])
                entries[number] = []
            entries[number].append((time, size))
            length = MESSAGE_HEADER.size + len(data)
            content += (_MESSAGE.pack(Opcode.MESSAGE, length, number, sequence, time, time), data)
            size += _MESSAGE.size + len(data)
        times = [message.time for message in self._messages]
        return BuiltChunk(b"".join(content), entries, min(times), max(times))


def encode_message_index(channel: int, entries: list[tuple[int, int]]) -> bytes:
    """Return the record with time and offset of each message of a channel in a chunk."""
    offsets = struct.pack(f"<{2 * len(entries)}Q", *chain.from_iterable(entries))
    length = _INDEX.size - RECORD_HEADER.size + len(offsets)
    return _INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, len(offsets)) + offsets
