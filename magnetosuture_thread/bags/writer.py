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
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
import zstandard
from mcap import records as mcap_records
from mcap.opcode import Opcode

from magnetosuture_thread.bags.mcap import MAGIC, RECORD_HEADER, encode_records
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
from magnetosuture_thread.settings.errors import BagError, RecordingEndedError

MAX_CHUNK_BYTES = 256 * 1024  # of messages, uncompressed
MAX_CHUNK_SPAN = 2_000_000_000  # ns, from first to last message; lost if the recorder is killed
MAX_TIME = (1 << 64) - 1  # ns, the range of mcap
DISK_FULL_TEXTS = {errno.ENOSPC: "is full", errno.EDQUOT: "is full (quota)", errno.EFBIG: "takes no larger file"}


@dataclass
class PendingChunk:
    """Messages for a chunk.

    What counts is a list that grows: whatever interrupts a recorder between two messages or within one, as Ctrl-C may,
    the messages stay complete.

    Attributes:
        messages: in the order in which they came.
        size: number of bytes of their data.
        first: time of the first of them [ns].
        last: time of the last of them [ns].
    """

    messages: list[mcap_records.Message] = field(default_factory=list)
    size: int = 0
    first: int = MAX_TIME
    last: int = 0

    @property
    def is_full(self) -> bool:
        """Whether the chunk is to be written."""
        return self.size > MAX_CHUNK_BYTES or self.last - self.first > MAX_CHUNK_SPAN

    def add(self, message: mcap_records.Message) -> None:
        """Add a message."""
        self.messages.append(message)
        self.size += len(message.data)
        self.first, self.last = min(self.first, message.log_time), max(self.last, message.log_time)


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

    size: int = 0
    crc: int = 0
    chunks: int = 0
    counts: Counter[int] = field(default_factory=Counter)
    start: int | None = None
    end: int = 0
    pending: PendingChunk = field(default_factory=PendingChunk)


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
        self._file = folder / f"{name or folder.name}_0.mcap"
        self._notes, self._custom_data = add_checksum(notes) if notes else {}, dict(custom_data or {})
        self._topics: dict[str, int] = {}
        self._connections: dict[int, Connection] = {}
        self._channels: dict[int, mcap_records.Channel] = {}
        self._schemas: dict[int, mcap_records.Schema] = {}
        self._schema_numbers: dict[MessageDefinition, int] = {}
        self._sequences: Counter[int] = Counter()
        self._index: list[bytes] = []  # entries of the chunk index
        self._metadata_index: list[mcap_records.MetadataIndex] = []
        self._compressor = zstandard.ZstdCompressor()
        self._state = WriterState()
        self._closed = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                raise BagError(folder, "is not empty; a bag is written to a new folder")
            self._stream = self._file.open("wb", buffering=0)
        except OSError as error:
            raise BagError(folder, f"cannot be written: {error.strerror}") from None
        try:
            self._state = self._append(MAGIC + encode_records(mcap_records.Header("ros2", "magnetosuture_thread")))
            if self._notes:
                self._write_metadata(NOTES, self._notes)  # at the head of the file, where truncation leaves them
        except OSError as error:
            self._stream.close()
            self._file.unlink(missing_ok=True)  # of no use, but in the way of the next attempt
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
        definition, schema, metadata = connection.definition, 0, dict(connection.metadata)
        if QOS in metadata:
            metadata[QOS] = jazzy_qos_profiles(metadata[QOS])
        if definition != MessageDefinition(""):
            schema = self._schema_numbers.setdefault(definition, len(self._schema_numbers) + 1)
            text = definition.text.encode("utf-8", "surrogateescape")
            self._schemas[schema] = mcap_records.Schema(schema, text, definition.encoding, definition.type_name)
        number = len(self._channels) + 1
        self._connections[number] = replace(connection, metadata=metadata)
        self._channels[number] = mcap_records.Channel(
            number, connection.topic, connection.serialization, metadata, schema
        )
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
            topic = self._connections[number].topic
            raise BagError(topic, f"a message of the time {time} ns; expected 0 to {MAX_TIME}")
        if self._closed:
            raise BagError(self.folder, "is closed; nothing more can be written to it")
        sequence = self._sequences[number] if sequence is None else sequence
        publish_time = time if publish_time is None else publish_time
        self._state.pending.add(mcap_records.Message(number, time, data, publish_time, sequence))
        self._sequences[number] = (sequence + 1) & 0xFFFFFFFF
        if self._state.pending.is_full:
            try:
                self._flush()
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
            self._flush()
        except OSError as error:
            problem = error
        self._end(problem)

    def _end(self, problem: OSError | None) -> None:
        """Finish the bag with what is on the disk, if there is space for its summary; raise what ended it early."""
        self._closed = True
        try:
            self._finish()
        except OSError as error:
            problem = problem or error
        finally:
            self._stream.close()
        if problem is not None:
            kept = pluralize(self._state.counts.total(), "message")
            what = DISK_FULL_TEXTS.get(problem.errno or 0, f"fails ({problem.strerror})")
            raise RecordingEndedError(self.folder, f"the disk {what} after {kept}", self._file) from None

    def _flush(self) -> None:
        """Write the messages so far to the disk as a chunk.

        Raises:
            OSError: they are dropped, and the file ends with the last complete chunk before them.
        """
        before = self._state
        if not before.pending.messages:
            return
        content, entries = self._chunk_content(before.pending.messages)
        times = [message.log_time for message in before.pending.messages]
        first, last = min(times), max(times)
        compressed = self._compressor.compress(content)
        body = encode_records(mcap_records.Chunk("zstd", compressed, last, first, zlib.crc32(content), len(content)))
        indices, offsets = b"", dict[int, int]()
        for channel, messages in entries.items():
            offsets[channel] = before.size + len(body) + len(indices)
            indices += encode_records(mcap_records.MessageIndex(channel, messages))
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
            self._state = replace(before, pending=PendingChunk())
            raise
        del self._index[before.chunks :]  # left there by an interruption
        self._index.append(encode_records(entry))
        self._state = replace(
            after,
            chunks=before.chunks + 1,
            counts=before.counts + Counter({channel: len(messages) for channel, messages in entries.items()}),
            start=first if before.start is None else min(before.start, first),
            end=max(before.end, last),
            pending=PendingChunk(),
        )

    def _chunk_content(self, messages: list[mcap_records.Message]) -> tuple[bytes, dict[int, list[tuple[int, int]]]]:
        """Return the records of a chunk, with the channels and schemas of its messages; and time and offset of each."""
        content = bytearray()
        entries: dict[int, list[tuple[int, int]]] = {}
        defined: set[int] = set()
        for message in messages:
            if message.channel_id not in entries:
                channel = self._channels[message.channel_id]
                if channel.schema_id and channel.schema_id not in defined:
                    content += encode_records(self._schemas[channel.schema_id])
                    defined.add(channel.schema_id)
                content += encode_records(channel)
                entries[message.channel_id] = []
            entries[message.channel_id].append((message.log_time, len(content)))
            content += encode_records(message)
        return bytes(content), entries

    def _finish(self) -> None:
        """Write the summary and metadata.yaml.

        Raises:
            OSError: the file ends with the last complete chunk.
        """
        information, chunks = self._information(), self._state
        try:
            self._write_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(information, sort_keys=False)})
            self._state = self._append(encode_records(mcap_records.DataEnd(self._state.crc)))
            self._state = self._append(self._summary())
            os.fsync(self._stream.fileno())
        except OSError:
            self._state = chunks
            self._truncate()
            raise
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        try:
            with (self.folder / METADATA_FILE).open("w", encoding="utf-8") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError:  # a part of it would be refused, where readers do without it
            (self.folder / METADATA_FILE).unlink(missing_ok=True)
            raise

    def _write_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        record = encode_records(mcap_records.Metadata(name, dict(entries)))
        entry = mcap_records.MetadataIndex(self._state.size, len(record), name)
        self._state = self._append(record)
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
        return replace(self._state, size=self._state.size + len(data), crc=zlib.crc32(data, self._state.crc))

    def _truncate(self) -> None:
        self._stream.seek(self._state.size)
        self._stream.truncate()

    def _summary(self) -> bytes:
        """Return all records after the data end."""
        data, at = b"", self._state.size
        offsets = b""
        statistics = mcap_records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._state.counts),
            chunk_count=self._state.chunks,
            message_count=self._state.counts.total(),
            message_end_time=self._state.end,
            message_start_time=self._state.start or 0,
            metadata_count=len(self._metadata_index),
            schema_count=len(self._schemas),
        )
        for opcode, group in (
            (Opcode.SCHEMA, encode_records(*self._schemas.values())),
            (Opcode.CHANNEL, encode_records(*self._channels.values())),
            (Opcode.STATISTICS, encode_records(statistics)),
            (Opcode.CHUNK_INDEX, b"".join(self._index[: self._state.chunks])),
            (Opcode.METADATA_INDEX, encode_records(*self._metadata_index)),
        ):
            if group:
                offsets += encode_records(mcap_records.SummaryOffset(opcode, at + len(data), len(group)))
                data += group
        footer = (at, at + len(data))
        data += offsets
        crc = zlib.crc32(RECORD_HEADER.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", *footer), zlib.crc32(data))
        return data + encode_records(mcap_records.Footer(*footer, crc)) + MAGIC

    def _information(self) -> dict[str, Any]:
        """Return the content of metadata.yaml."""
        state = self._state
        notes = {NOTES_PREFIX + key: value for key, value in self._notes.items()}
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
            "relative_file_paths": [self._file.name],
            "files": [{"path": self._file.name, **deepcopy(part)}],  # a copy, as YAML would write aliases
            "custom_data": {**self._custom_data, **notes},
            "ros_distro": "jazzy",
        }


def _type_hash(definition: MessageDefinition) -> str:
    """Return the RIHS01 hash of a type, where its definition is ours."""
    if definition != own_definition(definition.type_name) or not definition.text:
        return ""
    return typestore().hash_rihs01(definition.type_name)
