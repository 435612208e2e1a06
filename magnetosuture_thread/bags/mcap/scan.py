"""Goes through an mcap file once, record by record, checks every checksum, and finds what is intact.

Where what follows is no record, or a chunk is broken, the walk goes on at the next place that is sound: by the
summary's index of chunks, if the summary's own checksum is right, else where the next chunk with a right
checksum begins.
"""

from __future__ import annotations

import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from magnetosuture_thread.bags.damage import Place
from magnetosuture_thread.bags.mcap.chunk import unpack
from magnetosuture_thread.bags.mcap.index import Findings, Piece
from magnetosuture_thread.bags.mcap.layout import (
    HEAD,
    LARGEST,
    MAGIC,
    MESSAGE,
    PRIVATE,
    BrokenError,
    is_kind,
    parse,
    records_in,
)
from magnetosuture_thread.bags.mcap.search import is_intact, next_chunk
from magnetosuture_thread.bags.mcap.summary import Summary

_BLOCK = 1 << 20  # bytes skipped at a time
_RUN = 1 << 20  # bytes of messages without a chunk that make a piece
_SILENT = frozenset[int]()


class Scan:
    """A walk through the data of an mcap file.

    Args:
        path: the file.
        stream: the file, open.
        size: its length.
        summary: what its summary says, if it has one.
        progress: called with the number of bytes that the walk has come on.

    Attributes:
        found: what was found.
    """

    def __init__(
        self, path: Path, stream: BinaryIO, size: int, summary: Summary | None, progress: Callable[[int], None]
    ) -> None:
        self.found = Findings()
        self._name = path.name
        self._stream = stream
        self._limit = summary.start if summary is not None else size
        self._progress = progress
        self._crc = 0
        self._channel_sets = {_SILENT: _SILENT}
        self._told: set[tuple[int, bytes, bool]] = set()
        self._anchors: list[int] = []  # where the summary says that something begins
        if summary is not None and summary.trusted and not summary.shifted:
            begins = [chunk.offset for chunk in summary.chunks]
            begins += [record.offset for record in summary.metadata]
            self._anchors = sorted([*begins, summary.start - HEAD.size - 4])

    def walk(self) -> Findings:
        """Go through the file and return what was found."""
        magic = self._read(0, len(MAGIC))
        self._crc = zlib.crc32(magic)
        position = len(MAGIC)
        if magic != MAGIC:
            position = self._break(0, "it does not begin as an mcap file")
        while position < self._limit and not self.found.ended:
            before = position
            try:
                position = self._step(position)
            except BrokenError as problem:
                position = self._break(position, str(problem))
            self._progress(position - before)
        self.found.stopped = position
        return self.found

    def _step(self, position: int) -> int:
        """Take the record at a place and return where the next one begins."""
        opcode, length = self._head(position)
        start = position + HEAD.size
        after = start + length
        if opcode == Opcode.MESSAGE:
            return self._loose(position)
        if opcode in (Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX) or opcode >= PRIVATE or length > LARGEST:
            return self._skip(position, opcode, length)
        before = self._crc
        head, body = self._read(position, HEAD.size), self._read(start, length)
        self._crc = zlib.crc32(body, zlib.crc32(head, before))
        if opcode == Opcode.CHUNK:
            self._take_chunk(start, length, body)
            return after
        record = parse(opcode, body)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.found.tell(record, checked=False)
        elif opcode == Opcode.METADATA:
            self.found.metadata.append(record)
        elif opcode == Opcode.DATA_END:
            self.found.ended = True
            self.found.data_crc = record.data_section_crc
            self.found.data_is_right = bool(record.data_section_crc) and record.data_section_crc == before
        return after

    def _head(self, position: int) -> tuple[int, int]:
        """Return kind and length of the record at a place, if one can be there."""
        head = self._read(position, HEAD.size)
        if len(head) < HEAD.size:
            raise BrokenError("its end is missing")
        opcode, length = HEAD.unpack(head)
        if not is_kind(opcode):
            raise BrokenError("no record where one should begin")
        if position + HEAD.size + length > self._limit:
            raise BrokenError("a record that would go on after the end")
        return opcode, length

    def _skip(self, position: int, opcode: int, length: int) -> int:
        """Go past a record whose content is not needed; it has to end where another record can begin."""
        start = position + HEAD.size
        if opcode == Opcode.MESSAGE_INDEX:
            # It tells nothing that the messages do not tell, but a chunk may have become one.
            entries = int.from_bytes(self._read(start + 2, 4), "little")
            if entries + 6 != length or entries % 16:
                raise BrokenError("a broken message index")
        if start + length < self._limit:
            self._head(start + length)
        self.found.private |= opcode >= PRIVATE
        self._crc = zlib.crc32(self._read(position, HEAD.size), self._crc)
        for at in range(start, start + length, _BLOCK):
            self._crc = zlib.crc32(self._read(at, min(_BLOCK, start + length - at)), self._crc)
        return start + length

    def _take_chunk(self, start: int, length: int, body: bytes) -> None:
        """Keep a chunk that is intact."""
        content = unpack(body)
        self._keep(content.data, Piece(start, length, True, content.checked, content.crc, 0, 0, 0, _SILENT))
        self.found.compressions.add(content.compression)

    def _loose(self, position: int) -> int:
        """Keep a run of messages that are in no chunk."""
        after = position
        while after - position < _RUN and after < self._limit:
            try:
                opcode, length = self._head(after)
            except BrokenError:
                if after == position:
                    raise
                break  # The run ends here; what is broken is the next step's.
            if opcode != Opcode.MESSAGE:
                break
            if not MESSAGE.size <= length <= LARGEST:
                raise BrokenError("a broken message")
            after += HEAD.size + length
        data = self._read(position, after - position)
        self._crc = zlib.crc32(data, self._crc)
        self._keep(data, Piece(position, len(data), False, False, zlib.crc32(data), 0, 0, 0, _SILENT))
        return after

    def _keep(self, data: bytes, piece: Piece) -> None:
        """Keep a piece with what its records say; nothing of it where one is broken."""
        counts: Counter[int] = Counter()
        told = []
        first, last = 0, 0
        for opcode, start, end in records_in(data):
            if opcode == Opcode.MESSAGE:
                channel, _, time, _ = MESSAGE.unpack_from(data, start)
                first, last = (min(first, time), max(last, time)) if counts else (time, time)
                counts[channel] += 1
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                told.append((opcode, data[start:end]))
        for opcode, body in told:
            self._tell(opcode, body, piece.checked)
        channels = self._channel_sets.setdefault(frozenset(counts), frozenset(counts))
        self.found.pieces.append(piece._replace(size=len(data), start=first, end=last, channels=channels))
        self.found.counts += counts
        if not piece.checked:
            self.found.unchecked_counts += counts

    def _tell(self, opcode: int, body: bytes, checked: bool) -> None:
        """Take what is told of a channel or a type; our own writer tells the same in every chunk."""
        if (opcode, body, checked) not in self._told:
            self.found.tell(parse(opcode, body), checked)
            self._told.add((opcode, body, checked))

    def _break(self, position: int, what: str) -> int:
        """Note a broken place, and return where something sound begins after it."""
        after = self._next_sound(position)
        is_chunk = self._read(position, 1) == bytes([Opcode.CHUNK])
        self.found.chunks_lost += is_chunk
        first = self.found.pieces[-1].end if self.found.pieces else None
        self.found.broken.append(Place(self._name, position, after, what, first))
        return after

    def _next_sound(self, position: int) -> int:
        """Return the next place where something sound begins: a chunk, the record after this one, or the end."""
        after = self._limit
        try:
            _, length = self._head(position)
            following = position + HEAD.size + length
            if following < self._limit:
                self._head(following)
            after = following
        except BrokenError:
            pass
        for anchor in self._anchors[bisect_right(self._anchors, position) :]:
            if anchor >= after or self._is_sound(anchor):
                after = min(after, anchor)
                break
        # Even then: a head that leads astray may lead over chunks that are intact.
        found = next_chunk(self._stream, position + 1, self._limit, after)
        return after if found is None else found

    def _is_sound(self, position: int) -> bool:
        """Return whether a record begins at a place where the summary says that one does."""
        try:
            opcode, length = self._head(position)
            if opcode == Opcode.CHUNK:
                return is_intact(self._stream, position, self._limit)
            parse(opcode, self._read(position + HEAD.size, length))
        except BrokenError:
            return False
        return opcode in (Opcode.METADATA, Opcode.DATA_END)

    def _read(self, position: int, length: int) -> bytes:
        self._stream.seek(position)
        return self._stream.read(length)
