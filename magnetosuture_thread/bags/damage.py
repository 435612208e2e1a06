"""What is broken in a bag, and what was lost by it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Place:
    """Where a file is broken.

    Attributes:
        file: its name.
        start: first byte that is broken.
        end: the byte after the last.
        what: in words, for example `a chunk with a wrong checksum`.
        first: messages may be missing from this time on [ns]; None where nothing tells, or none are missing.
        last: ... to this time [ns].
    """

    file: str
    start: int
    end: int
    what: str
    first: int | None = None
    last: int | None = None

    def __str__(self) -> str:
        """Return one line for a person."""
        where = f"byte {self.start}" if self.end <= self.start else f"bytes {self.start} to {self.end}"
        return f"{self.file}, {where}: {self.what}"


@dataclass(frozen=True)
class Damage:
    """What is broken in a bag.

    Attributes:
        places: where.
        chunks: chunks known to be lost; more may be where the file's end is missing.
        bytes: bytes that could not be used.
        messages: messages lost; None where nobody can know.
    """

    places: tuple[Place, ...]
    chunks: int
    bytes: int
    messages: int | None

    def __str__(self) -> str:
        """Return one line for a person."""
        others = len(self.places) - 1
        where = f"{self.places[0]}" + (f", and {others} other place{'s' * (others > 1)}" if others else "")
        if self.messages == 0:
            return f"is damaged ({where}), but no message is lost"
        lost = "nobody knows how many messages" if self.messages is None else counted(self.messages, "message")
        chunks = f" in {counted(self.chunks, 'chunk')}" if self.chunks else ""
        verb = "is" if self.messages == 1 else "are"
        return f"is damaged ({where}): {lost}{chunks} {verb} lost, all else is read"


def counted(count: int, word: str) -> str:
    """Return a number with its word, for example `2 chunks`."""
    return f"{count} {word}{'s' * (count != 1)}"


def together(damages: Iterable[Damage | None]) -> Damage | None:
    """Return the damage of several files as one; None if all are whole."""
    broken = [damage for damage in damages if damage is not None]
    if not broken:
        return None
    lost = [damage.messages for damage in broken]
    known = [count for count in lost if count is not None]
    return Damage(
        places=tuple(place for damage in broken for place in damage.places),
        chunks=sum(damage.chunks for damage in broken),
        bytes=sum(damage.bytes for damage in broken),
        messages=sum(known) if len(known) == len(lost) else None,
    )
