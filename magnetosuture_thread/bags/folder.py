"""Which files make up a bag."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from magnetosuture_thread.bags.notes import from_custom_data
from magnetosuture_thread.errors import BagError

STORAGES = (".mcap", ".db3")
PACKED = tuple(f"{ending}.zstd" for ending in STORAGES)


@dataclass(frozen=True)
class BagFiles:
    """The files of a bag.

    Attributes:
        files: in the order in which they were recorded.
        missing: names of those that metadata.yaml tells and that are not there.
        notes: what metadata.yaml says that our writer said of the bag.
    """

    files: list[Path]
    missing: list[str]
    notes: dict[str, str]


def bag_files(path: Path) -> BagFiles:
    """Return the files of a bag.

    Args:
        path: a file, or a folder with one or, where a recorder split the bag, several.

    Raises:
        BagError: there is no bag.
    """
    try:
        path.stat()
        inside = [path] if path.is_file() else sorted(path.iterdir(), key=_by_number)
        files = [file for file in inside if file.suffix in STORAGES and file.is_file()]
    except FileNotFoundError:
        raise BagError(path, "does not exist; expected an mcap file or the folder of a bag") from None
    except (OSError, ValueError) as error:
        problem = getattr(error, "strerror", None) or error
        raise BagError(path, f"cannot be read: {problem}") from None
    if path.is_file():
        if path.name.endswith(PACKED):
            raise BagError(path, f"is packed as a whole; unpack it first: zstd -d {path.name}")
        return BagFiles([path], [], {})
    told, notes = _told(path / "metadata.yaml")
    if told:
        there = {file.name: file for file in files}
        listed, missing = [there[n] for n in told if n in there], [n for n in told if n not in there]
        if listed:
            return BagFiles(listed, missing, notes)
    packed = [file for file in inside if file.name.endswith(PACKED)]
    if packed and not files:
        raise BagError(path, f"is packed as a whole; unpack it first: zstd -d {packed[0].name}")
    if not files:
        raise BagError(path, f"holds no {' or '.join(STORAGES)} file")
    if len(files) > 1 and not _is_split(files):
        kind = files[0].suffix if len({file.suffix for file in files}) == 1 else ".mcap and .db3"
        raise BagError(path, f"holds {len(files)} {kind} files; name one of them")
    return BagFiles(files, [], notes)


def _told(path: Path) -> tuple[list[str], dict[str, str]]:
    """Return the files that metadata.yaml names, and its notes; none where it cannot be read."""
    try:
        content: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
        information = content["rosbag2_bagfile_information"]
        names = dict.fromkeys(Path(name).name for name in information["relative_file_paths"])  # one told twice is one
        return list(names), from_custom_data(information.get("custom_data"))
    except (OSError, ValueError, yaml.YAMLError, LookupError, TypeError, AttributeError, RecursionError):
        return [], {}


def _by_number(path: Path) -> tuple[str, int, str]:
    """Sort files of a split bag as they were recorded: bag_2 before bag_10."""
    found = re.fullmatch(r"(.*?)_?(\d+)", path.stem)
    return (found[1], int(found[2]), path.name) if found else (path.stem, -1, path.name)


def _is_split(files: list[Path]) -> bool:
    """Return whether files are numbered parts of one bag."""
    keys = [(_by_number(file)[0], file.suffix) for file in files]
    return len(set(keys)) == 1 and all(_by_number(file)[1] >= 0 for file in files)
