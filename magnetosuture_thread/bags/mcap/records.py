"""Strict parsing and encoding of mcap records, and of chunks with their checksums.

The package `mcap` accepts short reads and trailing bytes. Here a record must be as long as its header says, which is
how a corrupt header is noticed.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from importlib import import_module
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from magnetosuture_thread.untrusted import MAX_BLOCK_BYTES, MAX_BLOCK_RECORDS, MAX_RECORD_BYTES, UnpackBudget

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
_READ_BYTES = 1 << 20  # decompressed at a time where the size is not known in advance
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


def parse_attachment(body: bytes) -> tuple[mcap_records.Attachment | None, bool]:
    """Return an attachment, and whether it has a checksum; None where it is corrupt."""
    stream = ReadDataStream(BytesIO(body))
    try:
        record = mcap_records.Attachment.read(stream)
    except (McapError, struct.error, UnicodeDecodeError, MemoryError, OverflowError):
        return None, False
    crc = int.from_bytes(body[-4:], "little")
    if stream.count != len(body) or (crc and zlib.crc32(body[:-4]) != crc):
        return None, False
    return record, bool(crc)


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


def has_chunk_checksum(stream: BinaryIO, position: int) -> bool:
    """Return whether a chunk with a checksum begins at a position; the checksum is not verified."""
    stream.seek(position + RECORD_HEADER.size)
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
            if zstandard.frame_content_size(compressed) == size:
                return zstandard.ZstdDecompressor(max_window_size=MAX_BLOCK_BYTES).decompress(compressed)
            parts, count = [], 0
            with zstandard.ZstdDecompressor(max_window_size=MAX_BLOCK_BYTES).stream_reader(compressed) as stream:
                while count <= size and (part := stream.read(_READ_BYTES)):
                    parts.append(part)
                    count += len(part)
            return b"".join(parts)
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
