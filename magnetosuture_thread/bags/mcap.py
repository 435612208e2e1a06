"""Reads mcap files, whole or damaged: verifies every checksum, reports what is lost, and yields what is intact.

Data that may be wrong is never used. A chunk with a correct checksum is used. Data without a checksum (messages outside
of chunks, chunks of writers that write none, and the channels defined there) is used only where the checksum of the
data section is correct, or where the file shows no damage at all: every record parses, and it has an end and a summary
that agrees with the messages. In a file with any other damage it is not used.

Where a record or chunk is corrupt, the scan continues at the record behind it, or at the next chunk with a correct
checksum if that comes first. The package `mcap` parses the records, but accepts short reads and trailing bytes. Here a
record must be as long as its header and the lengths within it say, which is how a corrupt one is noticed.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import re
import struct
import zlib
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import blake2b
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode

from magnetosuture_thread.bags.budgets import (
    LONE_RECORD,
    MAX_BLOCK_BYTES,
    MAX_BLOCK_RECORDS,
    MAX_RECORD_BYTES,
    UnpackBudget,
    open_ranges,
)
from magnetosuture_thread.bags.storage import (
    NOTES,
    Connection,
    CorruptRegion,
    DamageReport,
    MessageDefinition,
    StoredMessage,
    merge_by_time,
    pluralize,
    verified_notes,
)
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import HEAD_BYTES, BudgetError, is_url, substitute_problem

MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an mcap file
RECORD_HEADER = struct.Struct("<BQ")  # opcode and length of the content
MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data

_MIN_PRIVATE_OPCODE = 0x80
_PARSED = frozenset(Opcode) - {Opcode.MESSAGE, Opcode.ATTACHMENT}
_FOOTER = struct.Struct("<QQI")  # offsets of summary and summary offsets, checksum
_FOOTER_BYTES = RECORD_HEADER.size + _FOOTER.size + len(MAGIC)  # from the footer to the file's end
# Opcode, length of less than a terabyte, times, size and checksum, a known compression.
_CHUNK_PATTERN = re.compile(rb"\x06.{5}\0{3}.{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}).{5}\0{3}", re.DOTALL)
_CHUNK_CRC = slice(24, 28)  # of the content of a chunk's record
_WINDOW_BYTES = 1 << 22  # searched at a time
_OVERLAP_BYTES = 64  # longer than a match of the pattern
_READ_BYTES = 1 << 20  # read at a time for a checksum; and of messages outside of chunks in one block
_EMPTY_INDEX = 6  # bytes of a message index without entries: channel and length
_lz4 = import_module("lz4.frame")  # which has no types


class CorruptRecordError(Exception):
    """Bytes that are no valid record; the text gives the reason."""


class _WholeStream(ReadDataStream):
    """A stream that raises where there is less than is read."""

    def read(self, length: int) -> bytes:
        """Return so many bytes."""
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def parse_record(opcode: int, body: bytes) -> Any:
    """Return a record of the package `mcap`, or None where its content is not needed.

    Raises:
        CorruptRecordError: the bytes are no such record, or more than one may have.
    """
    if opcode not in _PARSED:
        return None
    _check_length(opcode, len(body))
    kind = getattr(mcap_records, Opcode(opcode).name.title().replace("_", ""))  # ChunkIndex of CHUNK_INDEX
    stream = _WholeStream(BytesIO(body))
    try:
        record = kind.read(stream)
    except (McapError, struct.error, UnicodeDecodeError, MemoryError, OverflowError):
        record = None
    if record is None or stream.count != len(body):
        raise CorruptRecordError(f"a corrupt {Opcode(opcode).name.lower().replace('_', ' ')}")
    return record


def _check_length(opcode: int, length: int) -> None:
    """Check the length of a record that is parsed as a whole, before it is read or copied."""
    most = MAX_BLOCK_BYTES if opcode == Opcode.CHUNK else MAX_RECORD_BYTES
    if opcode in _PARSED and length > most:
        raise CorruptRecordError(f"a record of {length} bytes, more than {most}")


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


def decompress_chunk(body: bytes, budget: UnpackBudget | None = None) -> tuple[mcap_records.Chunk, bytes]:
    """Return a chunk and its records, with its checksum verified if it has one.

    Args:
        body: of the chunk's record.
        budget: of the bag, which the content is counted in; None where it has been.

    Raises:
        CorruptRecordError: it is no chunk, cannot be decompressed, or its checksum is wrong.
        BudgetError: the bag unpacks to more than it may.
    """
    chunk = parse_record(Opcode.CHUNK, body)
    size = chunk.uncompressed_size
    if size > MAX_BLOCK_BYTES:
        raise CorruptRecordError(f"a chunk that claims {size} bytes, more than {MAX_BLOCK_BYTES}")
    if budget is not None:
        budget.spend(size + len(body))
    data = _decompress(chunk.compression, chunk.data, size)
    if len(data) != size:
        raise CorruptRecordError("a chunk of a wrong size")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise CorruptRecordError("a chunk with a wrong checksum")
    return chunk, data


def _decompress(compression: str, compressed: bytes, size: int) -> bytes:
    """Return the data, but at most a byte more than the size that the chunk claims."""
    if not compression:
        return compressed
    try:
        if compression == "lz4":
            data: bytes = _lz4.LZ4FrameDecompressor().decompress(compressed, max_length=size + 1)
            return data
        if compression == "zstd":
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
        budget: of the bag.

    Raises:
        BudgetError: there is too much to search.
    """
    while position < before:
        stream.seek(position)
        window = stream.read(min(_WINDOW_BYTES, limit - position))
        budget.spend(len(window))
        at = 0
        while (match := _CHUNK_PATTERN.search(window, at)) is not None and position + match.start() < before:
            if _is_intact_chunk(stream, position + match.start(), limit, budget):
                return position + match.start()
            at = match.start() + 1
        if match is not None or len(window) < _WINDOW_BYTES:
            return None
        position += len(window) - _OVERLAP_BYTES
    return None


