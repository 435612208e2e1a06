"""Writes an mcap file in self-contained chunks.

Every chunk has a checksum and repeats the channels and schemas of its messages, so that damage to another chunk or to
the end of the file does not make it unreadable. The file on the disk ends with a complete chunk at any time: a chunk is
written in one call, and one that does not fit is truncated again.

The records are those of the package `mcap`. Its writer is not used: it writes a channel once in a file, so that a chunk
is useless without another; and it changes its counts and index before its bytes are on the disk, so that after a full
disk or Ctrl-C they do not match the file.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import BinaryIO, NamedTuple

import zstandard
from mcap import records as mcap_records
from mcap.opcode import Opcode

from magnetosuture_thread.bags.mcap.records import MAGIC, MESSAGE_HEADER, RECORD_HEADER, encode_records
from magnetosuture_thread.bags.storage import ROS2_PROFILE, Connection, MessageDefinition

LIBRARY = "magnetosuture_thread"  # in the header of the file
_MESSAGE = struct.Struct("<BQHIQQ")  # the header of a message's record, and what is before the data
_INDEX = struct.Struct("<BQHI")  # the header of a message index, its channel, and its size


class PendingMessage(NamedTuple):
    """A message that is not written yet: channel id, sequence number, times of recording and publishing [ns], bytes."""

    channel: int
    sequence: int
    time: int
    publish_time: int
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

    def build(
        self, channels: Mapping[int, mcap_records.Channel], schemas: Mapping[int, mcap_records.Schema]
    ) -> BuiltChunk:
        """Return the content of the chunk: the messages, with the channels and schemas that they need."""
        content: list[bytes] = []
        size = 0
        entries: dict[int, list[tuple[int, int]]] = {}
        defined: set[int] = set()
        for number, sequence, time, publish_time, data in self._messages:
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
            content += (_MESSAGE.pack(Opcode.MESSAGE, length, number, sequence, time, publish_time), data)
            size += _MESSAGE.size + len(data)
        times = [message.time for message in self._messages]
        return BuiltChunk(b"".join(content), entries, min(times), max(times))


def encode_message_index(channel: int, entries: list[tuple[int, int]]) -> bytes:
    """Return the record with time and offset of each message of a channel in a chunk."""
    offsets = struct.pack(f"<{2 * len(entries)}Q", *chain.from_iterable(entries))
    length = _INDEX.size - RECORD_HEADER.size + len(offsets)
    return _INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, len(offsets)) + offsets


MAX_CHUNK_BYTES = 256 * 1024  # of messages, uncompressed
MAX_CHUNK_SPAN = 2_000_000_000  # ns, from first to last message; lost if the recorder is killed
MAX_SEQUENCE = (1 << 32) - 1
MAX_INDEX_BYTES = 400  # of the summary, for one chunk


@dataclass(frozen=True)
class WriterState:
    """What is on the disk and what is pending; replaced as one, so that no interruption leaves half of a change.

    Attributes:
        size: bytes on the disk, all of them complete records.
        crc: their checksum.
        chunks: number of chunks among them.
        counts: messages in these, by channel.
        start: time of the first of them [ns]; None if there are none.
        end: time of the last of them [ns].
        pending: messages for the next chunk.
    """

    size: int
    crc: int
    chunks: int
    counts: Counter[int]
    start: int | None
    end: int
    pending: ChunkBuilder


class McapWriter:
    """An mcap file being written.

    Args:
        stream: of the file, without a buffer.
        metadata: metadata records by name, written at the head of the file, where truncation leaves them.
        profile: which conventions the file follows.

    Attributes:
        state: what is on the disk and what is pending.

    Raises:
        OSError: the disk is full, or fails.
    """

    def __init__(
        self, stream: BinaryIO, metadata: Mapping[str, Mapping[str, str]], profile: str = ROS2_PROFILE
    ) -> None:
        self._stream = stream
        self._schemas: dict[int, mcap_records.Schema] = {}
        self._channels: dict[int, mcap_records.Channel] = {}
        self._numbers: dict[object, int] = {}  # of schemas, by their definition
        self._sequences: Counter[int] = Counter()
        self._index: list[bytes] = []  # entries of the chunk index
        self._compressor = zstandard.ZstdCompressor()
        self.state = WriterState(0, 0, 0, Counter(), None, 0, ChunkBuilder())
        self.state = self._append(MAGIC + encode_records(mcap_records.Header(profile, LIBRARY)))
        self._metadata_index: list[mcap_records.MetadataIndex] = []
        self._attachment_index: list[mcap_records.AttachmentIndex] = []
        self._write_metadata(metadata)

    def add_channel(self, connection: Connection) -> int:
        """Define a channel and return its id."""
        definition, schema = connection.definition, 0
        if definition != MessageDefinition(""):
            schema = self._numbers.setdefault(definition, len(self._numbers) + 1)
            self._schemas[schema] = mcap_records.Schema(
                schema, definition.text.encode("utf-8", "surrogateescape"), definition.encoding, definition.type_name
            )
        number = len(self._channels) + 1
        self._channels[number] = mcap_records.Channel(
            number, connection.topic, connection.serialization, dict(connection.metadata), schema
        )
        return number

    def add_message(
        self, channel: int, time: int, data: bytes, *, publish_time: int | None = None, sequence: int | None = None
    ) -> bool:
        """Add a message, and return whether a chunk was written with it.

        Args:
            channel: of the message.
            time: when it was recorded [ns].
            data: its bytes.
            publish_time: when it was published [ns]; the time of recording if None.
            sequence: its number; one more than that of the last on the channel if None.

        Raises:
            OSError: as `flush`.
        """
        pending = self.state.pending
        sequence = self._sequences[channel] if sequence is None else sequence
        pending.add(PendingMessage(channel, sequence, time, time if publish_time is None else publish_time, data))
        self._sequences[channel] = (sequence + 1) & MAX_SEQUENCE
        is_full = pending.size > MAX_CHUNK_BYTES or pending.span > MAX_CHUNK_SPAN
        if is_full:
            self.flush()
        return is_full

    def flush(self) -> None:
        """Write the messages so far to the disk.

        Raises:
            OSError: they are dropped, and the file ends with the last complete chunk before them.
        """
        before = self.state
        if not before.pending:
            return
        content, entries, first, last = before.pending.build(self._channels, self._schemas)
        compressed = self._compressor.compress(content)
        body = encode_records(mcap_records.Chunk("zstd", compressed, last, first, zlib.crc32(content), len(content)))
        indices, offsets = b"", dict[int, int]()
        for channel, messages in entries.items():
            offsets[channel] = before.size + len(body) + len(indices)
            indices += encode_message_index(channel, messages)
        entry = mcap_records.ChunkIndex(
            chunk_length=len(body),
            chunk_start_offset=before.size,
            compression="zstd",
            compressed_size=len(compressed),
            message_end_time=last,
            message_index_length=len(indices),
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=len(content),
        )
        try:
            after = self._append(body + indices)
        except OSError:
            self.state = replace(before, pending=ChunkBuilder())
            raise
        del self._index[before.chunks :]  # left there by an interruption
        self._index.append(encode_records(entry))
        self.state = replace(
            after,
            chunks=before.chunks + 1,
            counts=before.counts + Counter({channel: len(messages) for channel, messages in entries.items()}),
            start=first if before.start is None else min(before.start, first),
            end=max(before.end, last),
            pending=ChunkBuilder(),
        )

    def finish(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """Write more metadata and the summary, and close the file; all messages must be flushed before.

        Raises:
            OSError: the file ends with the last complete chunk.
        """
        chunks = self.state
        try:
            self._write_metadata(metadata)
            self.state = self._append(encode_records(mcap_records.DataEnd(self.state.crc)))
            self.state = self._append(self._summary())
            os.fsync(self._stream.fileno())
        except OSError:
            self.state = chunks
            self._truncate()
            raise
        self._stream.close()

    def abandon(self) -> None:
        """Close the file without a summary: it ends with the last complete chunk."""
        self._stream.close()

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record; before the first message, so that truncation leaves it.

        Raises:
            OSError: the disk is full, or fails; the record is not there.
        """
        self._write_metadata({name: entries})

    def add_attachment(self, attachment: mcap_records.Attachment) -> None:
        """Write an attachment; before the first message, so that truncation leaves it.

        Raises:
            OSError: the disk is full, or fails; the attachment is not there.
        """
        record = encode_records(attachment)
        entry = mcap_records.AttachmentIndex(
            offset=self.state.size,
            length=len(record),
            create_time=attachment.create_time,
            log_time=attachment.log_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )
        self.state = self._append(record)
        self._attachment_index.append(entry)

    def _write_metadata(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """Write metadata, a record for each name."""
        for name, entries in metadata.items():
            record = encode_records(mcap_records.Metadata(name, dict(entries)))
            entry = mcap_records.MetadataIndex(self.state.size, len(record), name)
            self.state = self._append(record)
            self._metadata_index.append(entry)

    def _append(self, data: bytes) -> WriterState:
        """Write all of the data or nothing, and return the new state."""
        self._truncate()  # an interruption may have left something
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[self._stream.write(rest) :]
        except OSError:
            self._truncate()
            raise
        return replace(self.state, size=self.state.size + len(data), crc=zlib.crc32(data, self.state.crc))

    def _truncate(self) -> None:
        self._stream.seek(self.state.size)
        self._stream.truncate()

    def _summary(self) -> bytes:
        """Return all records after the data end."""
        data, at = b"", self.state.size
        offsets = b""
        statistics = mcap_records.Statistics(
            attachment_count=len(self._attachment_index),
            channel_count=len(self._channels),
            channel_message_counts=dict(self.state.counts),
            chunk_count=self.state.chunks,
            message_count=self.state.counts.total(),
            message_end_time=self.state.end,
            message_start_time=self.state.start or 0,
            metadata_count=len(self._metadata_index),
            schema_count=len(self._schemas),
        )
        for opcode, group in (
            (Opcode.SCHEMA, encode_records(*self._schemas.values())),
            (Opcode.CHANNEL, encode_records(*self._channels.values())),
            (Opcode.STATISTICS, encode_records(statistics)),
            (Opcode.CHUNK_INDEX, b"".join(self._index[: self.state.chunks])),
            (Opcode.ATTACHMENT_INDEX, encode_records(*self._attachment_index)),
            (Opcode.METADATA_INDEX, encode_records(*self._metadata_index)),
        ):
            if group:
                offsets += encode_records(mcap_records.SummaryOffset(opcode, at + len(data), len(group)))
                data += group
        footer = (at, at + len(data))
        data += offsets
        crc = zlib.crc32(RECORD_HEADER.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", *footer), zlib.crc32(data))
        return data + encode_records(mcap_records.Footer(*footer, crc)) + MAGIC
