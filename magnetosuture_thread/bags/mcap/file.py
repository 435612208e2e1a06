"""Scans an mcap file as it is opened, or takes its index, and reads the messages of its intact blocks."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from magnetosuture_thread.bags.bag_folder import NOTES, verified_notes
from magnetosuture_thread.bags.mcap.records import (
    MAGIC,
    MESSAGE_HEADER,
    RECORD_HEADER,
    CorruptRecordError,
    decompress_chunk,
    has_chunk_checksum,
    iterate_records,
    parse_attachment,
    parse_record,
)
from magnetosuture_thread.bags.mcap.salvage import Salvage, salvage
from magnetosuture_thread.bags.mcap.scan import Block, Scanner, ScanResult
from magnetosuture_thread.bags.mcap.summary import IndexedChunk, McapSummary, read_summary
from magnetosuture_thread.bags.storage import StoredMessage, merge_by_time, pluralize
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.files import is_url, open_ranges
from magnetosuture_thread.untrusted import LONE_RECORD, MAX_BLOCK_BYTES, MAX_RECORD_BYTES, BudgetError, UnpackBudget

ROSBAG2 = "rosbag2"  # the metadata record in which rosbag2 keeps a copy of metadata.yaml


class McapFile:
    """An mcap file, open for reading; implements `BagStorage`, where the attributes are described.

    A file of this machine is verified as it is opened. Of one that a URL names, its index is taken where that has a
    correct checksum (see `read_index`), and each chunk is verified as it is read.

    Args:
        path: the file.
        budget: of the bag.
        progress: called with the number of bytes scanned since the last call.

    Raises:
        BagError: it cannot be read, is empty, or is no mcap file.
    """

    def __init__(self, path: Path, budget: UnpackBudget, progress: Callable[[int], None] = lambda count: None) -> None:
        self.path = path
        try:
            with open_ranges(path) as stream:
                size = stream.seek(0, 2)
                if not size:
                    raise BagError(path, "is empty, expected an mcap file")
                summary = read_summary(stream, size, budget)
                indexed = read_index(stream, summary, budget) if is_url(path) else None
                if indexed is not None:
                    scan, salvaged = indexed
                else:
                    scan = Scanner(path, stream, size, summary, budget, progress).scan()
                    stream.seek(0)
                    if stream.read(len(MAGIC)) != MAGIC and not scan.blocks and summary is None:
                        raise BagError(path, "is no mcap file")
                    salvaged = salvage(path.name, size, scan, summary, partial(_count_messages, stream))
        except OSError as error:
            raise BagError(path, f"cannot be read: {error.strerror or error}") from error
        except BudgetError as error:
            raise BagError(path, str(error)) from None
        self._scan, self._verified = scan, scan.data_crc_matches or salvaged.damage is None
        self.connections = salvaged.connections
        self.counts = salvaged.counts
        self.notes = salvaged.notes
        self.damage = salvaged.damage
        self.unchecked = salvaged.unchecked
        self.profile, self.library = scan.profile, scan.library
        used = set(self.counts)
        self._blocks = [block for block in salvaged.blocks if block.holds(used)]
        self.start = min((block.start for block in self._blocks), default=0)
        self.end = max((block.end for block in self._blocks), default=0)
        self._blocks.sort(key=lambda block: block.start)
        checked = sum(block.has_checksum for block in self._blocks)
        chunks = sum(block.is_chunk for block in self._blocks)
        data = "; of all data too" if scan.data_crc_matches else ""
        data = ", verified as they are read" if indexed is not None else data
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

    def extras(self, dropped: Counter[str]) -> Iterator[Attachment | Metadata]:
        """Yield metadata records that are neither our notes nor rosbag2's, then attachments.

        Args:
            dropped: counts what cannot be vouched for, or is of another kind, by reason.
        """
        for record in self._scan.metadata:
            if record.name in (NOTES, ROSBAG2):
                continue
            if self._verified:
                yield record
            else:
                dropped["metadata record without a checksum in a damaged file"] += 1
        if self._scan.private_records:
            dropped["record of a private kind"] += self._scan.private_records
        try:
            with open_ranges(self.path) as stream:
                for start, length in self._scan.attachments:
                    stream.seek(start)
                    attachment, checked = None, False
                    if length <= MAX_BLOCK_BYTES:
                        attachment, checked = parse_attachment(stream.read(length))
                    if attachment is None:
                        dropped["corrupt or oversized attachment"] += 1
                    elif not checked and not self._verified:
                        dropped["attachment without a checksum in a damaged file"] += 1
                    else:
                        yield attachment
        except OSError as error:
            raise BagError(self.path, f"cannot be read: {error.strerror or error}") from error


def _load(stream: BinaryIO, block: Block) -> bytes:
    """Return the records of a block.

    Raises:
        CorruptRecordError: they have changed since the file was scanned; of a block that was not read yet, they are
            corrupt or have no checksum.
    """
    stream.seek(block.offset)
    data = stream.read(block.length)
    crc = zlib.crc32(data)
    if block.is_chunk:
        content = decompress_chunk(data)
        data, crc = content.data, content.crc
        if block.crc is None and not content.has_checksum:
            raise CorruptRecordError("a chunk without a checksum")
    if block.crc is not None and crc != block.crc:
        raise CorruptRecordError("other bytes than before")
    return data


def _count_messages(stream: BinaryIO, block: Block) -> Counter[int]:
    data = _load(stream, block)
    return Counter(
        MESSAGE_HEADER.unpack_from(data, first)[0]
        for opcode, first, _ in iterate_records(data)
        if opcode == Opcode.MESSAGE
    )


def read_index(
    stream: BinaryIO, summary: McapSummary | None, budget: UnpackBudget
) -> tuple[ScanResult, Salvage] | None:
    """Return what a file holds by its summary, as a scan would; None where that cannot be told, so that it needs one.

    It can be told where the summary has a correct checksum and counts of all channels, and covers the file: between the
    chunks, metadata and attachments that it lists there is nothing but definitions that it repeats. The first chunk
    must have a checksum; of one writer all chunks have one, or none.

    Args:
        stream: the file.
        summary: of the file, if there is one.
        budget: of the bag.

    Raises:
        BudgetError: it holds more records than a file of its size may.
    """
    if summary is None or not summary.trusted or summary.shifted or summary.trailing_bytes or not summary.chunks:
        return None
    statistics = summary.statistics
    if statistics is None or statistics.chunk_count != len(summary.chunks):
        return None
    connections = summary.channels.connections()
    counts = {number: count for number, count in statistics.channel_message_counts.items() if count}
    if sum(counts.values()) != statistics.message_count or not counts.keys() <= connections.keys():
        return None
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC or not has_chunk_checksum(stream, summary.chunks[0].offset):
        return None
    try:
        scan = ScanResult(blocks=[_block(chunk) for chunk in summary.chunks], ended=True, data_crc_matches=False)
        if not _is_covered(stream, summary, scan, budget):
            return None
        scan.metadata = _metadata(stream, summary, budget)
    except CorruptRecordError:
        return None
    scan.attachments = [(start + RECORD_HEADER.size, size - RECORD_HEADER.size) for start, size in summary.attachments]
    found = (verified_notes(record.metadata) for record in scan.metadata if record.name == NOTES)
    notes = next((notes for notes in found if notes is not None), {})
    return scan, Salvage(scan.blocks, connections, counts, notes, damage=None, unchecked="")


def _block(chunk: IndexedChunk) -> Block:
    """Return a chunk as a block that has not been read."""
    start, length = chunk.offset + RECORD_HEADER.size, chunk.length - RECORD_HEADER.size
    return Block(start, length, True, True, None, chunk.size, chunk.start, chunk.end, chunk.channels)


def _is_covered(stream: BinaryIO, summary: McapSummary, scan: ScanResult, budget: UnpackBudget) -> bool:
    """Return whether all records that may hold data are in the summary; adds profile and library to the scan."""
    listed = {chunk.offset: chunk.length + chunk.index_length for chunk in summary.chunks}
    listed |= {record.offset: record.length for record in summary.metadata} | dict(summary.attachments)
    position = len(MAGIC)
    while position < summary.start:
        budget.spend(0, LONE_RECORD)
        if position in listed:
            position += max(RECORD_HEADER.size, listed[position])
            continue
        stream.seek(position)
        head = stream.read(RECORD_HEADER.size)
        if len(head) < RECORD_HEADER.size:
            return False
        opcode, length = RECORD_HEADER.unpack(head)
        if opcode == Opcode.DATA_END:
            return position + RECORD_HEADER.size + int(length) == summary.start
        if opcode == Opcode.HEADER and length <= MAX_RECORD_BYTES:
            record = parse_record(opcode, stream.read(length))
            scan.profile, scan.library = record.profile, record.library
        elif opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return False
        position += RECORD_HEADER.size + length
    return False


def _metadata(stream: BinaryIO, summary: McapSummary, budget: UnpackBudget) -> list[Metadata]:
    records = []
    for entry in summary.metadata:
        stream.seek(entry.offset + RECORD_HEADER.size)
        length = min(entry.length - RECORD_HEADER.size, MAX_RECORD_BYTES + 1)
        record = parse_record(Opcode.METADATA, stream.read(length))
        budget.keep(length, len(record.metadata))
        records.append(record)
    return records