def _is_intact_chunk(stream: BinaryIO, position: int, limit: int, budget: UnpackBudget) -> bool:
    """Return whether a chunk with a correct checksum begins at a position."""
    stream.seek(position)
    _, length = RECORD_HEADER.unpack(stream.read(RECORD_HEADER.size))
    if length > MAX_BLOCK_BYTES or position + RECORD_HEADER.size + length > limit:
        return False
    try:
        budget.spend(length)
        chunk, data = decompress_chunk(stream.read(length), budget)
        budget.spend(0, sum(1 for _ in iterate_records(data)))
    except CorruptRecordError:
        return False
    return bool(chunk.uncompressed_crc)


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
        counts: channels with messages in it, each followed by their number; 0 where it is not read yet. A dict would
            take ten times the memory.
    """

    offset: int
    length: int
    is_chunk: bool
    has_checksum: bool
    crc: int | None
    size: int
    start: int
    end: int
    counts: array[int]

    def holds(self, channels: AbstractSet[int]) -> bool:
        """Return whether it has messages of one of these channels."""
        return not channels.isdisjoint(self.counts[::2])


def count_messages(blocks: Iterable[Block]) -> Counter[int]:
    """Return the number of messages of each channel."""
    counts: Counter[int] = Counter()
    for block in blocks:
        for channel, count in zip(block.counts[::2], block.counts[1::2], strict=True):
            counts[channel] += count
    return counts


Definition = mcap_records.Schema | mcap_records.Channel


def connections_of(definitions: Iterable[Definition]) -> dict[int, Connection]:
    """Return the channels whose definition, and that of their schema, is without conflict."""
    schemas: dict[int, list[mcap_records.Schema]] = {}
    channels: dict[int, list[mcap_records.Channel]] = {}
    for record in definitions:
        table: dict[int, list[Any]] = schemas if isinstance(record, mcap_records.Schema) else channels
        versions = table.setdefault(record.id, [])
        if len(versions) < 2 and record not in versions:  # two are a conflict already
            versions.append(record)
    known: dict[int, Connection] = {}
    for number, (channel, *others) in channels.items():
        schema = schemas.get(channel.schema_id, [])
        if others or len(schema) > 1 or (channel.schema_id and not schema):
            continue
        definition = MessageDefinition("")
        if schema:
            text = schema[0].data.decode("utf-8", "surrogateescape")
            definition = MessageDefinition(schema[0].name, schema[0].encoding, text)
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
        definitions: channels and their schemas.
        chunks: the chunk index, as blocks that have not been read.
        metadata: offset and length of the metadata records.
        lengths: of all that the summary lists, a chunk's message indexes included, by offset [bytes].
        statistics: counts and times of all messages, if present.
    """

    start: int
    end: int
    trusted: bool
    definitions: list[Definition] = field(default_factory=list)
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
    for opcode, first, last in iterate_records(data):
        budget.spend(0, 1)
        record = parse_record(opcode, data[first:last])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            budget.keep(last - first, len(getattr(record, "metadata", ())))
            summary.definitions.append(record)
        elif opcode == Opcode.CHUNK_INDEX:
            block = Block(
                offset=record.chunk_start_offset + RECORD_HEADER.size,
                length=record.chunk_length - RECORD_HEADER.size,
                is_chunk=True,
                has_checksum=True,
                crc=None,
                size=record.uncompressed_size,
                start=record.message_start_time,
                end=record.message_end_time,
                counts=array("I", [number for channel in record.message_index_offsets for number in (channel, 0)]),
            )
            summary.chunks.append(block)
            summary.lengths[record.chunk_start_offset] = record.chunk_length + record.message_index_length
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            summary.lengths[record.offset] = record.length
            if opcode == Opcode.METADATA_INDEX:
                summary.metadata.append((record.offset, record.length))
        elif opcode == Opcode.STATISTICS:
            summary.statistics = record


