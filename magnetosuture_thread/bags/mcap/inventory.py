"""Holds the pieces that were found in an mcap file against its summary's index of chunks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from magnetosuture_thread.bags.mcap.index import Findings, Piece
from magnetosuture_thread.bags.mcap.layout import HEAD
from magnetosuture_thread.bags.mcap.summary import ListedChunk, Summary

_Likeness = tuple[int, int, int, int]


@dataclass(frozen=True)
class Inventory:
    """Which pieces belong to a file, and which are missing.

    Attributes:
        pieces: those that belong to it, in the file's order.
        strangers: those that do not.
        strange: what strangers are, in words.
        missing: chunks that the summary knows and that were not found.
        is_sure: whether there was an index to hold the pieces against.
        in_place: whether the index says where in the file the missing ones were.
    """

    pieces: list[Piece]
    strangers: list[Piece]
    strange: str
    missing: list[ListedChunk]
    is_sure: bool
    in_place: bool


def compare(found: Findings, trusted: Summary | None) -> Inventory:
    """Hold what was found against the index of a summary that can be trusted.

    Without one, a chunk that is there twice counts once: a recorder does not write the same messages of the same
    times again, but a copy of a part of a file does.
    """
    if trusted is not None and trusted.chunks:
        return _by_index(found.pieces, trusted)
    if found.data_is_right:
        return Inventory(found.pieces, [], "", [], is_sure=False, in_place=False)
    seen: set[tuple[int, int, int, int]] = set()
    once, again = list[Piece](), list[Piece]()
    for piece in found.pieces:
        likeness = (piece.crc, piece.size, piece.start, piece.end)
        is_copy = piece.is_chunk and likeness in seen
        seen.add(likeness)
        (again if is_copy else once).append(piece)
    return Inventory(once, again, "a chunk that is there a second time", [], is_sure=False, in_place=False)


def _by_index(pieces: list[Piece], trusted: Summary) -> Inventory:
    """Match first by place, then, for what was moved, by lengths and times."""
    places = {} if trusted.shifted else {chunk.offset: chunk for chunk in trusted.chunks}
    expected = Counter(_told(chunk) for chunk in trusted.chunks)
    own: set[int] = set()
    for number, piece in enumerate(pieces):
        chunk = places.get(piece.offset - HEAD.size)
        if not piece.is_chunk:
            own.add(number)
        elif chunk is not None and chunk.length == piece.length + HEAD.size:
            expected[_told(chunk)] -= 1
            own.add(number)
    for number, piece in enumerate(pieces):
        likeness = (piece.length + HEAD.size, piece.size, piece.start, piece.end)
        if number not in own and expected[likeness] > 0:
            expected[likeness] -= 1
            own.add(number)
    missing = []
    for chunk in trusted.chunks:
        if expected[_told(chunk)] > 0:
            expected[_told(chunk)] -= 1
            missing.append(chunk)
    return Inventory(
        [piece for number, piece in enumerate(pieces) if number in own],
        [piece for number, piece in enumerate(pieces) if number not in own],
        "a chunk that its summary does not know, or that is there a second time",
        missing,
        is_sure=True,
        in_place=not trusted.shifted,
    )


def _told(chunk: ListedChunk) -> _Likeness:
    return chunk.length, chunk.size, chunk.start, chunk.end
