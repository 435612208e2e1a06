"""Reads bags: verifies the whole bag as it is opened, then yields its messages by time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

import zstandard

from magnetosuture_thread.bags import absolute_topic
from magnetosuture_thread.bags.mcap.file import McapFile
from magnetosuture_thread.bags.message_types import DecoderCache, MessageDecoder
from magnetosuture_thread.bags.sqlite import SqliteFile
from magnetosuture_thread.bags.storage import (
    CDR,
    UNCHECKED_NOTE,
    UNVERIFIED_NOTE,
    Connection,
    CorruptRegion,
    DamageReport,
    MessageDefinition,
    StoredMessage,
    find_bag_files,
    merge_by_time,
    merge_reports,
)
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.files import is_url
from magnetosuture_thread.untrusted import MAX_BLOCK_BYTES, UnpackBudget

Progress = Callable[[float], None]
BagStorage = McapFile | SqliteFile
_ZSTD = b"\x28\xb5\x2f\xfd"  # no CDR message begins like this: its first byte is 0
_OWN_DECODERS = DecoderCache()  # of messages of no bag


@dataclass(slots=True)  # not frozen, which would make creating one four times as slow
class RecordedMessage:
    """A recorded message; not to be changed.

    Attributes:
        topic: with its leading slash.
        type_name: for example `sensor_msgs/msg/Image`.
        time: when it was recorded [ns].
        data: CDR bytes.
        definition: of its type in the bag; ours if None.
        decoders: of the bag; None for a message of no bag.
    """

    topic: str
    type_name: str
    time: int
    data: bytes
    definition: MessageDefinition | None = field(default=None, repr=False, compare=False)
    decoders: DecoderCache | None = field(default=None, repr=False, compare=False)

    @property
    def decoder(self) -> MessageDecoder:
        """Decoder of messages of this type."""
        return (self.decoders or _OWN_DECODERS).decoder_of(self.definition or MessageDefinition(self.type_name))

    def decode(self) -> Any:
        """Return the message as an object of a type store.

        Raises:
            BagError: the bytes are not of the type, or the type is not known.
        """
        return self.decoder.decode(self.topic, self.data)


class Bag:
    """A recorded bag: mcap or sqlite3, one file or several, whole or damaged.

    All checksums are verified as it is opened, so that damage is known before any message is used. Intact data is read;
    data that may be wrong never is (see `bags/mcap/file.py` for the rule). Of a bag by URL, only what is read is
    fetched and verified, and reading ends with an error where it is damaged.

    Args:
        path: a file, or the folder of a bag, of this machine or as `files.parse_location` gives it for a URL.
        remap: new name of a topic by its recorded name.
        progress: called with the verified fraction, 0 to 1.

    Attributes:
        path: as it was given.
        topics: type of each topic, but for those in `conflicts`.
        conflicts: types of each topic that has more than one.
        counts: number of messages of each topic.
        start: time of the first message [ns].
        end: time of the last message [ns].
        duration: from the first to the last message [s].
        notes: notes of our writer.
        damage: what is corrupt and lost; None if the bag is intact. Its text is one line.
        unchecked: why damage may not have been noticed, in one line; empty if it would have been.
        unverified: why even what is read may be wrong, in one line; empty if nothing speaks against it. An earlier
            version salvaged such bags from damaged ones without checksums; their notes say so for good.
        remarks: on files of the bag that are not read, a line each.
        facts: properties of each file, for a person.
        decoders: of its messages; all its definitions are parsed within one budget.
        others: number of records that are neither messages nor ours, by kind.
        custom_data: entries of others in its metadata.yaml.

    Raises:
        BagError: there is no such bag, it cannot be read, holds nothing intact, or lacks a topic to remap.
    """

    def __init__(
        self, path: Path, *, remap: Mapping[str, str] | None = None, progress: Progress = lambda fraction: None
    ) -> None:
        self.path = path
        self.decoders = DecoderCache()
        found = find_bag_files(path)
        self._storages, problems = _open(found.files, progress)
        missing = [CorruptRegion(name, 0, 0, "it is missing") for name in found.missing]
        lost = [DamageReport((region,), 0, region.end, None) for region in (*missing, *problems)]
        self.damage = merge_reports([*(storage.damage for storage in self._storages), *lost])
        self.remarks, self.custom_data = found.remarks, found.custom_data
        self.facts = [{"file": storage.path.name, **storage.facts} for storage in self._storages]
        self.others = sum((storage.others for storage in self._storages), Counter[str]())
        self.notes = next((storage.notes for storage in self._storages if storage.notes), found.notes)
        self.unverified = self.notes.get(UNVERIFIED_NOTE, "")
        doubt = next((storage.unchecked for storage in self._storages if storage.unchecked), "")
        self.unchecked = doubt or self.notes.get(UNCHECKED_NOTE, "")
        if not any(storage.counts for storage in self._storages):
            raise BagError(found.files[0], f"{self.damage}; nothing intact" if self.damage else "holds no messages")
        filled = [storage for storage in self._storages if storage.counts]
        self.start = min(storage.start for storage in filled)
        self.end = max(storage.end for storage in filled)
        self.duration = (self.end - self.start) * 1e-9
        self._names = apply_remap(path, {connection.topic for connection in self.connections()}, remap or {})
        self.counts: Counter[str] = Counter()
        types: dict[str, dict[str, None]] = {}
        for storage in self._storages:
            for number, connection in storage.connections.items():
                name, count = self._names[connection.topic], storage.counts.get(number, 0)
                self.counts[name] += count
                types.setdefault(name, {})[connection.type_name] = None
        self.topics = {name: next(iter(own)) for name, own in types.items() if len(own) == 1}
        self.conflicts = {name: tuple(own) for name, own in types.items() if len(own) > 1}

    def records(
        self,
        topics: Collection[str] | None = None,
        *,
        start: float = 0.0,
        duration: float | None = None,
        refused: Counter[str] | None = None,
    ) -> Iterator[RecordedMessage]:
        """Yield the messages by time, with no more than some chunks in memory.

        Args:
            topics: only these; all that have one type if None. Those that the bag lacks give nothing.
            start: only messages from this time on [s since the bag's start].
            duration: only messages until this time after `start` [s]; all that follow if None.
            refused: counts the messages that cannot be decompressed or are not CDR, by reason; None to raise.

        Raises:
            BagError: one of the topics has two types, or the bag has changed since it was opened.
        """
        for topic in topics or ():
            if topic in self.conflicts:
                types = " and ".join(self.conflicts[topic])
                raise BagError(self.path, f"topic {topic} has two types, {types}; expected one")
        wanted = set(self.topics if topics is None else topics)
        loaded = (self._load(item, refused, only=CDR) for item in self._stored(wanted, start, duration))
        return (record for record in loaded if record is not None)

    def stored(self) -> Iterator[StoredMessage]:
        """Yield all messages by time as they are stored, whatever their type or serialization."""
        return self._stored(set(self.counts), 0.0, None)

    def load(self, item: StoredMessage) -> bytes:
        """Return a stored message as it was before the recorder packed it, if it did.

        Raises:
            BagError: it cannot be unpacked.
        """
        if item.connection.serialization != CDR or not item.data.startswith(_ZSTD):
            return item.data
        topic = self._names[item.connection.topic]
        try:
            if zstandard.frame_content_size(item.data) > MAX_BLOCK_BYTES:
                raise BagError(topic, f"a packed message is larger than {MAX_BLOCK_BYTES} bytes")
            # Without a size in it, a frame is unpacked to this many bytes at most.
            unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_BLOCK_BYTES)
            return unpacker.decompress(item.data, max_output_size=MAX_BLOCK_BYTES)
        except (zstandard.ZstdError, MemoryError) as error:
            raise BagError(topic, f"a packed message cannot be unpacked: {error}") from None

    def every_record(self, refused: Counter[str]) -> Iterator[tuple[Connection, RecordedMessage]]:
        """Yield all messages by time, each with its connection.

        Messages of topics with two types, and messages that are not CDR, are included.

        Args:
            refused: counts the messages that cannot be decompressed, by reason.
        """
        for item in self.stored():
            record = self._load(item, refused)
            if record is not None:
                yield item.connection, record

    def connections(self) -> list[Connection]:
        """Return the connections of all files, under their recorded names."""
        return [connection for storage in self._storages for connection in storage.connections.values()]

    def name_of(self, connection: Connection) -> str:
        """Return the remapped topic of a connection."""
        return self._names[connection.topic]

    def _load(self, item: StoredMessage, refused: Counter[str] | None, only: str = "") -> RecordedMessage | None:
        """Return a message; None, and count it, if it cannot be decompressed or has another serialization."""
        connection = item.connection
        topic = self._names[connection.topic]
        try:
            if only and connection.serialization != only:
                raise BagError(topic, f"its messages are written as {connection.serialization!r}, expected {only!r}")
            data = self.load(item)
        except BagError as error:
            if refused is None:
                raise
            refused[str(error)] += 1
            return None
        return RecordedMessage(topic, connection.type_name, item.time, data, connection.definition, self.decoders)

    def _stored(self, topics: Collection[str], start: float, duration: float | None) -> Iterator[StoredMessage]:
        first = self.start + round(start * 1e9)
        last = self.end if duration is None else first + round(duration * 1e9)
        parts = []
        for storage in sorted(self._storages, key=lambda storage: storage.start):
            wanted = [number for number, c in storage.connections.items() if self._names[c.topic] in topics]
            if wanted:
                parts.append((storage.start, partial(storage.messages, wanted, first, last)))
        return merge_by_time(parts)


def _open(files: list[Path], progress: Progress) -> tuple[list[BagStorage], list[CorruptRegion]]:
    """Open the files of a bag; of several, unreadable ones are returned as corrupt regions.

    Raises:
        BagError: none can be read, or one cannot be fetched: a network that fails is no damage.
    """
    storages: list[BagStorage] = []
    problems: list[CorruptRegion] = []
    cause: BaseException | None = None
    total, done = sum(_file_size(file) for file in files), 0
    budget = UnpackBudget(total)

    def report(count: int) -> None:
        nonlocal done
        done += count
        progress(min(1.0, done / max(total, 1)))

    for file in files:
        try:
            storages.append(SqliteFile(file, report) if file.suffix == ".db3" else McapFile(file, budget, report))
        except BagError as error:
            if len(files) == 1 or (is_url(file) and isinstance(error.__cause__, OSError)):
                raise
            problems.append(CorruptRegion(file.name, 0, _file_size(file), error.problem))
            cause = cause or error.__cause__
    if not storages:
        raise BagError(files[0].parent, f"holds no file that can be read; {problems[0]}") from cause
    return storages, problems


def _file_size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0


def apply_remap(path: Path, topics: Collection[str], remap: Mapping[str, str]) -> dict[str, str]:
    """Return the remapped name of each topic of a bag.

    Args:
        path: of the bag, for errors.
        topics: as they were recorded.
        remap: new name of a topic by its recorded name.

    Raises:
        BagError: the bag has no such topic, or another one has the new name already.
    """
    names = {topic: topic for topic in topics}
    for before, after in remap.items():
        known = [topic for topic in topics if absolute_topic(topic) == absolute_topic(before)]
        if not known:
            raise BagError(path, f"has no topic {absolute_topic(before)} to remap{_suggestion(before, topics)}")
        names[known[0]] = absolute_topic(after)
    sources: dict[str, list[str]] = {}
    for topic, name in sorted(names.items()):
        sources.setdefault(name, []).append(topic)
    for name, own in sources.items():
        if len(own) > 1 and name in own:
            other = next(topic for topic in own if topic != name)
            raise BagError(path, f"has {name} itself; {other} cannot be remapped to it without mixing the two")
        if len(own) > 1:
            raise BagError(path, f"{own[0]} and {own[1]} cannot both be remapped to {name}")
    return names


def _suggestion(topic: str, topics: Collection[str]) -> str:
    close = get_close_matches(absolute_topic(topic), topics, n=1)
    meant = f"; did you mean {close[0]}?" if close else ""
    return f"{meant}; its topics: {', '.join(sorted(topics)) or 'none'}"
