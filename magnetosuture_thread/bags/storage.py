"""Common parts of the formats of bags: files and metadata, connections, messages by time, damage, caps on sizes."""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from heapq import heappop, heappush, heapreplace
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import yaml
import zstandard
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, is_url, read_regular
from magnetosuture_thread.settings.interface import STORAGE_SUFFIXES

CDR = "cdr"  # how ROS 2 writes messages
METADATA_FILE = "metadata.yaml"
# What unpacks a file that is compressed as a whole: by rosbag2, which names zstd's so, or by hand.
UNPACKERS = {".zstd": "zstd -d", ".zst": "zstd -d", ".gz": "gunzip", ".bz2": "bunzip2", ".xz": "unxz", ".lz4": "lz4 -d"}
COMPRESSED_SUFFIXES = tuple(f"{suffix}{packed}" for suffix in STORAGE_SUFFIXES for packed in UNPACKERS)
QOS, TYPE_HASH = "offered_qos_profiles", "topic_type_hash"  # metadata of a connection, in mcap and in sqlite3
NOTES = "magnetosuture"  # name of the mcap record that holds our notes, and prefix of our entries in metadata.yaml
NO_CHECKSUM_NOTE = "unchecked"  # note of a bag that was made from one whose damage could not have been noticed
MAX_SILENCE = 5.0  # s without any message, which a person waits for; longer is a pause, or a clock that was set
MAX_RECORD_BYTES = 1 << 26  # of a message or a chunk of messages, packed or not
RANGE_BYTES = 1 << 20  # fetched at once, at least, of a file that a URL names


class Budget:
    """Caps on what a bag may take, by the size of its files: some bytes may ask for gigabytes.

    A recorder's compression saves a factor of 2 to 50; a bomb's, thousands. A message takes 5 bytes or more on the
    disk, and the parts of a split bag repeat their definitions. A usual definition of a message type takes 200 to
    5,000 steps to parse, 40,000 take a second.

    Args:
        path: of the bag, for errors.
        size: of its files [bytes].
    """

    def __init__(self, path: object, size: int) -> None:
        self._path = path
        self._left = {
            "unpacked bytes": (1 << 29) + 200 * size,
            "records": 200_000 + size // 4,
            "bytes of definitions": (1 << 25) + 2 * size,
            "steps to parse its definitions": 100_000,
        }

    def spend(self, kind: str, amount: int) -> None:
        """Count an amount of a kind.

        Raises:
            BagError: there is more of it than a recording of this size has.
        """
        self._left[kind] -= amount
        if self._left[kind] < 0:
            raise BagError(self._path, f"takes more {kind} than a recording of its size does")


