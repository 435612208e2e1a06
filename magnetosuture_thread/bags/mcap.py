"""Reads mcap files, whole or damaged, by the package `mcap`: verifies checksums, reports loss, yields what is intact.

Data that may be wrong is never used. A chunk with a correct checksum is used. Data without a checksum (messages outside
of chunks, chunks of writers that write none, and the channels defined there) is used only where the checksum of the
data section is correct, or where the file shows no damage at all: every record parses, and it has an end and a summary
that agrees with the messages. In a file with any other damage it is not used.

Behind corrupt bytes the scan continues at the next chunk with a correct checksum, or at the end of the data.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, DataEnd, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC as MAGIC

from magnetosuture_thread.bags import storage
from magnetosuture_thread.bags.storage import Budget, Connection, CorruptRegion, DamageReport, MessageDefinition
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import HEAD_BYTES, is_url, substitute_problem

_RECORD = struct.Struct("<BQ")  # opcode and length of the content
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data
_MIN_PRIVATE_OPCODE = 0x80
_PIECE_BYTES = 1 << 22  # searched or read at a time; and the most of a record that is no message or chunk
# A chunk: opcode, length of less than a terabyte, times, size and checksum, a known compression; or the data's end.
_CHUNK_OR_END = re.compile(
    rb"\x06.{5}\0{3}.{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}).{5}\0{3}"
    rb"|\x0f\x04\0{7}.{4}[\x02-\x04\x08\x0a\x0b\x0d].{5}\0{3}",
    re.DOTALL,
)


class CorruptError(Exception):
    """Bytes that are no valid record; the text gives the reason."""


def split_records(
    read: Callable[[int, int], bytes], size: int, position: int = 0
) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield opcode, start and end of each record from a position on, and its first bytes.

    Args:
        read: returns the bytes from a position to another.
        size: where the last record ends.
        position: where the first one begins.

    Raises:
        CorruptError: a record is longer than the rest or than it may be, or none.
    """
    while position < size:
        head = read(position, position + _RECORD.size + _MESSAGE.size)
        opcode, length = _RECORD.unpack_from(head) if len(head) >= _RECORD.size else (0, size)
        end = position + _RECORD.size + length
        if end > size:
            raise CorruptError("it is truncated or corrupt")
        if opcode == Opcode.MESSAGE:
            is_valid = _MESSAGE.size <= length <= storage.MAX_RECORD_BYTES
        elif opcode == Opcode.MESSAGE_INDEX:
            is_valid = int.from_bytes(head[11:15], "little") == length - 6
        elif opcode == Opcode.ATTACHMENT or opcode >= _MIN_PRIVATE_OPCODE:
            is_valid = True
        else:
            most = storage.MAX_RECORD_BYTES if opcode == Opcode.CHUNK else _PIECE_BYTES
            is_valid = Opcode.HEADER <= opcode <= Opcode.DATA_END and length <= most
        if not is_valid:
            raise CorruptError("no record where one is expected")
        yield opcode, position, end, head
        position = end


def read_range(stream: BinaryIO, start: int, end: int) -> bytes:
    """Return the bytes of a file from a position to another."""
    stream.seek(start)
    return stream.read(end - start)


def parse_record(record: bytes) -> Any:
    """Return a record, its header included, as the package `mcap` parses it.

    Raises:
        CorruptError: the bytes are no such record.
    """
    try:
        return next(StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True).records)
    except (McapError, struct.error, ValueError, OverflowError, StopIteration):
        raise CorruptError("a corrupt record") from None


