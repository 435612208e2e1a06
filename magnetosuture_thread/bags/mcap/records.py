"""Strict parsing and encoding of mcap records, of chunks with their checksums, and of a file's summary.

The package `mcap` accepts short reads and trailing bytes. Here a record must be as long as its header says, which is
how a corrupt header is noticed.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import re
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from importlib import import_module
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from magnetosuture_thread.bags.storage import Connection, MessageDefinition
from magnetosuture_thread.untrusted import (
    LONE_RECORD,
    MAX_BLOCK_BYTES,
    MAX_BLOCK_RECORDS,
    MAX_RECORD_BYTES,
    UnpackBudget,
)

MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an mcap file
RECORD_HEADER = struct.Struct("<BQ")  # opcode and length of the content
MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data
MIN_PRIVATE_OPCODE = 0x80

_READERS: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.HEADER: mcap_records.Header.read,
    Opcode.FOOTER: mcap_records.Footer.read,
    Opcode.SCHEMA: mcap_records.Schema.read,
    Opcode.CHANNEL: mcap_records.Channel.read,
    Opcode.MESSAGE_INDEX: mcap_records.MessageIndex.read,
    Opcode.CHUNK_INDEX: mcap_records.ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: mcap_records.AttachmentIndex.read,
    Opcode.STATISTICS: mcap_records.Statistics.read,
    Opcode.METADATA: mcap_records.Metadata.read,
    Opcode.METADATA_INDEX: mcap_records.MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: mcap_records.SummaryOffset.read,
    Opcode.DATA_END: mcap_records.DataEnd.read,
}
# First and last time, uncompressed size, its checksum, length of the compression's name.
_CHUNK_HEADER = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_FOOTER = struct.Struct("<QQI")  # offsets of summary and summary offsets, checksum
_FOOTER_BYTES = RECORD_HEADER.size + _FOOTER.size + len(MAGIC)  # from the footer to the file's end
# Opcode, length of less than a terabyte, times, size and checksum, a known compression.
_CHUNK_PATTERN = re.compile(rb"\x06.{5}\0{3}.{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}).{5}\0{3}", re.DOTALL)
_WINDOW_BYTES = 1 << 22
_OVERLAP_BYTES = 64  # longer than a match of the pattern
_lz4 = import_module("lz4.frame")  # which has no types


class CorruptRecordError(Exception):
    """Bytes that are no valid record; the text gives the reason."""


def is_opcode(opcode: int) -> bool:
    """Return whether the format defines an opcode, or leaves it to private use."""
    return Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= MIN_PRIVATE_OPCODE


def parse_record(opcode: int, body: bytes) -> Any:
    """Return a record of the package `mcap`, or None where its content is not needed.

    Raises:
        CorruptRecordError: the bytes are no such record, or more than one may have.
    """
    reader = _READERS.get(opcode)
    if reader is None:
        return None
    name = _name(opcode)
    _check_length(opcode, len(body))
    stream = ReadDataStream(BytesIO(body))
    try:
        record = reader(stream)
    except (McapError, struct.error, UnicodeDecodeError, MemoryError, OverflowError):
        raise CorruptRecordError(f"a corrupt {name}") from None
    if stream.count != len(body):
        raise CorruptRecordError(f"a {name} of a wrong length")
    return record


def _name(opcode: int) -> str:
    return Opcode(opcode).name.lower().replace("_", " ")


def _check_length(opcode: int, length: int) -> None:
    """Check the length of a record that is parsed as a whole, before it is copied."""
    if opcode in _READERS and length > MAX_RECORD_BYTES:
        raise CorruptRecordError(f"a {_name(opcode)} of {length} bytes, more than {MAX_RECORD_BYTES}")


def iterate_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the body of each record of a chunk.

    Raises:
        CorruptRecordError: the records do not fill the chunk exactly, or one is longer than it may be.
    """
    position, size, count = 0, len(content), 0
    while position < size:
        count += 1
        if position + RECORD_HEADER.size > size:
            raise CorruptRecordError("a chunk with a corrupt record")
        if count > MAX_BLOCK_RECORDS:
            raise CorruptRecordError(f"a chunk of more than {MAX_BLOCK_RECORDS} records")
        opcode, length = RECORD_HEADER.unpack_from(content, position)
        start = position + RECORD_HEADER.size
        position = start + length
        if position > size or not opcode or (opcode == Opcode.MESSAGE and length < MESSAGE_HEADER.size):
            raise CorruptRecordError("a chunk with a corrupt record")
        _check_length(opcode, length)
        yield opcode, start, position