@dataclass(frozen=True)
class CorruptRegion:
    """A corrupt region of a file.

    Attributes:
        file: its name.
        start: first corrupt byte.
        end: the byte after the last; 0 where the file as a whole is missing.
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
        return f"{self.file}, bytes {self.start} to {self.end}: {self.what}" if self.end else f"{self.file} {self.what}"


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
        where = f"{self.regions[0]}" + (f", and {pluralize(others, 'other place')}" if others else "")
        if self.messages == 0:
            return f"is damaged ({where}), but no message is lost"
        lost = "an unknown number of messages" if self.messages is None else pluralize(self.messages, "message")
        chunks = f" in {pluralize(self.chunks, 'chunk')}" if self.chunks else ""
        verb = "is" if self.messages in (1, None) else "are"
        return f"is damaged ({where}): {lost}{chunks} {verb} lost, all else is read"

    def to_json(self) -> dict[str, Any]:
        """Return the report in SI units; null where there is no value."""
        places = [
            {
                "file": region.file,
                "start_byte": region.start,
                "end_byte": region.end,
                "what": region.what,
                "text": str(region),
                "first_s": None if region.first is None else region.first * 1e-9,
                "last_s": None if region.last is None else region.last * 1e-9,
            }
            for region in self.regions
        ]
        lost = {"chunks_lost": self.chunks, "bytes_lost": self.bytes, "messages_lost": self.messages}
        return {"text": str(self), **lost, "places": places}


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
    lost = [report.messages for report in damaged if report.messages is not None]
    regions = tuple(region for report in damaged for region in report.regions)
    chunks, size = sum(report.chunks for report in damaged), sum(report.bytes for report in damaged)
    return DamageReport(regions, chunks, size, sum(lost) if len(lost) == len(damaged) else None) if damaged else None


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


def merge_by_time(parts: Iterable[tuple[int, Iterator[StoredMessage]]]) -> Iterator[StoredMessage]:
    """Yield the messages of all parts by time; of parts that do not overlap, one is in memory at a time.

    Args:
        parts: a time that no message of the part is before, by which they are sorted, and its messages by time.
    """
    heap: list[tuple[float, int, StoredMessage | None, Iterator[StoredMessage]]] = []
    end: tuple[float, Iterator[StoredMessage]] = (math.inf, iter(()))
    for number, (start, messages) in enumerate(chain(parts, [end])):
        while heap and heap[0][0] < start:  # what comes before anything of this part
            _, part, message, following = heap[0]
            if message is not None:
                yield message
            if (message := next(following, None)) is None:
                heappop(heap)
            else:
                heapreplace(heap, (message.time, part, message, following))
        heappush(heap, (start, number, None, messages))


def unpack_zstd(data: bytes, size: int = MAX_RECORD_BYTES) -> bytes:
    """Return data unpacked, to a size at most where the frame does not say its own; any other size is a `ZstdError`."""
    if zstandard.frame_content_size(data) > size:
        raise zstandard.ZstdError(f"it is larger than {size} bytes")
    return zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES).decompress(data, max_output_size=size)


@contextmanager
def refusing_unreadable(path: Path) -> Iterator[None]:
    """Turn what the file system says of a file into a `BagError`."""
    try:
        yield
    except OSError as error:
        raise BagError(path, f"cannot be read: {error.strerror or error}") from error


def open_file(path: Path) -> BinaryIO:
    """Open a file for reading; of a URL only ranges are fetched, by fsspec."""
    options: dict[str, Any] = {"block_size": RANGE_BYTES, "cache_type": "blockcache"} if is_url(path) else {}
    return cast(BinaryIO, path.open("rb", **options))


@dataclass
class BagFiles:
    """The files of a bag, and what its metadata.yaml says.

    Attributes:
        files: in the order in which they were recorded.
        lost: those that cannot be read: listed in metadata.yaml and missing, or compressed as a whole.
        remarks: on what is not read or not used, a line each.
        notes: of our writer.
        custom_data: entries of others.
    """

    files: list[Path]
    lost: list[CorruptRegion] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    custom_data: dict[str, str] = field(default_factory=dict)


def find_bag_files(path: Path) -> BagFiles:
    """Return the files of a bag.

    Args:
        path: a file, or a folder with one or, where a recorder split the bag, several.

    Raises:
        BagError: there is no bag, or all of it is compressed.
    """
    try:
        path.stat()
        is_file = path.is_file()
        entries = [path] if is_file else sorted((file for file in path.iterdir() if file.is_file()), key=_by_number)
    except FileNotFoundError as error:
        raise BagError(path, "does not exist; expected an mcap file or the folder of a bag") from error
    except Exception as error:  # The file system of a URL raises whatever its library does.
        raise BagError(path, f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    files = {file.name: file for file in entries if file.suffix in STORAGE_SUFFIXES}
    names = [file.name for file in entries if file.name.endswith(COMPRESSED_SUFFIXES) and file.stem not in files]
    advice = "is compressed as a whole; decompress it first:"
    packed = {Path(name).stem: f"{advice} {UNPACKERS[Path(name).suffix]} {name}" for name in names}
    if packed and not files:
        raise BagError(path, next(iter(packed.values())))
    if is_file:
        return BagFiles([path])
    # Those of ROS 1 are named when they are opened.
    files = files or {file.name: file for file in entries if file.suffix == ".bag"}
    if not files:
        raise BagError(path, f"holds no {' or '.join(STORAGE_SUFFIXES)} file")
    bag = BagFiles([*files.values()], [CorruptRegion(name, 0, 0, packed[Path(name).stem]) for name in names])
    listed = [Path(name).stem if name.endswith(COMPRESSED_SUFFIXES) else name for name in _read_metadata(path, bag)]
    if any(name in files for name in listed):
        absent = [name for name in listed if name not in files and name not in packed]
        bag.lost += [CorruptRegion(name, 0, 0, "is missing") for name in absent]
        bag.remarks += [f"{name} is not read: {METADATA_FILE} does not list it" for name in files if name not in listed]
        bag.files = [files[name] for name in listed if name in files]
        return bag
    numbers = [_by_number(file) for file in bag.files]
    suffixes = sorted({file.suffix for file in bag.files}, reverse=True)
    if len(files) > 1 and (len(suffixes) * len({base for base, _, _ in numbers}) > 1 or min(numbers)[1] < 0):
        raise BagError(path, f"holds {len(files)} {' and '.join(suffixes)} files; name one of them")
    return bag


def _by_number(path: Path) -> tuple[str, int, str]:
    """Return a key that sorts files of a split bag as they were recorded: bag_2 before bag_10."""
    match = re.fullmatch(r"(.*?)_?(\d+)", path.stem)
    return (match[1], int(match[2]), path.name) if match else (path.stem, -1, path.name)


def _read_metadata(folder: Path, bag: BagFiles) -> list[str]:
    """Return the names of files in a bag's metadata.yaml; set notes and custom data, or why it is not used."""
    try:
        text = read_regular(folder / METADATA_FILE, MAX_TEXT_BYTES).decode("utf-8")
        if "<<" in text:
            raise ValueError("merged keys, which may double again and again")
        information = yaml.load(text, yaml.CSafeLoader)["rosbag2_bagfile_information"]
        names = list(dict.fromkeys(Path(name).name for name in information["relative_file_paths"]))
        custom = {key: text for key, text in (information.get("custom_data") or {}).items() if isinstance(text, str)}
        notes = {key.removeprefix(f"{NOTES}."): text for key, text in custom.items() if key.startswith(f"{NOTES}.")}
    except FileNotFoundError:
        return []
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError, yaml.YAMLError) as error:
        problem = getattr(error, "strerror", None) or "is not what rosbag2 writes"
        bag.remarks.append(f"{METADATA_FILE} is not used: {problem}")
        return []
    bag.notes = verified_notes(notes) or {}
    bag.custom_data = {key: text for key, text in custom.items() if not key.startswith(f"{NOTES}.")}
    return names


