"""Metadata of a bag: rosbag2's metadata.yaml, its quality of service profiles, and notes with a checksum."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from magnetosuture_thread.bags.mcap.writer import WriterState
from magnetosuture_thread.bags.storage import Connection

METADATA_FILE = "metadata.yaml"
NOTES = "magnetosuture"  # name of the mcap record that holds our notes
QOS = "offered_qos_profiles"  # metadata key of a connection, in mcap and in sqlite3
TYPE_HASH = "topic_type_hash"
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


def parse_qos_profiles(text: str) -> list[dict[str, Any]]:
    """Return the profiles of a topic's publishers, their policies by name; none where they cannot be read.

    Up to Iron, policies were written by number. A reader that expects names cannot play such a topic.

    Args:
        text: YAML, as a recorder keeps it with a topic.
    """
    try:
        return [{**profile} for profile in dump_qos_v9(parse_qos(text))]
    except Exception:  # The parser raises whatever the text makes it stumble over.
        return []


def dump_qos_profiles(profiles: Sequence[dict[str, Any]]) -> str:
    """Return profiles as they are kept with a topic."""
    return yaml.safe_dump(list(profiles), sort_keys=False) if profiles else ""


def read_metadata(folder: Path) -> tuple[list[str], dict[str, str]]:
    """Return the file names and notes in the metadata.yaml of a bag; none where it cannot be read."""
    try:
        content: Any = yaml.safe_load((folder / METADATA_FILE).read_text(encoding="utf-8"))
        information = content["rosbag2_bagfile_information"]
        names = list(dict.fromkeys(Path(name).name for name in information["relative_file_paths"]))
        custom = information.get("custom_data")
        if not isinstance(custom, Mapping):
            return names, {}
        entries = {str(key): str(value) for key, value in custom.items()}
        ours = {key.removeprefix(_PREFIX): value for key, value in entries.items() if key.startswith(_PREFIX)}
        return names, verified_notes(ours) or {}
    except (OSError, ValueError, yaml.YAMLError, LookupError, TypeError, AttributeError, RecursionError):
        return [], {}


def bag_information(
    file_name: str, state: WriterState, connections: Mapping[int, Connection], notes: Mapping[str, str]
) -> dict[str, Any]:
    """Return the content of metadata.yaml for a bag of one mcap file.

    Args:
        file_name: of the mcap file.
        state: of its writer.
        connections: by channel id.
        notes: kept as custom data.
    """
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
        "custom_data": {_PREFIX + key: value for key, value in add_checksum(notes).items()} if notes else {},
        "ros_distro": "jazzy",
    }
