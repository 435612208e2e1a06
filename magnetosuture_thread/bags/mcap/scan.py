"""Scans an mcap file record by record, verifies every checksum, and finds what is intact.

Where a record or chunk is corrupt, the scan continues at the next intact data: at an offset from the chunk index, if
the checksum of the summary is correct, else where the next chunk with a correct checksum begins.
"""

from __future__ import annotations

import zlib
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Metadata

from magnetosuture_thread.bags.mcap.records import (
    MAGIC,
    MESSAGE_HEADER,
    MIN_PRIVATE_OPCODE,
    RECORD_HEADER,
    Block,
    ChannelTable,
    CorruptRecordError,
    McapSummary,
    decompress_chunk,
    find_chunk,
    is_intact_chunk,
    is_opcode,
    iterate_records,
    parse_record,
)
from magnetosuture_thread.bags.storage import CorruptRegion
from magnetosuture_thread.untrusted import LONE_RECORD, MAX_BLOCK_BYTES, UnpackBudget

_SKIP_BYTES = 1 << 20  # read at a time where a record is skipped
_EMPTY_INDEX = 6  # bytes of a message index without entries: channel and length
_RUN_BYTES = 1 << 20  # of messages outside of chunks in one block


@dataclass
class ScanResult:
    """What a scan of a file found.

    Attributes:
        blocks: in the order of the file.
        counts: messages by channel, in all blocks.
        unchecked_counts: those of them in blocks without a checksum.
        checked_channels: channels defined in blocks with a checksum.
        unchecked_channels: channels defined elsewhere.
        metadata: metadata records.
        compressions: of the chunks.
        attachments: number of attachment records.
        corrupt: regions that could not be read.
        chunks_lost: number of chunks among them, as far as it can be seen.
        ended: whether the data end record was reached.
        stopped: where the scan ended.
        data_crc: checksum of the data section as stored; 0 if there is none.
        data_crc_matches: whether it is correct.
        private_records: number of records of private opcodes.
    """

    blocks: list[Block] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    unchecked_counts: Counter[int] = field(default_factory=Counter)
    checked_channels: ChannelTable = field(default_factory=ChannelTable)
    unchecked_channels: ChannelTable = field(default_factory=ChannelTable)
    metadata: list[Metadata] = field(default_factory=list)
    compressions: set[str] = field(default_factory=set)
    attachments: int = 0
    corrupt: list[CorruptRegion] = field(default_factory=list)
    chunks_lost: int = 0
    ended: bool = False
    stopped: int = 0
    data_crc: int = 0
    data_crc_matches: bool = False
    private_records: int = 0