@dataclass
class ScanResult:
    """What a file holds.

    Attributes:
        blocks: in the order of the file.
        checked: channels and schemas defined in blocks with a checksum.
        unchecked: channels and schemas defined elsewhere.
        metadata: metadata records.
        compressions: of the chunks.
        attachments: number of attachment records.
        private_records: number of records of private opcodes.
        corrupt: regions that could not be read.
        chunks_lost: number of chunks among them, as far as it can be seen.
        ended: whether the data end record was reached.
        stopped: where the scan ended.
        data_crc: checksum of the data section as stored; 0 if there is none.
        data_verified: whether it is correct.
        index: messages by channel, where the file was not scanned, but only its index read.
    """

    blocks: list[Block] = field(default_factory=list)
    checked: list[Definition] = field(default_factory=list)
    unchecked: list[Definition] = field(default_factory=list)
    metadata: list[mcap_records.Metadata] = field(default_factory=list)
    compressions: set[str] = field(default_factory=set)
    attachments: int = 0
    private_records: int = 0
    corrupt: list[CorruptRegion] = field(default_factory=list)
    chunks_lost: int = 0
    ended: bool = False
    stopped: int = 0
    data_crc: int = 0
    data_verified: bool = False
    index: Counter[int] | None = None


class Scanner:
    """Scans the data section of an mcap file record by record.

    Args:
        name: of the file.
        stream: the file, open.
        limit: where its data ends.
        budget: of the bag.
        progress: called with the number of bytes scanned since the last call.

    Attributes:
        result: what was found.
    """

    def __init__(
        self, name: str, stream: BinaryIO, limit: int, budget: UnpackBudget, progress: Callable[[int], None]
    ) -> None:
        self.result = ScanResult()
        self._name, self._stream, self._limit = name, stream, limit
        self._budget, self._progress = budget, progress
        self._definitions: set[bytes] = set()  # hashes of those that were added

    def scan(self) -> ScanResult:
        """Scan the file and return what was found.

        Raises:
            BudgetError: it unpacks to more, or holds more records, than a file of its size may.
        """
        position = len(MAGIC)
        if self._read(0, len(MAGIC)) != MAGIC:
            position = self._skip_corrupt(0, "the magic bytes are missing")
        while position < self._limit and not self.result.ended:
            before = position
            problem = ""
            try:
                position = self._step(position)
            except CorruptRecordError as error:
                problem = str(error)  # not the error itself, which holds what was read so far
            if problem:
                self._budget.spend(0, LONE_RECORD)
                position = self._skip_corrupt(position, problem)
            self._progress(position - before)
        self.result.stopped = position
        return self.result

    def _step(self, position: int) -> int:
        """Scan the record at a position and return where the next one begins."""
        opcode, length = self._read_header(position)
        start = position + RECORD_HEADER.size
        after = start + length
        # An index comes with a message of its chunk: small chunks of many topics are mostly such indexes.
        has_entries = opcode == Opcode.MESSAGE_INDEX and length > _EMPTY_INDEX
        self._budget.spend(0, 1 if has_entries else LONE_RECORD)
        if opcode == Opcode.MESSAGE:
            return self._scan_loose_messages(position)
        if opcode in (Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX) or opcode >= _MIN_PRIVATE_OPCODE:
            self._check_unread(opcode, start, length)
            return after
        _check_length(opcode, length)
        body = self._read(start, length)
        if opcode == Opcode.CHUNK:
            chunk, data = decompress_chunk(body, self._budget)
            self._add_block(data, start, length, is_chunk=True, has_checksum=bool(chunk.uncompressed_crc))
            self.result.compressions.add(chunk.compression)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._add_definition(opcode, body, checked=False)
        else:
            record = parse_record(opcode, body)
            if opcode == Opcode.METADATA:
                self._budget.keep(length, len(record.metadata))
                self.result.metadata.append(record)
            elif opcode == Opcode.DATA_END:
                self.result.ended = True
                self.result.data_crc = record.data_section_crc
                self.result.data_verified = bool(record.data_section_crc) and self._crc_until(position) == (
                    record.data_section_crc
                )
        return after

    def _read_header(self, position: int) -> tuple[int, int]:
        """Return opcode and length of the record at a position, if one can be there."""
        head = self._read(position, RECORD_HEADER.size)
        if len(head) < RECORD_HEADER.size:
            raise CorruptRecordError("the end is missing")
        opcode, length = RECORD_HEADER.unpack(head)
        if not (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= _MIN_PRIVATE_OPCODE):
            raise CorruptRecordError("no record where one is expected")
        if position + RECORD_HEADER.size + length > self._limit:
            raise CorruptRecordError("a record longer than the rest of the data")
        if opcode == Opcode.MESSAGE and not MESSAGE_HEADER.size <= length <= MAX_BLOCK_BYTES:
            raise CorruptRecordError("a corrupt message")
        return opcode, length

    def _check_unread(self, opcode: int, start: int, length: int) -> None:
        """Check a record whose content is not needed; it has to end where another record can begin."""
        if opcode == Opcode.MESSAGE_INDEX:
            # Its content is redundant, but the opcode of a chunk may have been corrupted to this one.
            entries = int.from_bytes(self._read(start + 2, 4), "little")
            if entries + _EMPTY_INDEX != length or entries % 16:
                raise CorruptRecordError("a corrupt message index")
        if start + length < self._limit:
            self._read_header(start + length)
        self.result.private_records += opcode >= _MIN_PRIVATE_OPCODE
        self.result.attachments += opcode == Opcode.ATTACHMENT

    def _scan_loose_messages(self, position: int) -> int:
        """Add a run of messages outside of chunks, and return where it ends."""
        after = position
        try:
            while after - position < _READ_BYTES and after < self._limit:
                opcode, length = self._read_header(after)
                if opcode != Opcode.MESSAGE:
                    break
                after += RECORD_HEADER.size + length
        except CorruptRecordError:
            pass  # The run ends here; the next step handles what is corrupt.
        self._add_block(self._read(position, after - position), position, after - position)
        return after

    def _add_block(
        self, data: bytes, offset: int, length: int, *, is_chunk: bool = False, has_checksum: bool = False
    ) -> None:
        """Add a block with its definitions and counts; nothing of it where a record is corrupt."""
        counts: Counter[int] = Counter()
        definitions = []
        first, last = 0, 0
        records = 0
        for opcode, start, end in iterate_records(data):
            records += 1
            if opcode == Opcode.MESSAGE:
                channel, _, time, _ = MESSAGE_HEADER.unpack_from(data, start)
                first, last = (min(first, time), max(last, time)) if counts else (time, time)
                counts[channel] += 1
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.append((opcode, start, end))
        self._budget.spend(0, records)
        for opcode, start, end in definitions:
            self._add_definition(opcode, data[start:end], checked=has_checksum)
        numbers = array("I", [number for item in counts.items() for number in item])
        crc = zlib.crc32(data)
        self.result.blocks.append(Block(offset, length, is_chunk, has_checksum, crc, len(data), first, last, numbers))

    def _add_definition(self, opcode: int, body: bytes, *, checked: bool) -> None:
        """Add a channel or schema; our own writer repeats them in every chunk."""
        key = blake2b(bytes([opcode, checked]) + body, digest_size=16).digest()
        if key not in self._definitions:
            record = parse_record(opcode, body)
            self._budget.keep(len(body), len(getattr(record, "metadata", ())))
            (self.result.checked if checked else self.result.unchecked).append(record)
            self._definitions.add(key)

    def _skip_corrupt(self, position: int, what: str) -> int:
        """Add a corrupt region, and return where the next intact data begins."""
        after = self._limit
        try:
            _, length = self._read_header(position)
            following = position + RECORD_HEADER.size + length
            if following < self._limit:
                self._read_header(following)
            after = following
        except CorruptRecordError:
            pass
        # Even where a record can follow: a corrupt record header may skip chunks that are intact.
        found = find_chunk(self._stream, position + 1, self._limit, after, self._budget)
        after = after if found is None else found
        self.result.chunks_lost += self._read(position, 1) == bytes([Opcode.CHUNK])
        first = self.result.blocks[-1].end if self.result.blocks else None
        self.result.corrupt.append(CorruptRegion(self._name, position, after, what, first))
        return after

    def _crc_until(self, end: int) -> int:
        """Return the checksum of the file up to a position."""
        crc = 0
        for start in range(0, end, _READ_BYTES):
            crc = zlib.crc32(self._read(start, min(_READ_BYTES, end - start)), crc)
        return crc

    def _read(self, position: int, length: int) -> bytes:
        self._stream.seek(position)
        return self._stream.read(length)


