"""What all formats of bags share: their files and metadata, connections, messages by time, and reports of damage."""

from __future__ import annotations

import heapq
import json
import math
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, BudgetError, check_yaml, read_regular
from magnetosuture_thread.settings.interface import STORAGE_SUFFIXES

CDR = "cdr"  # how ROS 2 writes messages
METADATA_FILE = "metadata.yaml"
COMPRESSED_SUFFIXES = tuple(f"{suffix}.zstd" for suffix in STORAGE_SUFFIXES)
QOS = "offered_qos_profiles"  # metadata key of a connection, in mcap and in sqlite3
TYPE_HASH = "topic_type_hash"  # another
NOTES = "magnetosuture"  # name of the mcap record that holds our notes
NOTES_PREFIX = f"{NOTES}."  # of our entries in metadata.yaml
UNVERIFIED_NOTE = "unverified"  # note of a bag that was salvaged from one without checksums: why it may be wrong
UNCHECKED_NOTE = "unchecked"  # note of a bag that was made from one whose damage could not have been noticed
MAX_ALIASES = 16  # in metadata.yaml; some recorders write none, others a few
_CHECKSUM = "crc32"  # note: of all others
MAX_SILENCE = 5.0  # s without any message, which a person waits for; longer is a pause, or a clock that was set


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


def silence_text(begin: float, end: float) -> str:
    """Return a line on a silence of more than `MAX_SILENCE`, with where it begins and ends in the bag [s]."""
    after = math.floor(1e3 * end) * 1e-3  # not later than the message that ends it
    return (
        f"no message for {end - begin:.1f} s from {begin:.3f} s on, by a pause or a clock that was set: "
        f"a live replay leaves this out, --start {after:.3f} begins after it"
    )


def pluralize(count: int, noun: str) -> str:
    """Return a count with its noun, for example `2 chunks`."""
    return f"{count} {noun}{'s' * (count != 1)}"


def merge_reports(reports: Iterable[DamageReport | None]) -> DamageReport | None:
    """Return the damage of several files as one report; None if all files are intact."""
    damaged = [report for report in reports if report is not None]
    if not damaged:
        return None
    lost = [report.messages for report in damaged if report.messages is not None]
    return DamageReport(
        regions=tuple(region for report in damaged for region in report.regions),
        chunks=sum(report.chunks for report in damaged),
        bytes=sum(report.bytes for report in damaged),
        messages=sum(lost) if len(lost) == len(damaged) else None,
    )


@dataclass(frozen=True)
class MessageDefinition:
    """The definition of a message type in a bag.

    Attributes:
        type_name: for example `nav_msgs/msg/Path`.
        encoding: `ros2msg` or `ros2idl`; empty where the bag does not define it.
        text: the definition, with those of all types in it. Of another encoding it may be binary: bytes that are no
            UTF-8 are kept as surrogates (`surrogateescape`), so that it can be written as it was.
    """

    type_name: str
    encoding: str = ""
    text: str = ""


@dataclass(frozen=True)
class Connection:
    """The messages of one publisher, or of one kind of publisher, on a topic.

    Attributes:
        topic: as it was recorded.
        definition: of its type.
        serialization: of its messages; `cdr` in ROS 2.
        metadata: quality of service and other entries of the recorder, kept for repair.
    """

    topic: str
    definition: MessageDefinition
    serialization: str = CDR
    metadata: Mapping[str, str] = field(default_factory=dict, hash=False)

    @property
    def type_name(self) -> str:
        """Return the name of its type."""
        return self.definition.type_name


class StoredMessage(NamedTuple):
    """A message as it is stored in a file.

    Attributes:
        time: when it was recorded [ns].
        connection: that it was recorded from.
        data: as stored, which may be packed.
        publish_time: when it was published [ns]; None where the format has no such time.
        sequence: number given by its publisher; None where the format has none.
    """

    time: int
    connection: Connection
    data: bytes
    publish_time: int | None = None
    sequence: int | None = None


def merge_by_time(parts: Iterable[tuple[int, Callable[[], Iterator[StoredMessage]]]]) -> Iterator[StoredMessage]:
    """Yield the messages of all parts by time; of parts that do not overlap, one is in memory at a time.

    Args:
        parts: start time of each part, and a function that yields its messages by time. Sorted by start time.
    """
    heap: list[tuple[int, int, StoredMessage, Iterator[StoredMessage]]] = []
    last: tuple[float, Callable[[], Iterator[StoredMessage]]] = (math.inf, lambda: iter(()))
    for part, (start, read) in enumerate(chain(parts, [last])):
        while heap and heap[0][0] < start:  # what comes before anything of this part
            _, number, item, items = heap[0]
            yield item
            following = next(items, None)
            if following is None:
                heapq.heappop(heap)
            else:
                heapq.heapreplace(heap, (following.time, number, following, items))
        items = read()
        first = next(items, None)
        if first is not None:
            heapq.heappush(heap, (first.time, part, first, items))