class Scanner:
    """Scans the data section of an mcap file.

    Args:
        path: the file.
        stream: the file, open.
        size: its length.
        summary: its summary, if it has one.
        budget: of the bag.
        progress: called with the number of bytes scanned since the last call.

    Attributes:
        result: what was found.
    """

    def __init__(
        self,
        path: Path,
        stream: BinaryIO,
        size: int,
        summary: McapSummary | None,
        budget: UnpackBudget,
        progress: Callable[[int], None],
    ) -> None:
        self.result = ScanResult()
        self._name = path.name
        self._stream = stream
        self._limit = summary.start if summary is not None else size
        self._budget = budget
        self._progress = progress
        self._crc = 0
        self._channel_sets: dict[bytes, bytes] = {}
        self._definitions: set[bytes] = set()  # hashes of those that were added
        self._offsets: list[int] = []  # of records, by the summary
        if summary is not None and summary.trusted:
            offsets = [chunk.offset - RECORD_HEADER.size for chunk in summary.chunks]
            offsets += [offset for offset, _ in summary.metadata]
            self._offsets = sorted([*offsets, summary.start - RECORD_HEADER.size - 4])

    def scan(self) -> ScanResult:
        """Scan the file and return what was found.

        Raises:
            BudgetError: it unpacks to more, or holds more records, than a file of its size may.
        """
        magic = self._read(0, len(MAGIC))
        self._crc = zlib.crc32(magic)
        position = len(MAGIC)
        if magic != MAGIC:
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
        if opcode in (Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX) or opcode >= MIN_PRIVATE_OPCODE:
            return self._skip(position, opcode, length)
        if length > MAX_BLOCK_BYTES:
            raise CorruptRecordError(f"a record of {length} bytes, more than {MAX_BLOCK_BYTES}")
        before = self._crc
        head, body = self._read(position, RECORD_HEADER.size), self._read(start, length)
        self._crc = zlib.crc32(body, zlib.crc32(head, before))
        if opcode == Opcode.CHUNK:
            self._scan_chunk(start, length, body)
            return after
        record = parse_record(opcode, body)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._add_definition(opcode, body, checked=False)
        elif opcode == Opcode.METADATA:
            self._budget.keep(length, len(record.metadata))
            self.result.metadata.append(record)
        elif opcode == Opcode.DATA_END:
            self.result.ended = True
            self.result.data_crc = record.data_section_crc
            self.result.data_crc_matches = bool(record.data_section_crc) and record.data_section_crc == before
        return after

    def _read_header(self, position: int) -> tuple[int, int]:
        """Return opcode and length of the record at a position, if one can be there."""
        head = self._read(position, RECORD_HEADER.size)
        if len(head) < RECORD_HEADER.size:
            raise CorruptRecordError("the end is missing")
        opcode, length = RECORD_HEADER.unpack(head)
        if not is_opcode(opcode):
            raise CorruptRecordError("no record where one is expected")
        if position + RECORD_HEADER.size + length > self._limit:
            raise CorruptRecordError("a record longer than the rest of the data")
        return opcode, length

    def _skip(self, position: int, opcode: int, length: int) -> int:
        """Skip a record whose content is not needed; it has to end where another record can begin."""
        start = position + RECORD_HEADER.size
        if opcode == Opcode.MESSAGE_INDEX:
            # Its content is redundant, but the opcode of a chunk may have been corrupted to this one.
            entries = int.from_bytes(self._read(start + 2, 4), "little")
            if entries + _EMPTY_INDEX != length or entries % 16:
                raise CorruptRecordError("a corrupt message index")
        if start + length < self._limit:
            self._read_header(start + length)
        self.result.private_records += opcode >= MIN_PRIVATE_OPCODE
        self._crc = zlib.crc32(self._read(position, RECORD_HEADER.size), self._crc)
        for at in range(start, start + length, _SKIP_BYTES):
            self._crc = zlib.crc32(self._read(at, min(_SKIP_BYTES, start + length - at)), self._crc)
        self.result.attachments += opcode == Opcode.ATTACHMENT
        return start + length

    def _scan_chunk(self, start: int, length: int, body: bytes) -> None:
        """Add a chunk that is intact."""
        content = decompress_chunk(body, self._budget)
        self._add_block(content.data, Block(start, length, True, content.has_checksum, content.crc, 0, 0, 0, b""))
        self.result.compressions.add(content.compression)

    def _scan_loose_messages(self, position: int) -> int:
        """Add a run of messages outside of chunks."""
        after = position
        while after - position < _RUN_BYTES and after < self._limit:
            try:
                opcode, length = self._read_header(after)
            except CorruptRecordError:
                if after == position:
                    raise
                break  # The run ends here; the next step handles what is corrupt.
            if opcode != Opcode.MESSAGE:
                break
            if not MESSAGE_HEADER.size <= length <= MAX_BLOCK_BYTES:
                if after == position:
                    raise CorruptRecordError("a corrupt message")
                break
            after += RECORD_HEADER.size + length
        data = self._read(position, after - position)
        self._crc = zlib.crc32(data, self._crc)
        self._add_block(data, Block(position, len(data), False, False, zlib.crc32(data), 0, 0, 0, b""))
        return after

    def _add_block(self, data: bytes, block: Block) -> None:
        """Add a block with its channels and counts; nothing of it where a record is corrupt."""
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
            self._add_definition(opcode, data[start:end], checked=block.has_checksum)
        channels = array("H", sorted(counts)).tobytes()
        channels = self._channel_sets.setdefault(channels, channels)
        self.result.blocks.append(block._replace(size=len(data), start=first, end=last, channels=channels))
        self.result.counts.update(counts)
        if not block.has_checksum:
            self.result.unchecked_counts.update(counts)

    def _add_definition(self, opcode: int, body: bytes, *, checked: bool) -> None:
        """Add a channel or schema; our own writer repeats them in every chunk."""
        key = blake2b(bytes([opcode, checked]) + body, digest_size=16).digest()
        if key not in self._definitions:
            record = parse_record(opcode, body)
            self._budget.keep(len(body), len(getattr(record, "metadata", ())))
            table = self.result.checked_channels if checked else self.result.unchecked_channels
            table.add(record)
            self._definitions.add(key)

    def _skip_corrupt(self, position: int, what: str) -> int:
        """Add a corrupt region, and return where the next intact data begins."""
        after = self._find_intact(position)
        is_chunk = self._read(position, 1) == bytes([Opcode.CHUNK])
        self.result.chunks_lost += is_chunk
        first = self.result.blocks[-1].end if self.result.blocks else None
        self.result.corrupt.append(CorruptRegion(self._name, position, after, what, first))
        return after

    def _find_intact(self, position: int) -> int:
        """Return where the next intact data begins: a chunk, the record after this one, or the end."""
        after = self._limit
        try:
            _, length = self._read_header(position)
            following = position + RECORD_HEADER.size + length
            if following < self._limit:
                self._read_header(following)
            after = following
        except CorruptRecordError:
            pass
        for offset in self._offsets[bisect_right(self._offsets, position) :]:
            if offset >= after or self._is_intact_record(offset):
                after = min(after, offset)
                break
        # Even then: a corrupt record header may skip chunks that are intact.
        found = find_chunk(self._stream, position + 1, self._limit, after, self._budget)
        return after if found is None else found

    def _is_intact_record(self, position: int) -> bool:
        """Return whether a record begins at an offset from the summary."""
        try:
            opcode, length = self._read_header(position)
            if opcode == Opcode.CHUNK:
                return is_intact_chunk(self._stream, position, self._limit, self._budget)
            parse_record(opcode, self._read(position + RECORD_HEADER.size, length))
        except CorruptRecordError:
            return False
        return opcode in (Opcode.METADATA, Opcode.DATA_END)

    def _read(self, position: int, length: int) -> bytes:
        self._stream.seek(position)
        return self._stream.read(length)
