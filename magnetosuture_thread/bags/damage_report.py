"""Corrupt regions of a bag and what was lost in them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class CorruptRegion:
    """A corrupt region of a file.

    Attributes:
        file: its name.
        start: first corrupt byte.
        end: the byte after the last.
        what: description, for example `a chunk with a wrong checksum`.
        first: messages may be missing from this time on [ns]; None where it is unknown or none are missing.
        last: ... to this time [ns].
    """

    file: str
    start: int
    end: int
    what: str
    first: int | None = None
    last: int | None = None

    def __str__(self) -> str:
        """Return file, bytes and description in one line."""
        where = f"byte {self.start}" if self.end <= self.start else f"bytes {self.start} to {self.end}"
        return f"{self.file}, {where}: {self.what}"


@dataclass(frozen=True)
class DamageReport:
    """All corrupt regions of a bag and what was lost.

    Attributes:
        regions: the corrupt regions.
        chunks: chunks known to be lost; more may be lost where the end of the file is missing.
        bytes: bytes that could not be used.
        messages: messages lost; None where the number is unknown.
    """

    regions: tuple[CorruptRegion, ...]
    chunks: int
    bytes: int
    messages: int | None

    def __str__(self) -> str:
        """Return a summary in one line."""
        others = len(self.regions) - 1
        where = f"{self.regions[0]}" + (f", and {others} other place{'s' * (others > 1)}" if others else "")
        if self.messages == 0:
            return f"is damaged ({where}), but no message is lost"
        lost = "an unknown number of messages" if self.messages is None else pluralize(self.messages, "message")
        chunks = f" in {pluralize(self.chunks, 'chunk')}" if self.chunks else ""
        verb = "is" if self.messages in (1, None) else "are"
        return f"is damaged ({where}): {lost}{chunks} {verb} lost, all else is read"


def pluralize(count: int, noun: str) -> str:
    """Return a count with its noun, for example `2 chunks`."""
    return f"{count} {noun}{'s' * (count != 1)}"


def merge_reports(reports: Iterable[DamageReport | None]) -> DamageReport | None:
    """Return the damage of several files as one report; None if all files are intact."""
    damaged = [report for report in reports if report is not None]
    if not damaged:
        return None
    lost = [report.messages for report in damaged]
    known = [count for count in lost if count is not None]
    return DamageReport(
        regions=tuple(region for report in damaged for region in report.regions),
        chunks=sum(report.chunks for report in damaged),
        bytes=sum(report.bytes for report in damaged),
        messages=sum(known) if len(known) == len(lost) else None,
    )
