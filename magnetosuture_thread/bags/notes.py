"""Words about a bag, as they are kept in it, with a checksum of their own."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping

NOTES = "magnetosuture"  # name of the mcap record that holds our notes
_PREFIX = f"{NOTES}."  # of our entries in metadata.yaml
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


def as_custom_data(notes: Mapping[str, str]) -> dict[str, str]:
    """Return notes, with their checksum, as entries of metadata.yaml."""
    return {_PREFIX + key: value for key, value in sealed(notes).items()} if notes else {}


def from_custom_data(entries: object) -> dict[str, str]:
    """Return notes from metadata.yaml; none where nothing says that they are as they were written."""
    if not isinstance(entries, Mapping):
        return {}
    words = {str(key): str(value) for key, value in entries.items()}
    ours = {key.removeprefix(_PREFIX): value for key, value in words.items() if key.startswith(_PREFIX)}
    return opened(ours, vouched=False) or {}


def _checksum(notes: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(notes.items())).encode()):08x}"