def unpack_chunk(record: bytes, budget: Budget | None = None) -> tuple[bytes, bool]:
    """Return the records of a chunk, and whether it has a checksum, which then is correct.

    The package `mcap` would unpack to any size.

    Args:
        record: with its header.
        budget: of the bag; None where the chunk has been counted.

    Raises:
        CorruptError: it cannot be decompressed, or its checksum is wrong.
    """
    chunk = parse_record(record)
    size, data = chunk.uncompressed_size, chunk.data
    # Behind times, size, checksum, compression and length of the records; the package reads what there is.
    begin = _RECORD.size + 40 + len(chunk.compression)
    if size > storage.MAX_RECORD_BYTES or record[begin - 8 : begin] != (len(record) - begin).to_bytes(8, "little"):
        raise CorruptError(f"a chunk of {size} bytes, or of a wrong length")
    if budget is not None:
        budget.spend("unpacked bytes", len(record) + size)
    try:
        if chunk.compression == "zstd" and zstandard.frame_content_size(data) in (-1, size):  # -1: not known
            data = storage.unpack_zstd(data, size)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif chunk.compression:
            raise CorruptError("a chunk of a wrong size or an unknown compression")
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError):
        raise CorruptError("a chunk that cannot be decompressed") from None
    if len(data) != size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise CorruptError("a chunk with a wrong checksum")
    return data, chunk.uncompressed_crc != 0


@dataclass(slots=True)
class Block:
    """A chunk, or a run of messages outside of chunks.

    Attributes:
        offset: where its first record begins in the file.
        length: number of bytes, record headers included.
        is_chunk: whether it is a chunk.
        has_checksum: whether it has a checksum of its own.
        crc: of a chunk's records, computed; None where it is not read yet.
        start: time of its first message [ns].
        end: time of its last message [ns].
        counts: number of messages by channel; 0 where they are not counted yet.
    """

    offset: int
    length: int
    is_chunk: bool = False
    has_checksum: bool = False
    crc: int | None = None
    start: int = 0
    end: int = 0
    counts: dict[int, int] = field(default_factory=dict)

    def add(self, head: bytes) -> None:
        """Count a message, by the first bytes of its record."""
        channel, _, time, _ = _MESSAGE.unpack_from(head, _RECORD.size)
        self.start, self.end = (min(self.start, time), max(self.end, time)) if self.counts else (time, time)
        self.counts[channel] = self.counts.get(channel, 0) + 1


def connections_of(definitions: Iterable[Any]) -> dict[int, Connection]:
    """Return the channels whose definition, and that of their schema, is without conflict."""
    schemas: dict[int, Any] = {0: Schema(0, b"", "", "")}
    channels: dict[int, Any] = {}
    for record in definitions:
        table = schemas if isinstance(record, Schema) else channels
        if table.setdefault(record.id, record) != record:
            table[record.id] = None
    known: dict[int, Connection] = {}
    for number, channel in channels.items():
        if channel is not None and (schema := schemas.get(channel.schema_id)) is not None:
            definition = MessageDefinition(schema.name, schema.encoding, schema.data.decode("utf-8", "surrogateescape"))
            known[number] = Connection(channel.topic, definition, channel.message_encoding, channel.metadata)
    return known


