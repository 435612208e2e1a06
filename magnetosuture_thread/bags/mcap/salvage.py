"""Decides which data of an mcap file is used, and reports what is corrupt and lost.

Data that may be wrong is never used. A chunk with a correct checksum is used. Data without a checksum (messages outside
of chunks, chunks of writers that write none, and the channels defined there) is used only where the checksum of the
data section is correct, or where the file shows no damage at all: every record parses, and it has an end and a summary
that agrees with the messages. In a file with any other damage it is not used.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from magnetosuture_thread.bags.bag_folder import NOTES, verified_notes
from magnetosuture_thread.bags.mcap.records import RECORD_HEADER
from magnetosuture_thread.bags.mcap.scan import Block, ScanResult
from magnetosuture_thread.bags.mcap.summary import ChannelTable, IndexedChunk, McapSummary
from magnetosuture_thread.bags.storage import Connection, CorruptRegion, DamageReport, pluralize

UNCHECKED = "has no checksums: damage to it cannot be noticed"
PARTLY_UNCHECKED = "has messages without a checksum: damage to them cannot be noticed"


@dataclass(frozen=True)
class Salvage:
    """The data of a file that is used.

    Attributes:
        blocks: blocks to read, in the order of the file.
        connections: by channel, as far as their definition is certain.
        counts: messages to read, by channel.
        notes: notes of our writer.
        damage: what is corrupt and lost; None if nothing is.
        unchecked: why damage may not have been noticed; else empty.
    """

    blocks: list[Block]
    connections: dict[int, Connection]
    counts: dict[int, int]
    notes: dict[str, str]
    damage: DamageReport | None
    unchecked: str


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
    match = _match_index(scan, trusted)
    blocks, counts, unchecked = match.blocks, Counter(scan.counts), Counter(scan.unchecked_counts)
    for block in match.unindexed:
        unindexed = count_messages(block)
        counts.subtract(unindexed)
        if not block.has_checksum:
            unchecked.subtract(unindexed)
    trailing = []
    if summary is not None and summary.trailing_bytes:
        trailing = [CorruptRegion(name, size - summary.trailing_bytes, size, "bytes after its end")]
    regions = _corrupt_regions(name, scan, match)
    if summary is None:
        regions = _truncated(name, size, scan, regions)
    else:
        regions += trailing + _corrupt_end(name, scan, summary)
    regions += [CorruptRegion(name, b.offset, b.offset + b.length, match.unindexed_reason) for b in match.unindexed]
    complete = not scan.corrupt and not scan.private_records and scan.ended
    if summary is not None and not regions and (problem := _contradiction(summary, blocks, counts)):
        regions.append(CorruptRegion(name, summary.start, summary.end, problem))
        complete = False
    if scan.data_crc and not scan.data_crc_matches and not regions:
        regions.append(CorruptRegion(name, 0, scan.stopped, "data other than messages does not match its checksum"))
    known = sum(counts.values())
    verified = scan.data_crc_matches or not regions
    if not verified and (loose := [block for block in blocks if not block.has_checksum]):
        blocks = [block for block in blocks if block.has_checksum]
        counts -= unchecked
        what = f"{pluralize(known - sum(counts.values()), 'message')} without a checksum, which may be wrong"
        regions.append(CorruptRegion(name, loose[0].offset, loose[-1].offset + loose[-1].length, what))
    connections = _merge_channels(scan, trusted, verified).connections()
    undefined = set(+counts) - set(connections)
    first_blocks = {
        channel: block
        for block in reversed(blocks if undefined else [])
        for channel in undefined.intersection(block.channel_numbers())
    }
    for channel, block in sorted(first_blocks.items()):
        what = (
            f"{pluralize(counts.pop(channel), 'message')} of a channel without a definition, or with conflicting ones"
        )
        regions.append(CorruptRegion(name, block.offset, block.offset + block.length, what))
    damage = None
    if regions:
        used = sum(counts.values())
        lost = known - used if complete or scan.data_crc_matches else None
        if trusted is not None and trusted.statistics is not None:
            lost = max(0, trusted.statistics.message_count - used)
        if lost == 0:
            regions = [replace(region, first=None, last=None) for region in regions]
        corrupt_bytes = sum(region.end - region.start for region in (*scan.corrupt, *trailing))
        chunks = len(match.missing) if match.has_index else scan.chunks_lost
        ordered = tuple(sorted(regions, key=lambda region: region.start))
        damage = DamageReport(ordered, chunks, corrupt_bytes, lost)
    return Salvage(
        blocks=blocks,
        connections=connections,
        counts={channel: counts[channel] for channel in connections if counts[channel]},
        notes=_notes(scan),
        damage=damage,
        unchecked=_unchecked(scan, blocks),
    )


@dataclass(frozen=True)
class _IndexMatch:
    """Blocks of a file, matched with the chunk index of its summary.

    Attributes:
        blocks: blocks that belong to the file, in its order.
        unindexed: blocks that do not.
        unindexed_reason: why, for a person.
        missing: indexed chunks that the scan did not find.
        has_index: whether there is an index to match with.
        in_place: whether the index has the offsets of the missing chunks.
    """

    blocks: list[Block]
    unindexed: list[Block]
    unindexed_reason: str
    missing: list[IndexedChunk]
    has_index: bool
    in_place: bool


def _match_index(scan: ScanResult, trusted: McapSummary | None) -> _IndexMatch:
    """Match what the scan found with the chunk index of a trusted summary.

    Without an index, a chunk that is present twice counts once: a recorder does not write the same messages with the
    same times again, but a copy of a part of a file does.
    """
    if trusted is not None and trusted.chunks:
        return _match_chunks(scan.blocks, trusted)
    if scan.data_crc_matches:
        return _IndexMatch(scan.blocks, [], "", [], has_index=False, in_place=False)
    seen: set[tuple[int | None, int, int, int]] = set()
    unique, copies = list[Block](), list[Block]()
    for block in scan.blocks:
        key = (block.crc, block.size, block.start, block.end)
        (copies if block.is_chunk and key in seen else unique).append(block)
        seen.add(key)
    return _IndexMatch(unique, copies, "a second copy of a chunk", [], has_index=False, in_place=False)


def _match_chunks(blocks: list[Block], trusted: McapSummary) -> _IndexMatch:
    """Match by offset first, then, for chunks that were moved, by lengths and times."""
    offsets = {} if trusted.shifted else {chunk.offset: chunk for chunk in trusted.chunks}
    expected = Counter(chunk.content for chunk in trusted.chunks)
    indexed: set[int] = set()
    for number, block in enumerate(blocks):
        chunk = offsets.get(block.offset - RECORD_HEADER.size)
        if not block.is_chunk:
            indexed.add(number)
        elif chunk is not None and chunk.length == block.length + RECORD_HEADER.size:
            expected[chunk.content] -= 1
            indexed.add(number)
    for number, block in enumerate(blocks):
        key = (block.length + RECORD_HEADER.size, block.size, block.start, block.end)
        if number not in indexed and expected[key] > 0:
            expected[key] -= 1
            indexed.add(number)
    missing = []
    for chunk in trusted.chunks:
        if expected[chunk.content] > 0:
            expected[chunk.content] -= 1
            missing.append(chunk)
    return _IndexMatch(
        [block for number, block in enumerate(blocks) if number in indexed],
        [block for number, block in enumerate(blocks) if number not in indexed],
        "an unindexed chunk, or a second copy of a chunk",
        missing,
        has_index=True,
        in_place=not trusted.shifted,
    )


def _corrupt_regions(name: str, scan: ScanResult, match: _IndexMatch) -> list[CorruptRegion]:
    """Return the corrupt regions, with the times between which messages are missing."""
    regions = list(scan.corrupt)
    missing = sorted(match.missing, key=_offset)
    for index, region in enumerate(regions):
        first, last = (bisect_left(missing, end, key=_offset) for end in (region.start, region.end))
        if match.in_place and first < last:
            inside = missing[first:last]
            del missing[first:last]
            start = min(chunk.start for chunk in inside)
            regions[index] = replace(region, first=start, last=max(chunk.end for chunk in inside))
        else:
            following = bisect_left(match.blocks, region.end, key=_offset)
            after = match.blocks[following].start if following < len(match.blocks) else None
            regions[index] = replace(region, last=after)
    if not match.in_place and regions:
        return regions  # the chunks are missing there; in which region is unknown
    return regions + [
        CorruptRegion(name, chunk.offset, chunk.offset + chunk.length, "a chunk is missing", chunk.start, chunk.end)
        for chunk in missing
    ]


def _offset(part: Block | IndexedChunk) -> int:
    return part.offset


def _truncated(name: str, size: int, scan: ScanResult, regions: list[CorruptRegion]) -> list[CorruptRegion]:
    """Return the corrupt regions of a file without a summary, its missing end included."""
    if scan.ended:
        return [*regions, CorruptRegion(name, scan.stopped, size, "its summary is missing or corrupt")]
    if regions and regions[-1].end == size:
        return [*regions[:-1], replace(regions[-1], what="it is truncated or corrupt from here to its end")]
    last = scan.blocks[-1].end if scan.blocks else None
    return [*regions, CorruptRegion(name, size, size, "it is truncated", last)]


def _corrupt_end(name: str, scan: ScanResult, summary: McapSummary) -> list[CorruptRegion]:
    """Return what is wrong between the data and the summary."""
    if scan.corrupt:
        return []
    regions = []
    if not scan.ended:
        regions.append(CorruptRegion(name, scan.stopped, scan.stopped, "the end of its data is missing"))
    if summary.shifted:
        regions.append(CorruptRegion(name, 0, scan.stopped, "bytes were removed from it, or inserted"))
    return regions


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


def _merge_channels(scan: ScanResult, trusted: McapSummary | None, verified: bool) -> ChannelTable:
    """Return the channels that are defined by data with a correct checksum."""
    table = ChannelTable()
    table.update(scan.checked_channels)
    if verified:
        table.update(scan.unchecked_channels)
    if trusted is not None:
        table.update(trusted.channels)
    return table


def _notes(scan: ScanResult) -> dict[str, str]:
    for record in scan.metadata:
        if record.name == NOTES:
            notes = verified_notes(record.metadata, data_verified=scan.data_crc_matches)
            if notes is not None:
                return notes
    return {}


def _unchecked(scan: ScanResult, blocks: list[Block]) -> str:
    if scan.data_crc_matches or all(block.has_checksum for block in blocks):
        return ""
    return PARTLY_UNCHECKED if any(block.has_checksum for block in blocks) else UNCHECKED
