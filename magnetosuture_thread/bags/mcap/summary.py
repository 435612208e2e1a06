"""Reads the summary at the end of an mcap file: its channels, chunk index and statistics.

It has a checksum of its own, so it can be trusted where the rest of the file is corrupt, and lists what is missing.
"""

from __future__ import annotations

import re
import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, MetadataIndex, Schema, Statistics

from magnetosuture_thread.bags.mcap.records import (
    MAGIC,
    RECORD_HEADER,
    CorruptRecordError,
    iterate_records,
    parse_record,
)
from magnetosuture_thread.bags.storage import Connection, MessageDefinition
from magnetosuture_thread.untrusted import LONE_RECORD, MAX_BLOCK_BYTES, UnpackBudget


@dataclass
class ChannelTable:
    """Channels and schemas as they are defined in some part of a file.

    Attributes:
        schemas: definitions by schema id; two or more conflict.
        channels: definitions by channel id; two or more conflict.
    """

    schemas: dict[int, list[Schema]] = field(default_factory=dict)
    channels: dict[int, list[Channel]] = field(default_factory=dict)

    def add(self, record: Schema | Channel) -> None:
        """Add a definition unless the same one is known."""
        table: dict[int, list[Any]] = self.schemas if isinstance(record, Schema) else self.channels
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


_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = RECORD_HEADER.size + _FOOTER.size + len(MAGIC)  # bytes from the footer to the file's end
_TAIL_BYTES = 1 << 24  # at the end, searched for a displaced summary
_FOOTER_PATTERN = re.compile(rb"\x02\x14\0{7}.{20}" + re.escape(MAGIC), re.DOTALL)
_DATA_END_PATTERN = re.compile(rb"\x0f\x04\0{7}", re.DOTALL)
_DATA_END_BYTES = RECORD_HEADER.size + 4


class IndexedChunk(NamedTuple):
    """An entry of the chunk index; a file may have a hundred thousand of them.

    Attributes:
        offset: where its record begins.
        length: bytes of its record.
        size: bytes of the records in it.
        start: time of its first message [ns].
        end: time of its last message [ns].
        channels: with messages in it, 2 bytes each.
        index_length: bytes of the message indexes after it.
    """

    offset: int
    length: int
    size: int
    start: int
    end: int
    channels: bytes
    index_length: int

    @property
    def content(self) -> tuple[int, int, int, int]:
        """Return what identifies the chunk wherever it is: length, size and times."""
        return self.length, self.size, self.start, self.end


@dataclass
class McapSummary:
    """The content of a summary section.

    Attributes:
        start: where it begins in the file; the data ends there, its last record included.
        end: where its footer begins.
        trusted: whether it has a checksum that is correct.
        shifted: whether it is not at the offset in its footer, so that its offsets are useless.
        trailing_bytes: number of bytes after the end of the mcap file.
        channels: channels and their schemas.
        chunks: the chunk index.
        metadata: index of the metadata records.
        attachments: offset and length of the attachment records.
        statistics: counts and times of all messages, if present.
    """

    start: int
    end: int
    trusted: bool
    shifted: bool = False
    trailing_bytes: int = 0
    channels: ChannelTable = field(default_factory=ChannelTable)
    chunks: list[IndexedChunk] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    attachments: list[tuple[int, int]] = field(default_factory=list)
    statistics: Statistics | None = None


def read_summary(stream: BinaryIO, size: int, budget: UnpackBudget) -> McapSummary | None:
    """Return the summary of a file; None where there is none with a correct checksum.

    One without a checksum is accepted if it is at the offset in the footer and consists of valid records.

    Args:
        stream: the file.
        size: its length.
        budget: of the bag: what looks like a footer may be there a thousand times.

    Raises:
        BudgetError: there is too much to search, or too much in it.
    """
    begin = max(0, size - _TAIL_BYTES)
    stream.seek(max(begin, size - _FOOTER_BYTES))
    end = stream.read()
    if _FOOTER_PATTERN.fullmatch(end):
        start = _FOOTER.unpack_from(end, RECORD_HEADER.size)[0] or size - _FOOTER_BYTES
        if max(len(MAGIC), size - MAX_BLOCK_BYTES) <= start <= size - _FOOTER_BYTES:
            stream.seek(start)
            found = _parse_summary(stream.read(size - len(MAGIC) - start), start, budget, shifted=False)
            if found is not None:
                return found
    # Not there: bytes before it were removed or inserted, or bytes follow it.
    stream.seek(begin)
    tail = stream.read()
    for footer in reversed(list(_FOOTER_PATTERN.finditer(tail))):
        stop = footer.end() - len(MAGIC)
        claimed = _FOOTER.unpack_from(tail, footer.start() + RECORD_HEADER.size)[0] or begin + footer.start()
        for start in _candidate_starts(tail, begin, footer.start(), claimed):
            found = _parse_summary(tail[start - begin : stop], start, budget, shifted=start != claimed)
            if found is not None and found.trusted:
                found.trailing_bytes = size - begin - footer.end()
                return found
    return None


def _candidate_starts(tail: bytes, begin: int, footer: int, claimed: int) -> Iterator[int]:
    """Yield where a summary may begin: at the offset in its footer, or after what looks like a data end record."""
    if begin <= claimed <= begin + footer:
        yield claimed
    ends = [match.start() + _DATA_END_BYTES for match in _DATA_END_PATTERN.finditer(tail, 0, footer)]
    yield from (begin + end for end in reversed(ends[-16:]) if end <= footer)


def _parse_summary(data: bytes, start: int, budget: UnpackBudget, *, shifted: bool) -> McapSummary | None:
    """Return a summary, parsed together with its footer; None if it is invalid."""
    budget.spend(len(data), LONE_RECORD)
    crc = _FOOTER.unpack_from(data, len(data) - _FOOTER.size)[2]
    if crc and zlib.crc32(data[:-4]) != crc:
        return None
    summary = McapSummary(start, start + len(data) - RECORD_HEADER.size - _FOOTER.size, bool(crc), shifted)
    channel_sets: dict[bytes, bytes] = {}
    try:
        for opcode, first, last in iterate_records(data):
            budget.spend(0, 1)
            record = parse_record(opcode, data[first:last])
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                budget.keep(last - first, len(getattr(record, "metadata", ())))
                summary.channels.add(record)
            elif opcode == Opcode.CHUNK_INDEX:
                channels = array("H", sorted(record.message_index_offsets)).tobytes()
                summary.chunks.append(
                    IndexedChunk(
                        record.chunk_start_offset,
                        record.chunk_length,
                        record.uncompressed_size,
                        record.message_start_time,
                        record.message_end_time,
                        channel_sets.setdefault(channels, channels),
                        record.message_index_length,
                    )
                )
            elif opcode == Opcode.ATTACHMENT_INDEX:
                summary.attachments.append((record.offset, record.length))
            elif opcode == Opcode.METADATA_INDEX:
                summary.metadata.append(record)
            elif opcode == Opcode.STATISTICS:
                summary.statistics = record
    except CorruptRecordError:
        return None
    return summary
