"""Finds the files of a bag."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from magnetosuture_thread.bags.metadata import read_metadata
from magnetosuture_thread.errors import BagError

STORAGE_SUFFIXES = (".mcap", ".db3")
COMPRESSED_SUFFIXES = tuple(f"{suffix}.zstd" for suffix in STORAGE_SUFFIXES)


@dataclass(frozen=True)
class BagFiles:
    """The files of a bag.

    Attributes:
        files: in the order in which they were recorded.
        missing: names of those that are listed in metadata.yaml and do not exist.
        notes: notes of our writer in metadata.yaml.
    """

    files: list[Path]
    missing: list[str]
    notes: dict[str, str]


def find_bag_files(path: Path) -> BagFiles:
    """Return the files of a bag.

    Args:
        path: a file, or a folder with one or, where a recorder split the bag, several.

    Raises:
        BagError: there is no bag.
    """
    try:
        path.stat()
        inside = [path] if path.is_file() else sorted(path.iterdir(), key=_by_number)
        files = [file for file in inside if file.suffix in STORAGE_SUFFIXES and file.is_file()]
    except FileNotFoundError:
        raise BagError(path, "does not exist; expected an mcap file or the folder of a bag") from None
    except (OSError, ValueError) as error:
        problem = getattr(error, "strerror", None) or error
        raise BagError(path, f"cannot be read: {problem}") from None
    if path.is_file():
        if path.name.endswith(COMPRESSED_SUFFIXES):
            raise BagError(path, f"is compressed as a whole; decompress it first: zstd -d {path.name}")
        return BagFiles([path], [], {})
    names, notes = read_metadata(path)
    present = {file.name: file for file in files}
    if listed := [present[name] for name in names if name in present]:
        return BagFiles(listed, [name for name in names if name not in present], notes)
    compressed = [file for file in inside if file.name.endswith(COMPRESSED_SUFFIXES)]
    if compressed and not files:
        raise BagError(path, f"is compressed as a whole; decompress it first: zstd -d {compressed[0].name}")
    if not files:
        raise BagError(path, f"holds no {' or '.join(STORAGE_SUFFIXES)} file")
    if len(files) > 1 and not _is_split(files):
        kind = files[0].suffix if len({file.suffix for file in files}) == 1 else ".mcap and .db3"
        raise BagError(path, f"holds {len(files)} {kind} files; name one of them")
    return BagFiles(files, [], notes)


def _by_number(path: Path) -> tuple[str, int, str]:
    """Sort files of a split bag as they were recorded: bag_2 before bag_10."""
    found = re.fullmatch(r"(.*?)_?(\d+)", path.stem)
    return (found[1], int(found[2]), path.name) if found else (path.stem, -1, path.name)


def _is_split(files: list[Path]) -> bool:
    """Return whether files are numbered parts of one bag."""
    keys = [(_by_number(file)[0], file.suffix) for file in files]
    return len(set(keys)) == 1 and all(_by_number(file)[1] >= 0 for file in files)