class McapFile:
    """An mcap file, open for reading.

    A file of this machine is verified as it is opened. Of one that a URL names, its index is taken where that has a
    correct checksum (see `read_index`), and each chunk is verified as it is read.

    Args:
        path: the file.
        budget: of the bag.
        progress: called with the number of bytes scanned since the last call.

    Attributes:
        path: the file.
        connections: by number.
        counts: number of messages that can be read, by connection.
        start: time of the first of them [ns]; 0 if there are none.
        end: time of the last of them [ns].
        notes: notes of our writer.
        damage: what is corrupt and lost; None if nothing is.
        unchecked: why damage may not have been noticed, in one line; empty if it would have been.
        facts: properties of the file for a person, for example chunks and compression.
        others: number of records that are no messages and not ours, by kind.

    Raises:
        BagError: it cannot be read, is empty, or is no mcap file.
    """

    def __init__(self, path: Path, budget: UnpackBudget, progress: Callable[[int], None] = lambda count: None) -> None:
        self.path = path
        self.damage: DamageReport | None = None
        try:
            with open_ranges(path) as stream:
                size = stream.seek(0, 2)
                if not size:
                    raise BagError(path, "is empty, expected an mcap file")
                summary = read_summary(stream, size, budget)
                scan = read_index(stream, summary, budget) if is_url(path) and summary is not None else None
                if scan is None:
                    limit = summary.start if summary is not None else size
                    scan = Scanner(path.name, stream, limit, budget, progress).scan()
                    stream.seek(0)
                    head = stream.read(HEAD_BYTES)
                    if not head.startswith(MAGIC) and not scan.blocks and summary is None:
                        raise BagError(path, substitute_problem(head) or "is no mcap file")
        except OSError as error:
            raise BagError(path, f"cannot be read: {error.strerror or error}") from error
        except BudgetError as error:
            raise BagError(path, str(error)) from None
        if scan.index is not None:
            blocks, counts, self.connections = scan.blocks, scan.index, connections_of(scan.checked)
        else:
            blocks = self._salvage(scan, summary, size)
            counts = count_messages(blocks)
        self.counts = {channel: counts[channel] for channel in self.connections if counts[channel]}
        self.unchecked = ""
        if not scan.data_verified and not all(block.has_checksum for block in blocks):
            some = any(block.has_checksum for block in blocks)
            what = "has messages without a checksum: damage to them" if some else "has no checksums: damage to it"
            self.unchecked = f"{what} cannot be noticed"
        self.notes = _notes(scan)
        others = sum(record.name not in (NOTES, "rosbag2") for record in scan.metadata)
        private = scan.private_records
        kinds = {"attachment": scan.attachments, "metadata record": others, "record of a private kind": private}
        self.others = +Counter(kinds)  # those that there are
        used = set(self.counts)
        self._blocks = sorted((block for block in blocks if block.holds(used)), key=lambda block: block.start)
        self.start = min((block.start for block in self._blocks), default=0)
        self.end = max((block.end for block in self._blocks), default=0)
        checked = sum(block.has_checksum for block in self._blocks)
        chunks = sum(block.is_chunk for block in self._blocks)
        data = "; of all data too" if scan.data_verified else ""
        data = ", verified as they are read" if scan.index is not None else data
        self.facts = {
            "format": "mcap",
            "bytes": str(size),
            "chunks": str(chunks),
            "compression": ", ".join(sorted(name or "none" for name in scan.compressions)) or "none",
            "checksums": f"of {checked} of {pluralize(chunks, 'chunk')}{data}",
        }

    def messages(self, connections: Collection[int], start: int, end: int) -> Iterator[StoredMessage]:
        """Yield the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was scanned, or cannot be read any more.
        """
        wanted = frozenset(connections) & set(self.counts)
        try:
            with open_ranges(self.path) as stream:
                yield from merge_by_time(
                    (block.start, partial(self._read_block, stream, block, wanted, start, end))
                    for block in self._blocks
                    if block.start <= end and block.end >= start and block.holds(wanted)
                )
        except OSError as error:
            raise BagError(self.path, f"cannot be read: {error.strerror or error}") from error

    def _read_block(
        self, stream: BinaryIO, block: Block, wanted: frozenset[int], start: int, end: int
    ) -> Iterator[StoredMessage]:
        found = []
        try:
            data = _load(stream, block)
            for opcode, first, last in iterate_records(data):
                if opcode == Opcode.MESSAGE:
                    channel, sequence, time, publish_time = MESSAGE_HEADER.unpack_from(data, first)
                    if channel in wanted and start <= time <= end:
                        found.append((time, first + MESSAGE_HEADER.size, last, channel, sequence, publish_time))
        except CorruptRecordError as error:
            if block.crc is not None:
                raise BagError(self.path, "has changed while it was read") from None
            problem = f"has {error} at byte {block.offset}; copy it to this machine to read what is intact"
            raise BagError(self.path, problem) from None
        found.sort()
        for time, first, last, channel, sequence, publish_time in found:
            yield StoredMessage(time, self.connections[channel], data[first:last], publish_time, sequence)

    def _salvage(self, scan: ScanResult, summary: McapSummary | None, size: int) -> list[Block]:
        """Return the blocks that are used; set their connections and the damage.

        Args:
            scan: what the scan found.
            summary: the summary, if the file has one.
            size: length of the file in bytes.
        """
        name = self.path.name
        trusted = summary if summary is not None and summary.trusted else None
        blocks, spare, missing = _match_chunks(scan, trusted)
        regions = _corrupt_regions(name, size, scan, summary, blocks, missing)
        regions += [_region(name, [block], "an unindexed chunk, or a second copy of a chunk") for block in spare]
        is_counted = scan.ended and not scan.corrupt and not scan.private_records
        counts = count_messages(blocks)
        if summary is not None and not regions and (problem := _contradiction(summary, blocks, counts)):
            regions.append(CorruptRegion(name, summary.start, summary.end, problem))
            is_counted = False
        if scan.data_crc and not scan.data_verified and not regions:
            problem = "data other than messages does not match its checksum"
            regions.append(CorruptRegion(name, 0, scan.stopped, problem))
        verified = scan.data_verified or not regions
        if not verified and (loose := [block for block in blocks if not block.has_checksum]):
            blocks = [block for block in blocks if block.has_checksum]
            what = f"{pluralize(count_messages(loose).total(), 'message')} without a checksum, which may be wrong"
            regions.append(_region(name, loose, what))
        definitions = scan.checked + (scan.unchecked if verified else [])
        self.connections = connections_of(definitions + (trusted.definitions if trusted is not None else []))
        left = count_messages(blocks)
        if undefined := left.keys() - self.connections.keys():
            first_blocks = {channel: block for block in reversed(blocks) for channel in block.counts[::2]}
            for channel in sorted(undefined):
                what = (
                    f"{pluralize(left.pop(channel), 'message')} of a channel without a definition, or with conflicting"
                )
                regions.append(_region(name, [first_blocks[channel]], f"{what} ones"))
        if regions:
            used = left.total()
            is_counted = is_counted or (scan.data_verified and not scan.corrupt)
            lost = counts.total() - used if is_counted else None
            if trusted is not None and trusted.statistics is not None:
                lost = max(0, trusted.statistics.message_count - used)
            if lost == 0:
                regions = [replace(region, first=None, last=None) for region in regions]
            corrupt_bytes = sum(region.end - region.start for region in scan.corrupt)
            chunks = len(missing) if trusted is not None and trusted.chunks else scan.chunks_lost
            ordered = tuple(sorted(regions, key=lambda region: region.start))
            self.damage = DamageReport(ordered, chunks, corrupt_bytes, lost)
        return blocks