class McapFile:
    """An mcap file, open for reading.

    A file of this machine is verified as it is opened. Of one that a URL names, the index is taken where that has a
    correct checksum and counts of all messages, and each chunk is verified as it is read.

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
        has_no_checksum: why damage may not have been noticed, in one line; empty if it would have been.
        facts: properties of the file for a person, for example chunks and compression.
        others: number of records that are no messages and not ours, by kind.

    Raises:
        BagError: it cannot be read, is empty, or is no mcap file.
    """

    def __init__(self, path: Path, budget: Budget, progress: Callable[[int], None] = lambda count: None) -> None:
        self.path = path
        self.damage: DamageReport | None = None
        self.others: Counter[str] = Counter()
        self.connections: dict[int, Connection] = {}
        self.counts: Counter[int] = Counter()
        self._budget = budget
        self._blocks: list[Block] = []
        self._regions: list[CorruptRegion] = []
        # By the bytes of their records.
        self._definitions: dict[str, dict[bytes, Any]] = {"verified": {}, "loose": {}, "summary": {}}
        self._metadata: list[Metadata] = []
        self._statistics: Statistics | None = None
        self._data_end = self._data_crc = 0  # where the data section ends, 0 where that is not known; its checksum
        self._is_verified = self._is_trusted = False  # the data by its checksum; the summary by its own
        with storage.refusing_unreadable(path), storage.open_file(path) as stream:
            size = stream.seek(0, 2)
            head = read_range(stream, 0, HEAD_BYTES)
            if not size:
                raise BagError(path, "is empty, expected an mcap file")
            is_indexed = is_url(path) and self._read_index(stream, size)
            if not is_indexed:
                self._scan(stream, size, progress)
        if not (head.startswith(MAGIC) or self._blocks or self._is_trusted):
            raise BagError(path, substitute_problem(head) or "is no mcap file")
        if not is_indexed:
            self._salvage(size)
        self._blocks = [block for block in self._blocks if not block.counts.keys().isdisjoint(self.counts)]
        self._blocks.sort(key=lambda block: block.start)
        self.start = min((block.start for block in self._blocks), default=0)
        self.end = max((block.end for block in self._blocks), default=0)
        verified = sum(block.has_checksum for block in self._blocks)
        self.has_no_checksum = ""
        if not self._is_verified and verified < len(self._blocks):
            what = "has messages without a checksum: damage to them" if verified else "has no checksums: damage to it"
            self.has_no_checksum = f"{what} cannot be noticed"
        records = [record.metadata for record in self._metadata if record.name == storage.NOTES]
        notes = (storage.verified_notes(entries, data_verified=self._is_verified) for entries in records)
        self.notes = next((entries for entries in notes if entries is not None), {})
        self.others["metadata record"] = sum(record.name not in (storage.NOTES, "rosbag2") for record in self._metadata)
        self.others = +self.others  # without those that there are none of
        chunks = sum(block.is_chunk for block in self._blocks)
        data = "; of all data too" if self._is_verified else ", verified as they are read" if is_indexed else ""
        checksums = f"of {verified} of {storage.pluralize(chunks, 'chunk')}{data}"
        self.facts = {"format": "mcap", "bytes": str(size), "chunks": str(chunks), "checksums": checksums}

    def messages(self, connections: Collection[int], start: int, end: int) -> Iterator[storage.StoredMessage]:
        """Yield the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was scanned, or cannot be read any more.
        """
        wanted = frozenset(connections) & set(self.counts)
        with storage.refusing_unreadable(self.path), storage.open_file(self.path) as stream:
            yield from storage.merge_by_time(
                (block.start, self._read_block(stream, block, wanted, start, end))
                for block in self._blocks
                if block.start <= end and block.end >= start and not wanted.isdisjoint(block.counts)
            )

    def _read_block(
        self, stream: BinaryIO, block: Block, wanted: frozenset[int], start: int, end: int
    ) -> Iterator[storage.StoredMessage]:
        messages = []
        try:
            data = read_range(stream, block.offset, block.offset + block.length)
            if block.is_chunk:
                data, has_checksum = unpack_chunk(data)
                if not has_checksum if block.crc is None else block.crc != zlib.crc32(data):
                    raise CorruptError("a chunk without a checksum, or other bytes than before")
            for opcode, first, last, head in split_records(lambda start, end: data[start:end], len(data)):
                if opcode == Opcode.MESSAGE:
                    channel, sequence, time, publish_time = _MESSAGE.unpack_from(head, _RECORD.size)
                    if channel in wanted and start <= time <= end:
                        messages.append((time, first + len(head), last, channel, sequence, publish_time))
        except CorruptError as error:
            problem = f"has {error} at byte {block.offset}; `bag check` of a copy tells what is intact"
            raise BagError(self.path, problem) from None
        for time, first, last, channel, sequence, publish_time in sorted(messages):
            yield storage.StoredMessage(time, self.connections[channel], data[first:last], publish_time, sequence)

    def _read_index(self, stream: BinaryIO, size: int) -> bool:
        """Take what the file holds from its summary; return whether that tells it, so that it need not be scanned."""
        try:
            stream.seek(0)
            summary = make_reader(stream).get_summary()
            if summary is None or summary.statistics is None:
                return False
            metadata = [
                parse_record(read_range(stream, entry.offset, entry.offset + min(entry.length, _PIECE_BYTES)))
                for entry in summary.metadata_indexes
            ]
            footer = parse_record(read_range(stream, size - _RECORD.size - 20 - len(MAGIC), size))
        except (McapError, CorruptError, struct.error, ValueError):
            return False
        statistics, chunks = summary.statistics, summary.chunk_indexes
        self.counts = +Counter(statistics.channel_message_counts)
        self.connections = connections_of([*summary.schemas.values(), *summary.channels.values()])
        if not (
            _crc(stream, footer.summary_start, size - len(MAGIC) - 4) == footer.summary_crc != 0
            and self.counts.total() == statistics.message_count
            and self.counts.keys() <= self.connections.keys()
            and statistics.chunk_count == len(chunks) > 0
            and all(index.message_index_offsets for index in chunks)
        ):
            return False
        for index in chunks:
            counts = dict.fromkeys(index.message_index_offsets, 0)
            times = index.message_start_time, index.message_end_time
            block = Block(index.chunk_start_offset, index.chunk_length, True, True, None, *times, counts)
            self._blocks.append(block)
        self._metadata, self.others["attachment"] = metadata, statistics.attachment_count
        return True

    def _scan(self, stream: BinaryIO, size: int, progress: Callable[[int], None]) -> None:
        """Scan the file record by record; behind corrupt bytes, from the next intact place on."""
        position = sound = len(MAGIC)  # the latter: where the last intact chunk, or the data section, ends
        has_footer = False
        if read_range(stream, 0, len(MAGIC)) != MAGIC:
            self._add_region("not the first bytes of an mcap file", 0, len(MAGIC))
        while position < size:
            before = position
            try:
                for opcode, start, end, head in split_records(partial(read_range, stream), size, position):
                    self._add(stream, opcode, start, end, head)
                    position = end
                    if opcode == Opcode.DATA_END or (opcode == Opcode.CHUNK and self._blocks[-1].has_checksum):
                        sound = end
                    elif opcode == Opcode.FOOTER:
                        self._verify_summary(stream, start, end, size)
                        position, has_footer = size, True
                        break
            except CorruptError as error:
                after = self._find_intact(stream, sound, size, position)
                start = position if after > position else sound  # A corrupt length may lead past intact chunks.
                self._add_region(str(error), start, after, self._blocks[-1].end if self._blocks else None)
                position = after
            progress(max(0, position - before))
        if not has_footer and not any(region.end == size for region in self._regions):
            self._add_region("it is truncated", size, size, self._blocks[-1].end if self._blocks else None)

    def _add_region(self, what: str, start: int, end: int, first: int | None = None) -> None:
        self._regions.append(CorruptRegion(self.path.name, start, end, what, first))

    def _add(self, stream: BinaryIO, opcode: int, start: int, end: int, head: bytes) -> None:
        """Add a record of the file."""
        # A record outside of chunks takes the time of five within. An index comes with a message of its chunk: small
        # chunks of many topics are mostly such indexes.
        self._budget.spend("records", 5)
        self.others["attachment"] += opcode == Opcode.ATTACHMENT
        self.others["record of a private kind"] += opcode >= _MIN_PRIVATE_OPCODE
        if opcode == Opcode.MESSAGE:
            run = self._blocks[-1] if self._blocks else Block(0, 0)
            if run.is_chunk or run.offset + run.length != start or run.length > 1 << 20:  # bytes, read at a time
                run = Block(start, 0)
                self._blocks.append(run)
            run.length = end - run.offset
            run.add(head)
        elif opcode == Opcode.CHUNK:
            self._add_chunk(read_range(stream, start, end), start)
        elif opcode not in (Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT) and opcode < _MIN_PRIVATE_OPCODE:
            record = read_range(stream, start, end)
            match self._parse_and_keep(record):
                case DataEnd(data_section_crc=crc):
                    self._data_end, self._data_crc = end, crc
                    self._is_verified = crc != 0 and _crc(stream, 0, start) == crc
                case Metadata() as metadata:
                    self._metadata.append(metadata)
                case Statistics() as statistics:
                    self._statistics = statistics
                case Schema() | Channel() as definition:
                    self._definitions["summary" if self._data_end else "loose"][record] = definition

    def _add_chunk(self, record: bytes, position: int) -> None:
        """Add a chunk and its definitions; nothing of it where a record is corrupt."""
        data, has_checksum = unpack_chunk(record, self._budget)
        block = Block(position, len(record), True, has_checksum, zlib.crc32(data))
        definitions = {}
        for opcode, start, end, head in split_records(lambda start, end: data[start:end], len(data)):
            self._budget.spend("records", 1)
            if opcode == Opcode.MESSAGE:
                block.add(head)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and data[start:end] not in self._definitions["verified"]:
                definitions[data[start:end]] = self._parse_and_keep(data[start:end])
        self._definitions["verified" if has_checksum else "loose"] |= definitions
        self._blocks.append(block)

    def _parse_and_keep(self, record: bytes) -> Any:
        """Return a record; in memory it takes its bytes twice, and 150 bytes for each of its entries."""
        parsed = parse_record(record)
        builder = RecordBuilder()
        parsed.write(builder)
        if builder.count != len(record):  # the package reads what there is, and leaves what is too much
            raise CorruptError("a record of a wrong length")
        entries: Any = getattr(parsed, "metadata", None) or getattr(parsed, "message_index_offsets", ())
        self._budget.spend("bytes of definitions", 2 * len(record) + 500 + 150 * len(entries))
        return parsed

    def _verify_summary(self, stream: BinaryIO, start: int, end: int, size: int) -> None:
        """Verify the summary by the footer, behind which only the magic may be."""
        footer, magic = parse_record(read_range(stream, start, end)), stream.read()
        self._is_trusted = _crc(stream, self._data_end, start + _RECORD.size + 16) == footer.summary_crc != 0
        if end != size - len(MAGIC) or magic != MAGIC or not (self._is_trusted or footer.summary_crc == 0):
            raise CorruptError("a summary or an end with a wrong checksum")

    def _find_intact(self, stream: BinaryIO, position: int, size: int, corrupt: int) -> int:
        """Return where the next chunk with a correct checksum, or the end of the data, begins; the size if nowhere.

        A chunk without a checksum does not count: it cannot be told from message data that looks like one.

        Args:
            stream: the file.
            position: where the search begins.
            size: of the file.
            corrupt: where none begins.
        """
        while position < size:
            window = read_range(stream, position, position + _PIECE_BYTES)
            self._budget.spend("unpacked bytes", len(window))
            for match in _CHUNK_OR_END.finditer(window):
                at = position + match.start()
                opcode, length = _RECORD.unpack_from(window, match.start())
                if at == corrupt or length > min(storage.MAX_RECORD_BYTES, size - at):
                    continue
                record = read_range(stream, at, at + _RECORD.size + length)
                with suppress(CorruptError):
                    if opcode == Opcode.DATA_END or unpack_chunk(record, self._budget)[1]:
                        return at
            position += max(1, len(window) - 64)  # more than a match
        return size

    def _salvage(self, size: int) -> None:
        """Keep the blocks that can be used, and set connections, counts and damage."""
        statistics, regions = self._statistics, self._regions
        corrupt_bytes = sum(region.end - region.start for region in regions)
        is_private = self.others["record of a private kind"] > 0
        is_whole = not is_private and self._data_end > 0 and all(r.start >= self._data_end for r in regions)
        is_scanned = is_whole or self._is_verified
        # A recorder does not write the same messages with the same times again, but a copy of a part of a file does.
        is_odd = regions or statistics is None or _contradiction(statistics, self._blocks)
        if is_odd and not self._is_verified:
            chunks = [block for block in self._blocks if block.is_chunk]
            once = {(block.crc, block.start, block.end): block for block in reversed(chunks)}
            copies = [block for block in chunks if once[block.crc, block.start, block.end] is not block]
            self._blocks = [block for block in self._blocks if block not in copies]
            for block in copies:
                self._add_region("a second copy of a chunk", *_extent([block]))
        scanned = _count(self._blocks).total()
        if not regions and statistics is not None and (problem := _contradiction(statistics, self._blocks)):
            self._add_region(problem, self._data_end, size)
            is_scanned = False
        if not regions and not self._is_verified and self._data_crc:
            self._add_region("data other than messages does not match its checksum", 0, size)
        if not regions and not self._is_verified and statistics is None and is_private:
            self._add_region("records of a private kind, which may be corrupt others", 0, size)
        is_sound = self._is_verified or not regions
        loose = [block for block in self._blocks if not block.has_checksum]
        if loose and not is_sound:
            self._blocks = [block for block in self._blocks if block.has_checksum]
            count = storage.pluralize(_count(loose).total(), "message")
            self._add_region(f"{count} without a checksum, which may be wrong", *_extent(loose))
        usable = {"verified": True, "loose": is_sound, "summary": self._is_trusted}
        definitions = (table.values() for kind, table in self._definitions.items() if usable[kind])
        self.connections = connections_of(chain.from_iterable(definitions))
        self.counts = _count(self._blocks)
        for channel in sorted(self.counts.keys() - self.connections.keys()):
            block = next(block for block in self._blocks if channel in block.counts)
            count = storage.pluralize(self.counts.pop(channel), "message")
            self._add_region(f"{count} of a channel without a definition, or with two", *_extent([block]))
        if regions:
            self._report_damage(corrupt_bytes, scanned if is_scanned else None)

    def _report_damage(self, corrupt_bytes: int, scanned: int | None) -> None:
        """Set the damage: what the summary claims and is not used, else what was scanned and is not."""
        used, statistics = self.counts.total(), self._statistics
        lost = None if scanned is None else scanned - used
        lost_chunks = sum("chunk" in region.what for region in self._regions)
        if statistics is not None and self._is_trusted:
            lost = max(0, statistics.message_count - used)
            lost_chunks = max(0, statistics.chunk_count - sum(block.is_chunk for block in self._blocks))
        regions = []
        for region in sorted(self._regions, key=lambda region: region.start):
            following = next((block.start for block in self._blocks if block.offset >= region.end), None)
            first, last = (None, None) if lost == 0 else (region.first, following)
            regions.append(replace(region, first=first, last=last))
        self.damage = DamageReport(tuple(regions), lost_chunks, corrupt_bytes, lost)


