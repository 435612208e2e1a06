"""An mcap file, looked through as it is opened, and read by the index of what is intact."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from magnetosuture_thread.bags.damage import counted
from magnetosuture_thread.bags.mcap.chunk import unpack
from magnetosuture_thread.bags.mcap.index import Piece
from magnetosuture_thread.bags.mcap.layout import MAGIC, MESSAGE, BrokenError, records_in
from magnetosuture_thread.bags.mcap.scan import Scan
from magnetosuture_thread.bags.mcap.summary import read_summary
from magnetosuture_thread.bags.mcap.verdict import judge
from magnetosuture_thread.bags.storage import Item, in_order
from magnetosuture_thread.errors import BagError


class McapFile:
    """An mcap file; a `Storage`, where the attributes are told.

    Args:
        path: the file.
        progress: called with the number of bytes looked through since the last call.

    Raises:
        BagError: it cannot be read, is empty, or is no mcap file.
    """

    def __init__(self, path: Path, progress: Callable[[int], None] = lambda count: None) -> None:
        self.path = path
        try:
            with path.open("rb") as stream:
                size = stream.seek(0, 2)
                if not size:
                    raise BagError(path, "is empty, expected an mcap file")
                summary = read_summary(stream, size)
                found = Scan(path, stream, size, summary, progress).walk()
                stream.seek(0)
                if stream.read(len(MAGIC)) != MAGIC and not found.pieces and summary is None:
                    raise BagError(path, "is no mcap file")
                verdict = judge(path.name, size, found, summary, partial(_recount, stream))
        except OSError as error:
            raise BagError(path, f"cannot be read: {error.strerror or error}") from None
        self.connections = verdict.connections
        self.counts = verdict.counts
        self.notes = verdict.notes
        self.damage = verdict.damage
        self.unchecked = verdict.unchecked
        used = set(self.counts)
        self._pieces = [piece for piece in verdict.pieces if piece.channels & used]
        self.start = min((piece.start for piece in self._pieces), default=0)
        self.end = max((piece.end for piece in self._pieces), default=0)
        self._pieces.sort(key=lambda piece: piece.start)
        checked = sum(piece.checked for piece in self._pieces)
        chunks = sum(piece.is_chunk for piece in self._pieces)
        data = "; of all data too" if found.data_is_right else ""
        self.facts = {
            "format": "mcap",
            "bytes": str(size),
            "chunks": str(chunks),
            "compression": ", ".join(sorted(name or "none" for name in found.compressions)) or "none",
            "checksums": f"of {checked} of {counted(chunks, 'chunk')}{data}",
        }

    def items(self, connections: Collection[int], start: int, end: int) -> Iterator[Item]:
        """Go through the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was looked through, or cannot be read any more.
        """
        wanted = frozenset(connections) & set(self.counts)
        try:
            with self.path.open("rb") as stream:
                yield from in_order(
                    (piece.start, partial(self._items_of, stream, piece, wanted, start, end))
                    for piece in self._pieces
                    if piece.start <= end and piece.end >= start and piece.channels & wanted
                )
        except OSError as error:
            raise BagError(self.path, f"cannot be read: {error.strerror or error}") from None

    def _items_of(self, stream: BinaryIO, piece: Piece, wanted: frozenset[int], start: int, end: int) -> Iterator[Item]:
        try:
            data = _load(stream, piece)
        except BrokenError:
            raise BagError(self.path, "has changed while it was read") from None
        places = []
        for opcode, first, last in records_in(data):
            if opcode == Opcode.MESSAGE:
                channel, _, time, _ = MESSAGE.unpack_from(data, first)
                if channel in wanted and start <= time <= end:
                    places.append((time, first + MESSAGE.size, last, channel))
        places.sort()
        for time, first, last, channel in places:
            yield Item(time, self.connections[channel], data[first:last])


def _load(stream: BinaryIO, piece: Piece) -> bytes:
    """Return the records of a piece.

    Raises:
        BrokenError: they are not what they were when the file was looked through.
    """
    stream.seek(piece.offset)
    data = stream.read(piece.length)
    crc = zlib.crc32(data)
    if piece.is_chunk:
        content = unpack(data)
        data, crc = content.data, content.crc
    if crc != piece.crc:
        raise BrokenError("other bytes than before")
    return data


def _recount(stream: BinaryIO, piece: Piece) -> Counter[int]:
    data = _load(stream, piece)
    return Counter(
        MESSAGE.unpack_from(data, first)[0] for opcode, first, _ in records_in(data) if opcode == Opcode.MESSAGE
    )