def _load(stream: BinaryIO, block: Block) -> bytes:
    """Return the records of a block.

    Raises:
        CorruptRecordError: they have changed since the file was scanned; of a block that was not read yet, they are
            corrupt or have no checksum.
    """
    stream.seek(block.offset)
    data = stream.read(block.length)
    if block.is_chunk:
        chunk, data = decompress_chunk(data)
        if block.crc is None and not chunk.uncompressed_crc:
            raise CorruptRecordError("a chunk without a checksum")
    if block.crc is not None and zlib.crc32(data) != block.crc:
        raise CorruptRecordError("other bytes than before")
    return data


def _notes(scan: ScanResult) -> dict[str, str]:
    entries = (record.metadata for record in scan.metadata if record.name == NOTES)
    found = (verified_notes(each, data_verified=scan.data_verified) for each in entries)
    return next((notes for notes in found if notes is not None), {})


def _region(name: str, blocks: list[Block], what: str) -> CorruptRegion:
    """Return the region from the first of some blocks to the last."""
    return CorruptRegion(name, blocks[0].offset, blocks[-1].offset + blocks[-1].length, what)


def _match_chunks(scan: ScanResult, trusted: McapSummary | None) -> tuple[list[Block], list[Block], list[Block]]:
    """Return the blocks that belong to a file, those that do not, and the chunks of its index that are missing.

    A chunk is known by its lengths and times, wherever it is. Without an index, one that is present twice counts once:
    a recorder does not write the same messages with the same times again, but a copy of a part of a file does. There
    its checksum counts too: nothing says that chunks of the same lengths and times are the same.
    """
    index = trusted.chunks if trusted is not None else []
    if not index and scan.data_verified:
        return scan.blocks, [], []

    def key(block: Block) -> tuple[int | None, ...]:
        return _identity(block) if index else (block.crc, *_identity(block))

    expected = Counter(map(key, index)) if index else Counter({key(block): 1 for block in scan.blocks})
    own, spare, missing = list[Block](), list[Block](), list[Block]()
    for block in scan.blocks:
        expected[key(block)] -= block.is_chunk
        (own if expected[key(block)] >= 0 or not block.is_chunk else spare).append(block)
    for block in index:
        if expected[key(block)] > 0:
            expected[key(block)] -= 1
            missing.append(block)
    return own, spare, missing


