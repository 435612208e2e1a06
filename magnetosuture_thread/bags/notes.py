"""Words about a bag, as they are kept in it, with a checksum of their own."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping

NOTES = "magnetosuture"  # name of the mcap record that holds our notes
_CHECKSUM = "crc32"  # of all other entries of the record


def sealed(notes: Mapping[str, str]) -> dict[str, str]:
    """Return notes with their checksum, to be written."""
    return {**notes, _CHECKSUM: _checksum(notes)}


def opened(entries: Mapping[str, str], *, vouched: bool) -> dict[str, str] | None:
    """Return notes as they were written; None where nothing says that they are.

    Args:
        entries: as they were read.
        vouched: whether a checksum of all the file's data is right; then they need none of their own.
    """
    notes = {key: value for key, value in entries.items() if key != _CHECKSUM}
    if vouched or entries.get(_CHECKSUM) == _checksum(notes):
        return notes
    return None


def _checksum(notes: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(notes.items())).encode()):08x}"
