"""The files of a bag and its metadata: rosbag2's metadata.yaml, quality of service, and notes with a checksum."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from magnetosuture_thread.bags.mcap.writer import WriterState
from magnetosuture_thread.bags.storage import Connection
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.files import read_regular
from magnetosuture_thread.interface import STORAGE_SUFFIXES
from magnetosuture_thread.untrusted import MAX_METADATA_BYTES, MAX_TEXT_BYTES, BudgetError, check_yaml

COMPRESSED_SUFFIXES = tuple(f"{suffix}.zstd" for suffix in STORAGE_SUFFIXES)


@dataclass(frozen=True)
class Metadata:
    """What metadata.yaml says.

    Attributes:
        names: of the files, in the order in which they were recorded.
        notes: of our writer.
        packed: whether each message is packed; None where it does not say.
        doubt: why it is not used; empty where it is, or there is none.
        custom_data: entries of others.
    """

    names: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    packed: bool | None = None
    doubt: str = ""
    custom_data: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class BagFiles:
    """The files of a bag.

    Attributes:
        files: in the order in which they were recorded.
        missing: names of those that are listed in metadata.yaml and do not exist.
        unlisted: names of those that are there and not listed in metadata.yaml, so that they are not read.
        metadata: what metadata.yaml says.
    """

    files: list[Path]
    missing: list[str] = field(default_factory=list)
    unlisted: list[str] = field(default_factory=list)
    metadata: Metadata = field(default_factory=Metadata)


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
    except FileNotFoundError as error:
        raise BagError(path, "does not exist; expected an mcap file or the folder of a bag") from error
    except Exception as error:  # The file system of a URL raises whatever its library does.
        problem = getattr(error, "strerror", None) or error
        raise BagError(path, f"cannot be read: {problem}") from error
    if path.is_file():
        if path.name.endswith(COMPRESSED_SUFFIXES):
            raise BagError(path, f"is compressed as a whole; decompress it first: zstd -d {path.name}")
        beside = read_metadata(path.parent)
        return BagFiles([path], metadata=Metadata(packed=beside.packed if path.name in beside.names else None))
    metadata = read_metadata(path)
    names = metadata.names
    present = {file.name: file for file in files}
    if listed := [present[name] for name in names if name in present]:
        missing = [name for name in names if name not in present]
        packs = {f"{name}.zstd" for name in names}  # left beside the unpacked files by a player
        unlisted = [
            file.name
            for file in inside
            if file.name.endswith((*STORAGE_SUFFIXES, *COMPRESSED_SUFFIXES)) and file.name not in {*names, *packs}
        ]
        return BagFiles(listed, missing, unlisted, metadata)
    compressed = [file for file in inside if file.name.endswith(COMPRESSED_SUFFIXES)]
    if compressed and not files:
        raise BagError(path, f"is compressed as a whole; decompress it first: zstd -d {compressed[0].name}")
    if not files:
        raise BagError(path, f"holds no {' or '.join(STORAGE_SUFFIXES)} file")
    if len(files) > 1 and not _is_split(files):
        kind = files[0].suffix if len({file.suffix for file in files}) == 1 else ".mcap and .db3"
        raise BagError(path, f"holds {len(files)} {kind} files; name one of them")
    return BagFiles(files, metadata=metadata)


def _by_number(path: Path) -> tuple[str, int, str]:
    """Sort files of a split bag as they were recorded: bag_2 before bag_10."""
    found = re.fullmatch(r"(.*?)_?(\d+)", path.stem)
    return (found[1], int(found[2]), path.name) if found else (path.stem, -1, path.name)


def _is_split(files: list[Path]) -> bool:
    """Return whether files are numbered parts of one bag."""
    keys = [(_by_number(file)[0], file.suffix) for file in files]
    return len(set(keys)) == 1 and all(_by_number(file)[1] >= 0 for file in files)


METADATA_FILE = "metadata.yaml"
MAX_ALIASES = 16  # in it; some recorders write none, others a few
NOTES = "magnetosuture"  # name of the mcap record that holds our notes
QOS = "offered_qos_profiles"  # metadata key of a connection, in mcap and in sqlite3
TYPE_HASH = "topic_type_hash"
UNVERIFIED_NOTE = "unverified"  # note of a bag that was salvaged from one without checksums: why it may be wrong
UNCHECKED_NOTE = "unchecked"  # note of a bag that was made from one whose damage could not have been noticed
_FORMAT_VERSION = 9  # of metadata.yaml
_PREFIX = f"{NOTES}."  # of our entries in metadata.yaml
_CHECKSUM = "crc32"  # of all other entries of the record


def add_checksum(notes: Mapping[str, str]) -> dict[str, str]:
    """Return notes with their checksum, to be written."""
    return {**notes, _CHECKSUM: _checksum(notes)}


def verified_notes(entries: Mapping[str, str], *, data_verified: bool = False) -> dict[str, str] | None:
    """Return notes without their checksum; None where it is wrong.

    Args:
        entries: as they were read.
        data_verified: whether a checksum of the whole file is correct; then the notes need none of their own.
    """
    notes = {key: value for key, value in entries.items() if key != _CHECKSUM}
    if data_verified or entries.get(_CHECKSUM) == _checksum(notes):
        return notes
    return None


def _checksum(notes: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(notes.items())).encode()):08x}"


def marked(connection: Connection, notes: Mapping[str, str]) -> Connection:
    """Return a connection whose metadata repeats what of a bag's notes must never get lost."""
    marks = {_PREFIX + key: notes[key] for key in (UNVERIFIED_NOTE, UNCHECKED_NOTE) if key in notes}
    return replace(connection, metadata={**connection.metadata, **marks}) if marks else connection


