"""What an mcap file holds by the index at its end: none of its chunks is read for that.

A file that a URL names is far away: a few ranges of it tell what is in it, and only the chunks that somebody asks for
are fetched. The checksum of each is verified then, in place of all when the file is opened.
"""

from __future__ import annotations

from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Metadata

from magnetosuture_thread.bags.bag_folder import NOTES, verified_notes
from magnetosuture_thread.bags.mcap.records import (
    MAGIC,
    RECORD_HEADER,
    CorruptRecordError,
    has_chunk_checksum,
    parse_record,
)
from magnetosuture_thread.bags.mcap.salvage import Salvage
from magnetosuture_thread.bags.mcap.scan import Block, ScanResult
from magnetosuture_thread.bags.mcap.summary import IndexedChunk, McapSummary
from magnetosuture_thread.untrusted import LONE_RECORD, MAX_RECORD_BYTES, UnpackBudget


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
