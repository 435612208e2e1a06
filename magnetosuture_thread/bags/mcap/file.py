"""Opens an mcap file: decides which of its data is used, reports what is corrupt and lost, and reads the messages.

Data that may be wrong is never used. A chunk with a correct checksum is used. Data without a checksum (messages outside
of chunks, chunks of writers that write none, and the channels defined there) is used only where the checksum of the
data section is correct, or where the file shows no damage at all: every record parses, and it has an end and a summary
that agrees with the messages. In a file with any other damage it is not used.
"""

from __future__ import annotations

import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from magnetosuture_thread.bags.mcap.records import (
    MAGIC,
    MESSAGE_HEADER,
    RECORD_HEADER,
    Block,
    ChannelTable,
    CorruptRecordError,
    McapSummary,
    decompress_chunk,
    has_chunk_checksum,
    iterate_records,
    parse_record,
    read_summary,
)
from magnetosuture_thread.bags.mcap.scan import Scanner, ScanResult
from magnetosuture_thread.bags.storage import (
    NOTES,
    Connection,
    CorruptRegion,
    DamageReport,
    StoredMessage,
    merge_by_time,
    pluralize,
    verified_notes,
)
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.files import is_url, open_ranges
from magnetosuture_thread.untrusted import LONE_RECORD, MAX_BLOCK_BYTES, MAX_RECORD_BYTES, BudgetError, UnpackBudget

UNCHECKED = "has no checksums: damage to it cannot be noticed"
PARTLY_UNCHECKED = "has messages without a checksum: damage to them cannot be noticed"


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
        try:
            with open_ranges(path) as stream:
                size = stream.seek(0, 2)
                if not size:
                    raise BagError(path, "is empty, expected an mcap file")
                summary = read_summary(stream, size, budget)
                indexed = read_index(stream, summary, budget) if is_url(path) and summary is not None else None
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
        self.connections, self.counts = salvaged.connections, salvaged.counts
        self.notes = _notes(scan)
        self.damage, self.unchecked = salvaged.damage, salvaged.unchecked
        others = sum(record.name not in (NOTES, "rosbag2") for record in scan.metadata)
        kinds = {
            "attachment": scan.attachments,
            "metadata record": others,
            "record of a private kind": scan.private_records,
        }
        self.others = Counter({kind: count for kind, count in kinds.items() if count})
        used = set(self.counts)
        self._blocks = sorted((block for block in salvaged.blocks if block.holds(used)), key=lambda block: block.start)
        self.start = min((block.start for block in self._blocks), default=0)
        self.end = max((block.end for block in self._blocks), default=0)
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


def _notes(scan: ScanResult) -> dict[str, str]:
    entries = (record.metadata for record in scan.metadata if record.name == NOTES)
    found = (verified_notes(each, data_verified=scan.data_crc_matches) for each in entries)
    return next((notes for notes in found if notes is not None), {})


@dataclass(frozen=True)
class Salvage:
    """The data of a file that is used.

    Attributes:
        blocks: blocks to read, in the order of the file.
        connections: by channel, as far as their definition is certain.
        counts: messages to read, by channel.
        damage: what is corrupt and lost; None if nothing is.
        unchecked: why damage may not have been noticed; else empty.
    """

    blocks: list[Block]
    connections: dict[int, Connection]
    counts: dict[int, int]
    damage: DamageReport | None = None
    unchecked: str = ""


def salvage(
    name: str, size: int, scan: ScanResult, summary: McapSummary | None, count_messages: Callable[[Block], Counter[int]]
) -> Salvage:
    """Return the data of a file that is used.

    Args:
        name: of the file.
        size: its length in bytes.
        scan: what the scan found.
        summary: the summary, if the file has one.
        count_messages: returns the number of messages of each channel in a block.
    """
    trusted = summary if summary is not None and summary.trusted else None
    blocks, spare, missing = _match_chunks(scan, trusted)
    counts, unchecked = Counter(scan.counts), Counter(scan.unchecked_counts)
    for block in spare:
        own = count_messages(block)
        counts.subtract(own)
        if not block.has_checksum:
            unchecked.subtract(own)
    regions = _corrupt_regions(name, size, scan, summary, blocks, missing)
    regions += [_region(name, [block], "an unindexed chunk, or a second copy of a chunk") for block in spare]
    complete = not scan.corrupt and not scan.private_records and scan.ended
    if summary is not None and not regions and (problem := _contradiction(summary, blocks, counts)):
        regions.append(CorruptRegion(name, summary.start, summary.end, problem))
        complete = False
    if scan.data_crc and not scan.data_crc_matches and not regions:
        regions.append(CorruptRegion(name, 0, scan.stopped, "data other than messages does not match its checksum"))
    known = counts.total()
    verified = scan.data_crc_matches or not regions
    if not verified and (loose := [block for block in blocks if not block.has_checksum]):
        blocks = [block for block in blocks if block.has_checksum]
        counts -= unchecked
        what = f"{pluralize(known - counts.total(), 'message')} without a checksum, which may be wrong"
        regions.append(_region(name, loose, what))
    connections = _known_channels(scan, trusted, verified)
    undefined = set(+counts) - set(connections)
    first_blocks = {
        channel: block
        for block in reversed(blocks if undefined else [])
        for channel in undefined.intersection(block.channel_numbers())
    }
    for channel, block in sorted(first_blocks.items()):
        lost_messages = pluralize(counts.pop(channel), "message")
        what = f"{lost_messages} of a channel without a definition, or with conflicting ones"
        regions.append(_region(name, [block], what))
    damage = None
    if regions:
        used = counts.total()
        lost = known - used if complete or scan.data_crc_matches else None
        if trusted is not None and trusted.statistics is not None:
            lost = max(0, trusted.statistics.message_count - used)
        if lost == 0:
            regions = [replace(region, first=None, last=None) for region in regions]
        corrupt_bytes = sum(region.end - region.start for region in scan.corrupt)
        chunks = len(missing) if trusted is not None and trusted.chunks else scan.chunks_lost
        ordered = tuple(sorted(regions, key=lambda region: region.start))
        damage = DamageReport(ordered, chunks, corrupt_bytes, lost)
    doubt = ""
    if not scan.data_crc_matches and not all(block.has_checksum for block in blocks):
        doubt = PARTLY_UNCHECKED if any(block.has_checksum for block in blocks) else UNCHECKED
    counts = Counter({channel: counts[channel] for channel in connections if counts[channel]})
    return Salvage(blocks, connections, counts, damage, doubt)