def encode_records(*records: mcap_records.McapRecord) -> bytes:
    """Return records as they are in a file."""
    builder: Any = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()
    return data


class ChunkContent(NamedTuple):
    """A chunk, decompressed.

    Attributes:
        data: its records.
        crc: their checksum, computed.
        has_checksum: whether the chunk has a checksum; if so, it equals `crc`.
        compression: `zstd`, `lz4` or empty.
    """

    data: bytes
    crc: int
    has_checksum: bool
    compression: str


def decompress_chunk(body: bytes, budget: UnpackBudget | None = None) -> ChunkContent:
    """Return the content of a chunk and verify its checksum.

    Args:
        body: of the chunk's record.
        budget: of the file, which the content is counted in; None where it has been.

    Raises:
        CorruptRecordError: it is no chunk, cannot be decompressed, or its checksum is wrong.
        BudgetError: the file unpacks to more than it may.
    """
    if len(body) < _CHUNK_HEADER.size:
        raise CorruptRecordError("a corrupt chunk")
    _, _, size, crc, name_length = _CHUNK_HEADER.unpack_from(body)
    start = _CHUNK_HEADER.size + name_length + _LENGTH.size
    if start > len(body) or start + _LENGTH.unpack_from(body, start - _LENGTH.size)[0] != len(body):
        raise CorruptRecordError("a corrupt chunk")
    compression = body[_CHUNK_HEADER.size : _CHUNK_HEADER.size + name_length]
    if size > MAX_BLOCK_BYTES:
        raise CorruptRecordError(f"a chunk that claims {size} bytes, more than {MAX_BLOCK_BYTES}")
    if budget is not None:
        budget.spend(size + len(body))
    data = _decompress(compression, body[start:], size)
    if len(data) != size:
        raise CorruptRecordError("a chunk of a wrong size")
    found = zlib.crc32(data)
    if crc and found != crc:
        raise CorruptRecordError("a chunk with a wrong checksum")
    return ChunkContent(data, found, bool(crc), compression.decode())


def has_chunk_checksum(stream: BinaryIO, offset: int) -> bool:
    """Return whether the content of a chunk's record at an offset has a checksum, which is not verified."""
    stream.seek(offset)
    head = stream.read(_CHUNK_HEADER.size)
    return len(head) == _CHUNK_HEADER.size and bool(_CHUNK_HEADER.unpack(head)[3])


def _decompress(compression: bytes, compressed: bytes, size: int) -> bytes:
    """Return the data, but at most a byte more than the size that the chunk claims."""
    if not compression:
        return compressed
    try:
        if compression == b"lz4":
            data: bytes = _lz4.LZ4FrameDecompressor().decompress(compressed, max_length=size + 1)
            return data
        if compression == b"zstd":
            if zstandard.frame_content_size(compressed) not in (-1, size):  # -1: not known
                raise CorruptRecordError("a chunk of a wrong size")
            unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_BLOCK_BYTES)
            return unpacker.decompress(compressed, max_output_size=size)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError):
        raise CorruptRecordError("a chunk that cannot be decompressed") from None
    raise CorruptRecordError("a chunk of an unknown compression")


