"""A chunk that is being filled, and the bytes that records are written as."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, McapRecord, Message, Schema


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
    """

    def __init__(self) -> None:
        self._messages: list[Message] = []
        self._size = 0
        self._first = self._last = 0

    def __len__(self) -> int:
        """Return the number of messages that wait."""
        return len(self._messages)

    @property
    def size(self) -> int:
        """Return the number of bytes of the messages so far."""
        return self._size

    @property
    def span(self) -> int:
        """Return the time from the first message to the last [ns]."""
        return self._last - self._first

    def add(self, message: Message) -> None:
        """Take a message."""
        time, is_first = message.log_time, not self._messages
        self._messages.append(message)
        self._size += len(message.data)
        self._first = time if is_first else min(self._first, time)
        self._last = time if is_first else max(self._last, time)

    def filled(self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]) -> Filled:
        """Return what the chunk will hold: the messages, with the channels and types that they need."""
        content = RecordBuilder()
        entries: dict[int, list[tuple[int, int]]] = {}
        told: set[int] = set()
        for message in self._messages:
            channel = channels[message.channel_id]
            if channel.id not in entries:
                if channel.schema_id and channel.schema_id not in told:
                    schemas[channel.schema_id].write(content)
                    told.add(channel.schema_id)
                channel.write(content)
                entries[channel.id] = []
            entries[channel.id].append((message.log_time, content.count))
            message.write(content)
        times = [message.log_time for message in self._messages]
        return Filled(taken_from(content), entries, min(times), max(times))


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