def add_checksum(notes: Mapping[str, str]) -> dict[str, str]:
    """Return notes with their checksum, to be written."""
    return {**notes, "crc32": f"{zlib.crc32(json.dumps(sorted(notes.items())).encode()):08x}"}


def verified_notes(entries: Mapping[str, str], *, data_verified: bool = False) -> dict[str, str] | None:
    """Return notes without their checksum; None where it is wrong.

    Args:
        entries: as they were read.
        data_verified: whether a checksum of the whole file is correct; then the notes need none of their own.
    """
    notes = {key: value for key, value in entries.items() if key != "crc32"}
    return notes if data_verified or entries == add_checksum(notes) else None


def parse_qos_profiles(text: str) -> list[dict[str, Any]]:
    """Return the profiles of a topic's publishers, their policies by name; none where they cannot be read.

    Up to Iron, policies were written by number. A reader that expects names cannot play such a topic.

    Args:
        text: YAML, as a recorder keeps it with a topic.
    """
    if len(text) >= 20_000 or "<<" in text:  # a publisher takes 400 characters; merged keys may double again and again
        return []
    try:
        return [{**profile} for profile in dump_qos_v9(parse_qos(text))]
    except Exception:  # The parser raises whatever the text makes it stumble over.
        return []


def jazzy_qos_profiles(text: str) -> str:
    """Return profiles as Jazzy keeps them with a topic, by name; the text itself where it does so or cannot be read."""
    profiles = parse_qos_profiles(text)
    if not profiles or yaml.load(text, yaml.CSafeLoader) == profiles:
        return text
    return yaml.safe_dump(profiles, sort_keys=False)