@dataclass(frozen=True)
class BagFiles:
    """The files of a bag, and what its metadata.yaml says.

    Attributes:
        files: in the order in which they were recorded.
        missing: names of those that are listed in metadata.yaml and do not exist.
        remarks: on what is not read or not used, a line each.
        notes: of our writer.
        custom_data: entries of others.
    """

    files: list[Path]
    missing: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    custom_data: dict[str, str] = field(default_factory=dict)


def find_bag_files(path: Path) -> BagFiles:
    """Return the files of a bag.

    Args:
        path: a file, or a folder with one or, where a recorder split the bag, several.

    Raises:
        BagError: there is no bag.
    """
    try:
        path.stat()
        is_file = path.is_file()
        inside = [path] if is_file else sorted(path.iterdir(), key=_by_number)
        files = [file for file in inside if file.suffix in STORAGE_SUFFIXES and file.is_file()]
    except FileNotFoundError as error:
        raise BagError(path, "does not exist; expected an mcap file or the folder of a bag") from error
    except Exception as error:  # The file system of a URL raises whatever its library does.
        problem = getattr(error, "strerror", None) or error
        raise BagError(path, f"cannot be read: {problem}") from error
    compressed = [file.name for file in inside if file.name.endswith(COMPRESSED_SUFFIXES)]
    if compressed and not files:
        raise BagError(path, f"is compressed as a whole; decompress it first: zstd -d {compressed[0]}")
    if is_file:
        return BagFiles([path])
    files = files or [file for file in inside if file.suffix == ".bag"][:1]  # of ROS 1, which opening it names
    if not files:
        raise BagError(path, f"holds no {' or '.join(STORAGE_SUFFIXES)} file")
    content, remarks = _read_metadata(path)
    names: list[str] = content.pop("names", [])
    present = {file.name: file for file in files}
    if listed := [present[name] for name in names if name in present]:
        missing = [name for name in names if name not in present]
        remarks += [f"{name} is not read: {METADATA_FILE} does not list it" for name in present if name not in names]
        return BagFiles(listed, missing, remarks, **content)
    bases = {(_by_number(file)[0], file.suffix) for file in files}
    if len(files) > 1 and (len(bases) > 1 or any(_by_number(file)[1] < 0 for file in files)):
        kind = " and ".join(sorted({file.suffix for file in files}, reverse=True))
        raise BagError(path, f"holds {len(files)} {kind} files; name one of them")
    return BagFiles(files, remarks=remarks, **content)


def _by_number(path: Path) -> tuple[str, int, str]:
    """Sort files of a split bag as they were recorded: bag_2 before bag_10."""
    found = re.fullmatch(r"(.*?)_?(\d+)", path.stem)
    return (found[1], int(found[2]), path.name) if found else (path.stem, -1, path.name)


def _read_metadata(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Return names of files, notes and custom data of a bag's metadata.yaml; and in a line why it is not used."""
    try:
        text = read_regular(folder / METADATA_FILE, MAX_TEXT_BYTES).decode("utf-8")
        check_yaml(text, max_aliases=MAX_ALIASES)
        information = yaml.load(text, yaml.CSafeLoader)["rosbag2_bagfile_information"]
        names = list(dict.fromkeys(Path(name).name for name in information["relative_file_paths"]))
        custom = information.get("custom_data")
        entries = {str(key): str(value) for key, value in custom.items()} if isinstance(custom, Mapping) else {}
        ours = {key.removeprefix(NOTES_PREFIX): entries.pop(key) for key in [*entries] if key.startswith(NOTES_PREFIX)}
        return {"names": names, "notes": verified_notes(ours) or {}, "custom_data": entries}, []
    except FileNotFoundError:
        return {}, []
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        problem = getattr(error, "strerror", None) or "is not what rosbag2 writes"
    except BudgetError as error:
        problem = f"has {error}"
    except yaml.YAMLError:
        problem = "is no YAML"
    return {}, [f"{METADATA_FILE} is not used: {problem}"]


def add_checksum(notes: Mapping[str, str]) -> dict[str, str]:
    """Return notes with their checksum, to be written."""
    return {**notes, _CHECKSUM: f"{zlib.crc32(json.dumps(sorted(notes.items())).encode()):08x}"}


def verified_notes(entries: Mapping[str, str], *, data_verified: bool = False) -> dict[str, str] | None:
    """Return notes without their checksum; None where it is wrong.

    Args:
        entries: as they were read.
        data_verified: whether a checksum of the whole file is correct; then the notes need none of their own.
    """
    notes = {key: value for key, value in entries.items() if key != _CHECKSUM}
    return notes if data_verified or entries == add_checksum(notes) else None


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