def find_chunk(stream: BinaryIO, position: int, limit: int, before: int, budget: UnpackBudget) -> int | None:
    """Return where the next chunk with a correct checksum begins; None if there is none.

    A chunk without a checksum does not count: it cannot be told from message data that looks like one.

    Args:
        stream: the file.
        position: where the search begins.
        limit: where the data ends.
        before: the chunk must begin before this position.
        budget: of the file.

    Raises:
        BudgetError: there is too much to search.
    """
    while position < before:
        stream.seek(position)
        window = stream.read(min(_WINDOW_BYTES, limit - position))
        budget.spend(len(window))
        at = 0
        while (match := _CHUNK_PATTERN.search(window, at)) is not None and position + match.start() < before:
            if is_intact_chunk(stream, position + match.start(), limit, budget):
                return position + match.start()
            at = match.start() + 1
        if match is not None or len(window) < _WINDOW_BYTES:
            return None
        position += len(window) - _OVERLAP_BYTES
    return None


def is_intact_chunk(stream: BinaryIO, position: int, limit: int, budget: UnpackBudget) -> bool:
    """Return whether a chunk with a correct checksum begins at a position.

    Raises:
        BudgetError: the file unpacks to more than it may.
    """
    stream.seek(position)
    _, length = RECORD_HEADER.unpack(stream.read(RECORD_HEADER.size))
    if length > MAX_BLOCK_BYTES or position + RECORD_HEADER.size + length > limit:
        return False
    try:
        budget.spend(length)
        content = decompress_chunk(stream.read(length), budget)
        budget.spend(0, sum(1 for _ in iterate_records(content.data)))
    except CorruptRecordError:
        return False
    return content.has_checksum


class Block(NamedTuple):
    """A chunk, or a run of messages outside of chunks.

    Attributes:
        offset: where its bytes begin: those after a chunk's record header, or the first message's record header.
        length: number of bytes.
        is_chunk: whether it is a chunk.
        has_checksum: whether it has a checksum of its own.
        crc: checksum of its records, computed; None where it is not read yet.
        size: bytes of its records.
        start: time of its first message [ns].
        end: time of its last message [ns].
        channels: channels with messages in it, 2 bytes each: a set of them takes thirty times as much.
    """

    offset: int
    length: int
    is_chunk: bool
    has_checksum: bool
    crc: int | None
    size: int
    start: int
    end: int
    channels: bytes

    def holds(self, channels: AbstractSet[int]) -> bool:
        """Return whether it has messages of one of these channels."""
        return not channels.isdisjoint(self.channel_numbers())

    def channel_numbers(self) -> array[int]:
        """Return the channels with messages in it."""
        return array("H", self.channels)


@dataclass
class ChannelTable:
    """Channels and schemas as they are defined in some part of a file.

    Attributes:
        schemas: definitions by schema id; two or more conflict.
        channels: definitions by channel id; two or more conflict.
    """

    schemas: dict[int, list[mcap_records.Schema]] = field(default_factory=dict)
    channels: dict[int, list[mcap_records.Channel]] = field(default_factory=dict)

    def add(self, record: mcap_records.Schema | mcap_records.Channel) -> None:
        """Add a definition unless the same one is known."""
        table: dict[int, list[Any]] = self.schemas if isinstance(record, mcap_records.Schema) else self.channels
        versions = table.setdefault(record.id, [])
        if len(versions) < 2 and record not in versions:  # two are a conflict already
            versions.append(record)

    def update(self, other: ChannelTable) -> None:
        """Add all definitions of another table."""
        tables: list[dict[int, list[Any]]] = [other.schemas, other.channels]
        for record in (record for table in tables for versions in table.values() for record in versions):
            self.add(record)

    def connections(self) -> dict[int, Connection]:
        """Return the channels whose definition, and that of their schema, is without conflict."""
        known: dict[int, Connection] = {}
        for number, versions in self.channels.items():
            channel = versions[0]
            schemas = self.schemas.get(channel.schema_id, [])
            if len(versions) > 1 or len(schemas) > 1 or (channel.schema_id and not schemas):
                continue
            definition = MessageDefinition("")
            if schemas:
                text = schemas[0].data.decode("utf-8", "surrogateescape")
                definition = MessageDefinition(schemas[0].name, schemas[0].encoding, text)
            known[number] = Connection(channel.topic, definition, channel.message_encoding, channel.metadata)
        return known


