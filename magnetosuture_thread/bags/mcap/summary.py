"""The summary at an mcap file's end: what the file holds, and where.

It has a checksum of its own, so it can be trusted where the rest is broken: it knows what is missing.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, MetadataIndex, Schema, Statistics

from magnetosuture_thread.bags.mcap.layout import HEAD, MAGIC, BrokenError, parse, records_in

_FOOTER = struct.Struct("<QQI")
_END = HEAD.size + _FOOTER.size + len(MAGIC)  # bytes from the footer to the file's end
_TAIL = 1 << 24  # bytes at the end in which a summary is looked for that is not where it should be
_FOOTERS = re.compile(rb"\x02\x14\0{7}.{20}" + re.escape(MAGIC), re.DOTALL)
_DATA_ENDS = re.compile(rb"\x0f\x04\0{7}", re.DOTALL)
_DATA_END = HEAD.size + 4


class ListedChunk(NamedTuple):
    """A chunk as the summary lists it; there may be a hundred thousand of them.

    Attributes:
        offset: where its record begins.
        length: bytes of its record.
        size: bytes of the records in it.
        start: time of its first message [ns].
        end: time of its last message [ns].
    """

    offset: int
    length: int
    size: int
    start: int
    end: int


@dataclass
class Summary:
    """What a summary says.

    Attributes:
        start: where it begins in the file; where the data ends, its last record included.
        end: where its footer begins.
        trusted: whether it has a checksum, and that is right.
        shifted: whether it is not where its footer says, so that its offsets are of no use.
        followed: number of bytes after the file's end that do not belong to it.
    """

    start: int
    end: int
    trusted: bool
    shifted: bool = False
    followed: int = 0
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ListedChunk] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    statistics: Statistics | None = None


def read_summary(stream: BinaryIO, size: int) -> Summary | None:
    """Return the summary of a file; None where there is none that is what its checksum says.

    One without a checksum is taken if it is where the footer says and is made of records.

    Args:
        stream: the file.
        size: its length.
    """
    begin = max(0, size - _TAIL)
    stream.seek(max(begin, size - _END))
    end = stream.read()
    if _FOOTERS.fullmatch(end):
        start = _FOOTER.unpack_from(end, HEAD.size)[0] or size - _END
        if len(MAGIC) <= start <= size - _END:
            stream.seek(start)
            found = _summary(stream.read(size - len(MAGIC) - start), start, shifted=False)
            if found is not None:
                return found
    # Not there: something before it was taken away or put in, or something follows.
    stream.seek(begin)
    tail = stream.read()
    for footer in reversed(list(_FOOTERS.finditer(tail))):
        stop = footer.end() - len(MAGIC)
        claimed = _FOOTER.unpack_from(tail, footer.start() + HEAD.size)[0] or begin + footer.start()
        for start in _starts(tail, begin, footer.start(), claimed):
            found = _summary(tail[start - begin : stop], start, shifted=start != claimed)
            if found is not None and found.trusted:
                found.followed = size - begin - footer.end()
                return found
    return None


def _starts(tail: bytes, begin: int, footer: int, claimed: int) -> Iterator[int]:
    """Yield where a summary may begin: where its footer says, or after what looks like the data's last record."""
    if begin <= claimed <= begin + footer:
        yield claimed
    ends = [match.start() + _DATA_END for match in _DATA_ENDS.finditer(tail, 0, footer)]
    yield from (begin + end for end in reversed(ends[-16:]) if end <= footer)


def _summary(data: bytes, start: int, *, shifted: bool) -> Summary | None:
    """Return a summary with its footer, taken apart; None if it is none."""
    crc = _FOOTER.unpack_from(data, len(data) - _FOOTER.size)[2]
    if crc and zlib.crc32(data[:-4]) != crc:
        return None
    summary = Summary(start, start + len(data) - HEAD.size - _FOOTER.size, bool(crc), shifted)
    try:
        for opcode, first, last in records_in(data):
            record = parse(opcode, data[first:last])
            if opcode == Opcode.SCHEMA:
                summary.schemas[record.id] = record
            elif opcode == Opcode.CHANNEL:
                summary.channels[record.id] = record
            elif opcode == Opcode.CHUNK_INDEX:
                summary.chunks.append(
                    ListedChunk(
                        record.chunk_start_offset,
                        record.chunk_length,
                        record.uncompressed_size,
                        record.message_start_time,
                        record.message_end_time,
                    )
                )
            elif opcode == Opcode.METADATA_INDEX:
                summary.metadata.append(record)
            elif opcode == Opcode.STATISTICS:
                summary.statistics = record
    except BrokenError:
        return None
    return summary
