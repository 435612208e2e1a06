"""Writes mcap bags, in self-contained chunks, that stay readable after a crash or on a full disk.

Every chunk has a checksum and repeats the channels and schemas of its messages, so that damage to another chunk or to
the end of the file does not make it unreadable. The file on the disk ends with a complete chunk at any time: a chunk is
written in one call, and one that does not fit is truncated again.

The records are those of the package `mcap`. Its writer is not used: it writes a channel once in a file, so that a chunk
is useless without another; and it changes its counts and index before its bytes are on the disk, so that after a full
disk or Ctrl-C they do not match the file.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple

import yaml
import zstandard
from mcap import records as mcap_records
from mcap.opcode import Opcode

from magnetosuture_thread.bags.mcap.records import MAGIC, MESSAGE_HEADER, RECORD_HEADER, encode_records
from magnetosuture_thread.bags.message_types import own_definition, typestore
from magnetosuture_thread.bags.storage import (
    METADATA_FILE,
    NOTES,
    NOTES_PREFIX,
    QOS,
    TYPE_HASH,
    Connection,
    MessageDefinition,
    add_checksum,
    jazzy_qos_profiles,
    parse_qos_profiles,
    pluralize,
)
from magnetosuture_thread.errors import BagError

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

    Attributes:
        state: what is on the disk and what is pending.

    Raises:
        OSError: the disk is full, or fails.
    """

    def __init__(self, stream: BinaryIO, metadata: Mapping[str, Mapping[str, str]]) -> None:
        self._stream = stream
        self._schemas: dict[int, mcap_records.Schema] = {}
        self._channels: dict[int, mcap_records.Channel] = {}
        self._numbers: dict[object, int] = {}  # of schemas, by their definition
        self._sequences: Counter[int] = Counter()
        self._index: list[bytes] = []  # entries of the chunk index
        self._compressor = zstandard.ZstdCompressor()
        self.state = WriterState(0, 0, 0, Counter(), None, 0, ChunkBuilder())
        self.state = self._append(MAGIC + encode_records(mcap_records.Header("ros2", "magnetosuture_thread")))
        self._metadata_index: list[mcap_records.MetadataIndex] = []
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
            attachment_count=0,
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
            (Opcode.METADATA_INDEX, encode_records(*self._metadata_index)),
        ):
            if group:
                offsets += encode_records(mcap_records.SummaryOffset(opcode, at + len(data), len(group)))
                data += group
        footer = (at, at + len(data))
        data += offsets
        crc = zlib.crc32(RECORD_HEADER.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", *footer), zlib.crc32(data))
        return data + encode_records(mcap_records.Footer(*footer, crc)) + MAGIC


MAX_TIME = (1 << 64) - 1  # ns, the range of mcap
DISK_FULL_TEXTS = {errno.ENOSPC: "is full", errno.EDQUOT: "is full (quota)", errno.EFBIG: "takes no larger file"}


class RecordingEndedError(BagError):
    """The disk is full, or fails; what was recorded before can be read.

    Args:
        folder: of the bag.
        cause: what ended it.
        file: that holds what was recorded before.
    """

    def __init__(self, folder: Path, cause: str, file: Path) -> None:
        self.cause, self.file = cause, file
        super().__init__(folder, f"{cause}; what was recorded before can be read: {file}")


class BagWriter:
    """A bag being written: a folder with one mcap file and its metadata.yaml.

    Chunks are small and have checksums, so that damage is detected and intact messages can be salvaged. The bag holds
    full message definitions and type hashes, so that any tool can decode it. A recorder that is killed loses two
    seconds. When the disk is full, the bag ends with the last complete chunk, and is reported as truncated.

    Args:
        folder: made by the writer if there is none; must be empty.
        notes: entries kept in the bag, for example the setup it was recorded with.
        name: of the bag; the folder's if empty.
        custom_data: entries of others in metadata.yaml.

    Raises:
        BagError: the folder is not empty or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        notes: Mapping[str, str] | None = None,
        *,
        name: str = "",
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        self._custom_data = dict(custom_data or {})
        self._file_name = f"{name or folder.name}_0.mcap"
        self._notes = dict(notes or {})
        self._topics: dict[str, int] = {}
        self._connections: dict[int, Connection] = {}
        self._closed = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                raise BagError(folder, "is not empty; a bag is written to a new folder")
            self._stream = (folder / self._file_name).open("wb", buffering=0)
        except OSError as error:
            raise BagError(folder, f"cannot be written: {error.strerror}") from None
        try:
            self._writer = McapWriter(self._stream, {NOTES: add_checksum(self._notes)} if self._notes else {})
        except OSError as error:
            self._stream.close()
            (folder / self._file_name).unlink(missing_ok=True)  # of no use, but in the way of the next attempt
            raise BagError(folder, f"cannot be written: {error.strerror}") from None

    def __enter__(self) -> BagWriter:
        """Use the writer in a with statement, which closes it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag, so that what was written can be read whatever happened."""
        self.close()

    def add_topic(self, topic: str, type_name: str, definition: MessageDefinition | None = None) -> None:
        """Add a topic of a type, for example `nav_msgs/msg/Path`.

        Args:
            topic: with its leading slash.
            type_name: of its messages.
            definition: of the type; ours if None.

        Raises:
            BagError: the type is unknown, and no definition is given.
        """
        if definition is None:
            definition = own_definition(type_name)
            if not definition.text:
                raise BagError(topic, f"the type {type_name} has no definition")
        metadata = {QOS: "", TYPE_HASH: _type_hash(definition)}
        self._topics[topic] = self.add_connection(Connection(topic, definition, metadata=metadata))

    def add_connection(self, connection: Connection) -> int:
        """Add a connection, and return its number for `write_to`."""
        if QOS in connection.metadata:
            profiles = jazzy_qos_profiles(connection.metadata[QOS])
            connection = replace(connection, metadata={**connection.metadata, QOS: profiles})
        number = self._writer.add_channel(connection)
        self._connections[number] = connection
        return number

    def write(self, topic: str, time: int, data: bytes) -> None:
        """Write one serialised message.

        Args:
            topic: one that was added.
            time: when it was received [ns].
            data: CDR bytes.

        Raises:
            RecordingEndedError: the disk is full, or fails. The bag is closed, and what was written before can be read.
        """
        self.write_to(self._topics[topic], time, data)

    def write_to(
        self, number: int, time: int, data: bytes, *, publish_time: int | None = None, sequence: int | None = None
    ) -> None:
        """Write one serialised message of a connection, with its own publish time and sequence number if it has any.

        Otherwise as `write`.
        """
        if not 0 <= time <= MAX_TIME:
            raise BagError(
                self._connections[number].topic, f"a message of the time {time} ns; expected 0 to {MAX_TIME}"
            )
        if self._closed:
            raise BagError(self.folder, "is closed; nothing more can be written to it")
        try:
            self._writer.add_message(number, time, data, publish_time=publish_time, sequence=sequence)
        except OSError as error:
            self._end(error)

    def write_message(self, topic: str, time: int, message: Any) -> None:
        """Serialise a message of the type store and write it; otherwise as `write`."""
        type_name = self._connections[self._topics[topic]].type_name
        self.write(topic, time, bytes(typestore().serialize_cdr(message, type_name)))

    def close(self) -> None:
        """Finish the file and write metadata.yaml; a second call does nothing.

        Raises:
            RecordingEndedError: the disk is full, or fails; what was written before can be read.
        """
        if self._closed:
            return
        problem: OSError | None = None
        try:
            self._writer.flush()
        except OSError as error:
            problem = error
        self._end(problem)

    def _end(self, problem: OSError | None) -> None:
        """Finish the bag with what is on the disk, if there is space for its summary; raise what ended it early."""
        self._closed = True
        try:
            self._finish()
        except OSError as error:
            self._writer.abandon()
            problem = problem or error
        if problem is not None:
            raise self._refusal(problem) from None

    def _refusal(self, problem: OSError) -> RecordingEndedError:
        kept = pluralize(self._writer.state.counts.total(), "message")
        what = DISK_FULL_TEXTS.get(problem.errno or 0, f"fails ({problem.strerror})")
        return RecordingEndedError(self.folder, f"the disk {what} after {kept}", self.folder / self._file_name)

    def _finish(self) -> None:
        information = self._information()
        self._writer.finish({"rosbag2": {"serialized_metadata": yaml.safe_dump(information, sort_keys=False)}})
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        try:
            with (self.folder / METADATA_FILE).open("w", encoding="utf-8") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError:  # a part of it would be refused, where readers do without it
            (self.folder / METADATA_FILE).unlink(missing_ok=True)
            raise

    def _information(self) -> dict[str, Any]:
        """Return the content of metadata.yaml."""
        state = self._writer.state
        notes = {NOTES_PREFIX + key: value for key, value in add_checksum(self._notes).items()} if self._notes else {}
        part = {
            "starting_time": {"nanoseconds_since_epoch": state.start or 0},
            "duration": {"nanoseconds": state.end - (state.start or 0)},
            "message_count": state.counts.total(),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": connection.topic,
                    "type": connection.type_name,
                    "serialization_format": connection.serialization,
                    "offered_qos_profiles": parse_qos_profiles(connection.metadata.get(QOS, "")),
                    "type_description_hash": connection.metadata.get(TYPE_HASH, ""),
                },
                "message_count": state.counts[number],
            }
            for number, connection in self._connections.items()
        ]
        return {
            "version": 9,  # of the format of metadata.yaml
            "storage_identifier": "mcap",
            **part,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file_name],
            "files": [{"path": self._file_name, **deepcopy(part)}],  # a copy, as YAML would write aliases
            "custom_data": {**self._custom_data, **notes},
            "ros_distro": "jazzy",
        }


def _type_hash(definition: MessageDefinition) -> str:
    """Return the RIHS01 hash of a type, where its definition is ours."""
    if definition != own_definition(definition.type_name) or not definition.text:
        return ""
    return typestore().hash_rihs01(definition.type_name)