@dataclass
class McapSummary:
    """The content of a summary section.

    It has a checksum of its own, so it can be trusted where the rest of the file is corrupt, and lists what is missing.

    Attributes:
        start: where it begins in the file; the data ends there, its last record included.
        end: where its footer begins.
        trusted: whether it has a checksum that is correct.
        channels: channels and their schemas.
        chunks: the chunk index, as blocks that have not been read.
        metadata: offset and length of the metadata records.
        lengths: of all that the summary lists, a chunk's message indexes included, by offset [bytes].
        statistics: counts and times of all messages, if present.
    """

    start: int
    end: int
    trusted: bool
    channels: ChannelTable = field(default_factory=ChannelTable)
    chunks: list[Block] = field(default_factory=list)
    metadata: list[tuple[int, int]] = field(default_factory=list)
    lengths: dict[int, int] = field(default_factory=dict)
    statistics: mcap_records.Statistics | None = None


def read_summary(stream: BinaryIO, size: int, budget: UnpackBudget) -> McapSummary | None:
    """Return the summary of a file; None where there is none, or its checksum is wrong.

    One without a checksum is accepted if it consists of valid records.

    Args:
        stream: the file.
        size: its length.
        budget: of the bag.

    Raises:
        BudgetError: there is too much in it.
    """
    stream.seek(max(0, size - _FOOTER_BYTES))
    end = stream.read()
    if len(end) < _FOOTER_BYTES or RECORD_HEADER.unpack_from(end) != (Opcode.FOOTER, _FOOTER.size):
        return None
    start, _, crc = _FOOTER.unpack_from(end, RECORD_HEADER.size)
    start = start or size - _FOOTER_BYTES
    in_range = max(len(MAGIC), size - MAX_BLOCK_BYTES) <= start <= size - _FOOTER_BYTES
    if not end.endswith(MAGIC) or not in_range:
        return None
    stream.seek(start)
    data = stream.read(size - len(MAGIC) - start)
    budget.spend(len(data), LONE_RECORD)
    if crc and zlib.crc32(data[:-4]) != crc:
        return None
    summary = McapSummary(start, size - _FOOTER_BYTES, bool(crc))
    try:
        _parse_summary(data, summary, budget)
    except CorruptRecordError:
        return None
    return summary


def _parse_summary(data: bytes, summary: McapSummary, budget: UnpackBudget) -> None:
    channel_sets: dict[bytes, bytes] = {}
    for opcode, first, last in iterate_records(data):
        budget.spend(0, 1)
        record = parse_record(opcode, data[first:last])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            budget.keep(last - first, len(getattr(record, "metadata", ())))
            summary.channels.add(record)
        elif opcode == Opcode.CHUNK_INDEX:
            channels = array("H", sorted(record.message_index_offsets)).tobytes()
            block = Block(
                offset=record.chunk_start_offset + RECORD_HEADER.size,
                length=record.chunk_length - RECORD_HEADER.size,
                is_chunk=True,
                has_checksum=True,
                crc=None,
                size=record.uncompressed_size,
                start=record.message_start_time,
                end=record.message_end_time,
                channels=channel_sets.setdefault(channels, channels),
            )
            summary.chunks.append(block)
            summary.lengths[record.chunk_start_offset] = record.chunk_length + record.message_index_length
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            summary.lengths[record.offset] = record.length
            if opcode == Opcode.METADATA_INDEX:
                summary.metadata.append((record.offset, record.length))
        elif opcode == Opcode.STATISTICS:
            summary.statistics = record