def _identity(block: Block) -> tuple[int, int, int, int]:
    return block.length, block.size, block.start, block.end


def _corrupt_regions(
    name: str, size: int, scan: ScanResult, summary: McapSummary | None, blocks: list[Block], missing: list[Block]
) -> list[CorruptRegion]:
    """Return the corrupt regions, its missing end included, with the times between which messages are missing."""
    regions = []
    missing = sorted(missing, key=_offset)
    for region in scan.corrupt:
        first, last = (bisect_left(missing, at, key=_offset) for at in (region.start, region.end))
        if inside := missing[first:last]:
            del missing[first:last]
            start, end = min(chunk.start for chunk in inside), max(chunk.end for chunk in inside)
            regions.append(replace(region, first=start, last=end))
        else:
            following = bisect_left(blocks, region.end, key=_offset)
            after = blocks[following].start if following < len(blocks) else None
            regions.append(replace(region, last=after))
    if summary is None and scan.ended:
        regions.append(CorruptRegion(name, scan.stopped, size, "its summary is missing or corrupt"))
    elif summary is None and regions and regions[-1].end == size:
        regions[-1] = replace(regions[-1], what="it is truncated or corrupt from here to its end")
    elif summary is None:
        last_time = scan.blocks[-1].end if scan.blocks else None
        regions.append(CorruptRegion(name, size, size, "it is truncated", last_time))
    elif not scan.corrupt and not scan.ended:
        regions.append(CorruptRegion(name, scan.stopped, scan.stopped, "the end of its data is missing"))
    return regions + [replace(_region(name, [b], "a chunk is missing"), first=b.start, last=b.end) for b in missing]


