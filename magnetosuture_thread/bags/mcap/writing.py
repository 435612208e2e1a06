"""Writes an mcap file chunk by chunk, each whole and readable on its own.

Every chunk has a checksum and tells the channels and types of its messages anew, so that nothing that happens to
one chunk, or to the file's end, makes another unreadable. What is on the disk ends with a whole chunk at any time:
a chunk is handed to the system in one go, and one that does not fit is cut off again.

The package `mcap` has a writer, and its records are written here. The writer itself is not used: it tells a channel
once in a file, so that a chunk is of no use without another; and it changes its counts and index before its bytes
are on the disk, so that after a full disk or Ctrl-C they do not fit the file.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from magnetosuture_thread.bags.mcap.layout import HEAD, MAGIC
from magnetosuture_thread.bags.mcap.open_chunk import OpenChunk, Waiting, as_bytes, index_of, taken_from
from magnetosuture_thread.bags.storage import Connection

CHUNK_SIZE = 256 * 1024  # bytes of messages, unpacked
CHUNK_SPAN = 2_000_000_000  # ns from a chunk's first message to its last; what is lost if the recorder is killed
INDEX_SIZE = 400  # bytes that a chunk needs in the summary, at most


@dataclass(frozen=True)
class _State:
    """What is on the disk and what waits; replaced as one, so that no interruption leaves half of a change.

    Attributes:
        size: bytes on the disk, all of them whole records.
        crc: their checksum.
        chunks: number of chunks among them.
        counts: messages in these, by channel.
        start: time of the first of them [ns]; None if there are none.
        end: time of the last of them [ns].
        waiting: messages for the next chunk.
    """

    size: int
    crc: int
    chunks: int
    counts: Counter[int]
    start: int | None
    end: int
    waiting: OpenChunk


class McapWriter:
    """An mcap file being written.

    Args:
        stream: of the file, without a buffer.
        words: about the file, by the name of their record; they stand at its head, where a cut leaves them.

    Raises:
        OSError: the disk is full, or fails.
    """

    def __init__(self, stream: BinaryIO, words: Mapping[str, Mapping[str, str]]) -> None:
        self._stream = stream
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._numbers: dict[object, int] = {}  # of schemas, by what they say
        self._sequences: Counter[int] = Counter()
        self._index: list[bytes] = []  # of the chunks, as the summary will tell it
        self._packer = zstandard.ZstdCompressor()
        self._state = _State(0, 0, 0, Counter(), None, 0, OpenChunk())
        self._state = self._appended(MAGIC + as_bytes(Header("ros2", "magnetosuture_thread")))
        self._told: list[MetadataIndex] = []
        self._tell(words)

    @property
    def counts(self) -> Counter[int]:
        """Return the number of messages on the disk, by channel."""
        return self._state.counts

    @property
    def start(self) -> int | None:
        """Return the time of the first message on the disk [ns]; None if there is none."""
        return self._state.start

    @property
    def end(self) -> int:
        """Return the time of the last message on the disk [ns]."""
        return self._state.end

    @property
    def chunks(self) -> int:
        """Return the number of chunks on the disk."""
        return self._state.chunks

    def add_channel(self, connection: Connection) -> int:
        """Say what a topic's messages are, and return the channel's number."""
        definition, schema = connection.definition, 0
        if definition.type_name:
            schema = self._numbers.setdefault(definition, len(self._numbers) + 1)
            self._schemas[schema] = Schema(schema, definition.text.encode(), definition.encoding, definition.type_name)
        number = len(self._channels) + 1
        self._channels[number] = Channel(
            number, connection.topic, connection.serialization, dict(connection.offered), schema
        )
        return number

    def add_message(self, channel: int, time: int, data: bytes) -> bool:
        """Take a message, and return whether a chunk went to the disk with it.

        Raises:
            OSError: as `flush`.
        """
        waiting = self._state.waiting
        sequence = self._sequences[channel]
        waiting.add(Waiting(channel, sequence, time, data))
        self._sequences[channel] = sequence + 1
        is_full = waiting.size > CHUNK_SIZE or waiting.span > CHUNK_SPAN
        if is_full:
            self.flush()
        return is_full

    def flush(self) -> None:
        """Bring the messages so far to the disk.

        Raises:
            OSError: it cannot be done. They are dropped, and the file ends with the last whole chunk before them.
        """
        before = self._state
        if not before.waiting:
            return
        content, entries, first, last = before.waiting.filled(self._channels, self._schemas)
        packed = self._packer.compress(content)
        body = as_bytes(Chunk("zstd", packed, last, first, zlib.crc32(content), len(content)))
        indices, places = b"", dict[int, int]()
        for channel, messages in entries.items():
            places[channel] = before.size + len(body) + len(indices)
            indices += index_of(channel, messages)
        listed = ChunkIndex(
            chunk_length=len(body),
            chunk_start_offset=before.size,
            compression="zstd",
            compressed_size=len(packed),
            message_end_time=last,
            message_index_length=len(indices),
            message_index_offsets=places,
            message_start_time=first,
            uncompressed_size=len(content),
        )
        try:
            after = self._appended(body + indices)
        except OSError:
            self._state = replace(before, waiting=OpenChunk())
            raise
        del self._index[before.chunks :]  # left there by an interruption
        self._index.append(as_bytes(listed))
        self._state = replace(
            after,
            chunks=before.chunks + 1,
            counts=before.counts + Counter({channel: len(messages) for channel, messages in entries.items()}),
            start=first if before.start is None else min(before.start, first),
            end=max(before.end, last),
            waiting=OpenChunk(),
        )

    def finish(self, words: Mapping[str, Mapping[str, str]]) -> None:
        """Write more words about the file and the summary, and close the file; all messages must be flushed before.

        Raises:
            OSError: it cannot be done. The file ends with the last whole chunk.
        """
        chunks = self._state
        try:
            self._tell(words)
            self._state = self._appended(as_bytes(DataEnd(self._state.crc)))
            self._state = self._appended(self._summary())
            os.fsync(self._stream.fileno())
        except OSError:
            self._state = chunks
            self._cut()
            raise
        self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is, without a summary: it ends with the last whole chunk."""
        self._stream.close()

    def _tell(self, words: Mapping[str, Mapping[str, str]]) -> None:
        """Write words about the file, a record for each name."""
        for name, entries in words.items():
            record = as_bytes(Metadata(name, dict(entries)))
            told = MetadataIndex(self._state.size, len(record), name)
            self._state = self._appended(record)
            self._told.append(told)

    def _appended(self, data: bytes) -> _State:
        """Write all of it or nothing, and return what is on the disk then."""
        self._cut()  # an interruption may have left something
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[self._stream.write(rest) :]
        except OSError:
            self._cut()
            raise
        return replace(self._state, size=self._state.size + len(data), crc=zlib.crc32(data, self._state.crc))

    def _cut(self) -> None:
        self._stream.seek(self._state.size)
        self._stream.truncate()

    def _summary(self) -> bytes:
        """Return all that follows the data."""
        data, at = b"", self._state.size
        offsets = RecordBuilder()
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self.counts),
            chunk_count=self.chunks,
            message_count=self.counts.total(),
            message_end_time=self.end,
            message_start_time=self.start or 0,
            metadata_count=len(self._told),
            schema_count=len(self._schemas),
        )
        for opcode, group in (
            (Opcode.SCHEMA, as_bytes(*self._schemas.values())),
            (Opcode.CHANNEL, as_bytes(*self._channels.values())),
            (Opcode.STATISTICS, as_bytes(statistics)),
            (Opcode.CHUNK_INDEX, b"".join(self._index[: self.chunks])),
            (Opcode.METADATA_INDEX, as_bytes(*self._told)),
        ):
            if group:
                SummaryOffset(opcode, at + len(data), len(group)).write(offsets)
                data += group
        footer = (at, at + len(data))
        data += taken_from(offsets)
        crc = zlib.crc32(HEAD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", *footer), zlib.crc32(data))
        return data + as_bytes(Footer(*footer, crc)) + MAGIC