def marks_of(connections: Iterable[Connection]) -> dict[str, str]:
    """Return the notes that connections repeat."""
    keys = (UNVERIFIED_NOTE, UNCHECKED_NOTE)
    return {key: each.metadata[_PREFIX + key] for each in connections for key in keys if _PREFIX + key in each.metadata}


def parse_qos_profiles(text: str) -> list[dict[str, Any]]:
    """Return the profiles of a topic's publishers, their policies by name; none where they cannot be read.

    Up to Iron, policies were written by number. A reader that expects names cannot play such a topic.

    Args:
        text: YAML, as a recorder keeps it with a topic.
    """
    try:
        if len(text) > MAX_TEXT_BYTES:
            return []
        check_yaml(text)
        return [{**profile} for profile in dump_qos_v9(parse_qos(text))]
    except Exception:  # The parser raises whatever the text makes it stumble over.
        return []


def jazzy_qos_profiles(text: str) -> str:
    """Return profiles as Jazzy keeps them with a topic, by name; the text itself where it does so or cannot be read."""
    profiles = parse_qos_profiles(text)
    if not profiles or yaml.load(text, yaml.CSafeLoader) == profiles:
        return text
    return yaml.safe_dump(profiles, sort_keys=False)


def read_metadata(folder: Path) -> Metadata:
    """Read the metadata.yaml of a bag; what cannot be read of it is left out, and the doubt says why."""
    try:
        text = read_regular(folder / METADATA_FILE, MAX_METADATA_BYTES).decode("utf-8")
        check_yaml(text, max_aliases=MAX_ALIASES)
        content: Any = yaml.load(text, yaml.CSafeLoader)
        information = content["rosbag2_bagfile_information"]
        names = list(dict.fromkeys(Path(name).name for name in information["relative_file_paths"]))
        mode = information.get("compression_mode")
        packed = None if mode is None else str(mode).lower() == "message"
        custom = information.get("custom_data")
        if not isinstance(custom, Mapping):
            return Metadata(names, {}, packed)
        entries = {str(key): str(value) for key, value in custom.items()}
        ours = {key.removeprefix(_PREFIX): value for key, value in entries.items() if key.startswith(_PREFIX)}
        others = {key: value for key, value in entries.items() if not key.startswith(_PREFIX)}
        return Metadata(names, verified_notes(ours) or {}, packed, custom_data=others)
    except FileNotFoundError:
        return Metadata()
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        problem = getattr(error, "strerror", None) or "is not what rosbag2 writes"
    except BudgetError as error:
        problem = f"has {error}"
    except yaml.YAMLError:
        problem = "is no YAML"
    return Metadata(doubt=f"{METADATA_FILE} is not used: {problem}")


def bag_information(
    file_name: str,
    state: WriterState,
    connections: Mapping[int, Connection],
    notes: Mapping[str, str],
    custom_data: Mapping[str, str],
) -> dict[str, Any]:
    """Return the content of metadata.yaml for a bag of one mcap file.

    Args:
        file_name: of the mcap file.
        state: of its writer.
        connections: by channel id.
        notes: kept as custom data.
        custom_data: besides these.
    """
    ours = {_PREFIX + key: value for key, value in add_checksum(notes).items()} if notes else {}
    start = {"nanoseconds_since_epoch": state.start or 0}
    duration = {"nanoseconds": state.end - (state.start or 0)}
    count = state.counts.total()
    topics = [
        {
            "topic_metadata": {
                "name": connection.topic,
                "type": connection.type_name,
                "serialization_format": connection.serialization,
                "offered_qos_profiles": parse_qos_profiles(connection.metadata.get(QOS, "")),
                "type_description_hash": connection.metadata.get(TYPE_HASH, ""),
            },
            "message_count": state.counts[number],
        }
        for number, connection in connections.items()
    ]
    return {
        "version": _FORMAT_VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": start,
        "message_count": count,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [
            {"path": file_name, "starting_time": {**start}, "duration": {**duration}, "message_count": count}
        ],  # copies, as YAML would write aliases
        "custom_data": {**custom_data, **ours},
        "ros_distro": "jazzy",
    }