def _region(name: str, blocks: list[Block], what: str) -> CorruptRegion:
    """Return the region from the first of some blocks to the last."""
    return CorruptRegion(name, blocks[0].offset, blocks[-1].offset + blocks[-1].length, what)


def _match_chunks(scan: ScanResult, trusted: McapSummary | None) -> tuple[list[Block], list[Block], list[Block]]:
    """Return the blocks that belong to a file, those that do not, and the chunks of its index that are missing.

    A chunk is known by its lengths and times, wherever it is. Without an index, one that is present twice counts once:
    a recorder does not write the same messages with the same times again, but a copy of a part of a file does.
    """
    if (trusted is None or not trusted.chunks) and scan.data_crc_matches:
        return scan.blocks, [], []
    index = trusted.chunks if trusted is not None else []
    expected = Counter(_identity(block) for block in index)
    seen: set[tuple[int | None, ...]] = set()
    own, spare = list[Block](), list[Block]()
    for block in scan.blocks:
        key = _identity(block)
        belongs = expected[key] > 0 if index else (block.crc, *key) not in seen
        (own if belongs or not block.is_chunk else spare).append(block)
        if block.is_chunk:
            expected[key] -= 1
            seen.add((block.crc, *key))
    missing = []
    for block in index:
        if expected[_identity(block)] > 0:
            expected[_identity(block)] -= 1
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
    if statistics.message_count != counts.total():
        return f"its summary claims {pluralize(statistics.message_count, 'message')}, it holds {counts.total()}"
    claimed = {channel: count for channel, count in statistics.channel_message_counts.items() if count}
    if claimed and claimed != +counts:
        return "its summary claims other counts of messages than it holds"
    filled = [block for block in blocks if block.channels]
    times = (min((b.start for b in filled), default=0), max((b.end for b in filled), default=0))
    if filled and (statistics.message_start_time, statistics.message_end_time) != times:
        return "its summary claims other times than its messages have"
    return ""


def _known_channels(scan: ScanResult, trusted: McapSummary | None, verified: bool) -> dict[int, Connection]:
    """Return the channels that are defined by data with a correct checksum."""
    table = ChannelTable()
    table.update(scan.checked_channels)
    if verified:
        table.update(scan.unchecked_channels)
    if trusted is not None:
        table.update(trusted.channels)
    return table.connections()


def read_index(stream: BinaryIO, summary: McapSummary, budget: UnpackBudget) -> tuple[ScanResult, Salvage] | None:
    """Return what a file holds by its summary, as a scan would; None where that cannot be told, so that it needs one.

    It can be told where the summary has a correct checksum and counts of all channels, and covers the file: between the
    chunks, metadata and attachments that it lists there is nothing but definitions that it repeats. The first chunk
    must have a checksum; of one writer all chunks have one, or none.

    Args:
        stream: the file.
        summary: of the file.
        budget: of the bag.

    Raises:
        BudgetError: it holds more records than a file of its size may.
    """
    chunks, statistics = summary.chunks, summary.statistics
    if not (summary.trusted and chunks and all(0 <= block.length <= MAX_BLOCK_BYTES for block in chunks)):
        return None
    if statistics is None or statistics.chunk_count != len(chunks):
        return None
    connections = summary.channels.connections()
    counts = {number: count for number, count in statistics.channel_message_counts.items() if count}
    if sum(counts.values()) != statistics.message_count or not counts.keys() <= connections.keys():
        return None
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC or not has_chunk_checksum(stream, chunks[0].offset):
        return None
    scan = ScanResult(blocks=chunks, ended=True, attachments=statistics.attachment_count)
    try:
        if not _is_covered(stream, summary, budget):
            return None
        for offset, length in summary.metadata:
            stream.seek(offset + RECORD_HEADER.size)
            length = min(length - RECORD_HEADER.size, MAX_RECORD_BYTES + 1)
            scan.metadata.append(parse_record(Opcode.METADATA, stream.read(length)))
            budget.keep(length, len(scan.metadata[-1].metadata))
    except CorruptRecordError:
        return None
    return scan, Salvage(chunks, connections, counts)


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