def _offset(block: Block) -> int:
    return block.offset


def _contradiction(summary: McapSummary, blocks: list[Block], counts: Counter[int]) -> str:
    """Return how a summary contradicts the messages; empty if it does not."""
    statistics = summary.statistics
    if statistics is None:
        return ""
    filled = [block for block in blocks if block.counts]
    start = min((block.start for block in filled), default=statistics.message_start_time)
    found = (
        counts.total(),
        start or statistics.message_start_time,  # writers take a start of 0 ns for none, and the next time for it
        max((block.end for block in filled), default=statistics.message_end_time),
    )
    claimed = (statistics.message_count, statistics.message_start_time, statistics.message_end_time)
    by_channel = {channel: count for channel, count in statistics.channel_message_counts.items() if count}
    if claimed == found and (not by_channel or by_channel == counts):
        return ""
    number = pluralize(statistics.message_count, "message")
    return f"its summary claims {number}, and other counts or times than the {counts.total()} that it holds"


def read_index(stream: BinaryIO, summary: McapSummary, budget: UnpackBudget) -> ScanResult | None:
    """Return what a file holds by its summary, as a scan would; None where that cannot be told, so that it needs one.

    It can be told where the summary has a correct checksum and counts of all channels, and covers the file: between the
    chunks, metadata and attachments that it lists there is nothing but definitions that it repeats. The first chunk
    must have a checksum; of one writer all chunks have one, or none.

    Args:
        stream: the file.
        summary: of the file.
        budget: of the bag.

    Raises:
        BudgetError: it holds more records or metadata than a file of its size may.
    """
    chunks, statistics = summary.chunks, summary.statistics
    if not (summary.trusted and chunks and all(0 <= block.length <= MAX_BLOCK_BYTES for block in chunks)):
        return None
    if statistics is None or statistics.chunk_count != len(chunks):
        return None
    counts = Counter(statistics.channel_message_counts)
    if counts.total() != statistics.message_count or counts.keys() - connections_of(summary.definitions).keys():
        return None
    stream.seek(0)
    magic = stream.read(len(MAGIC))
    stream.seek(chunks[0].offset)
    if magic != MAGIC or not any(stream.read(_CHUNK_CRC.stop)[_CHUNK_CRC]):
        return None
    scan = ScanResult(chunks, summary.definitions, attachments=statistics.attachment_count, index=counts)
    if not _is_covered(stream, summary, budget):
        return None
    try:
        for offset, length in summary.metadata:
            stream.seek(offset + RECORD_HEADER.size)
            body = stream.read(min(length - RECORD_HEADER.size, MAX_RECORD_BYTES + 1))
            scan.metadata.append(parse_record(Opcode.METADATA, body))
            budget.keep(len(body), len(scan.metadata[-1].metadata))
    except CorruptRecordError:
        return None
    return scan


def _is_covered(stream: BinaryIO, summary: McapSummary, budget: UnpackBudget) -> bool:
    """Return whether all records that may hold data are in the summary."""
    position = len(MAGIC)
    while position < summary.start:
        budget.spend(0, LONE_RECORD)
        if position in summary.lengths:
            position += max(RECORD_HEADER.size, summary.lengths[position])
            continue
        stream.seek(position)
        head = stream.read(RECORD_HEADER.size)
        if len(head) < RECORD_HEADER.size:
            return False
        opcode, length = RECORD_HEADER.unpack(head)
        position += RECORD_HEADER.size + length
        if opcode == Opcode.DATA_END:
            return bool(position == summary.start)
        if opcode not in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL):
            return False
    return False