def _count(blocks: Iterable[Block]) -> Counter[int]:
    """Return the number of messages of each channel."""
    counts: Counter[int] = Counter()
    for block in blocks:
        counts.update(block.counts)
    return counts


def _extent(blocks: list[Block]) -> tuple[int, int]:
    """Return where the first of some blocks begins in the file, and where the last one ends."""
    return blocks[0].offset, blocks[-1].offset + blocks[-1].length


def _crc(stream: BinaryIO, start: int, end: int) -> int:
    """Return the checksum of a part of a file."""
    crc = 0
    stream.seek(start)
    while data := stream.read(min(_PIECE_BYTES, max(0, end - stream.tell()))):
        crc = zlib.crc32(data, crc)
    return crc


def _contradiction(statistics: Statistics, blocks: list[Block]) -> str:
    """Return how a summary contradicts the messages; empty if it does not."""
    counts = _count(blocks)
    start = min((block.start for block in blocks if block.counts), default=0)
    end = max((block.end for block in blocks if block.counts), default=statistics.message_end_time)
    is_same = statistics.message_count == counts.total()
    is_same = is_same and Counter(statistics.channel_message_counts) in (Counter(), counts)
    # Some writers take a start of 0 ns for none, and the next time for it.
    if is_same and end == statistics.message_end_time and start in (0, statistics.message_start_time):
        return ""
    number = storage.pluralize(statistics.message_count, "message")
    return f"its summary claims {number}, and other counts or times than the {counts.total()} that it holds"
