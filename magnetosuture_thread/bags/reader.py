"""Reads bags, in mcap or sqlite3: verifies the whole bag as it is opened, then yields its messages by time."""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import zstandard

from magnetosuture_thread.bags import absolute_topic
from magnetosuture_thread.bags.budgets import MAX_BLOCK_BYTES, UnpackBudget
from magnetosuture_thread.bags.mcap import McapFile
from magnetosuture_thread.bags.message_types import DecoderCache, MessageDecoder
from magnetosuture_thread.bags.storage import (
    CDR,
    QOS,
    TYPE_HASH,
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
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import HEAD_BYTES, is_url, substitute_problem

_SQLITE_ERRORS = (sqlite3.Error, OverflowError, UnicodeDecodeError)  # the last: in the words of an error about a name
_STEP_INTERVAL = 10_000  # steps of sqlite's machine between two looks at the budget
_MIN_STEPS, _STEPS_A_BYTE = 20_000_000, 10  # a row takes about 20 steps, and 10 bytes or more
_COLUMNS = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
}
# sqlite3 does not enforce column types, so that a row may hold anything.
_IS_VALID = (
    "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND timestamp >= 0 AND typeof(data) = 'blob'"
)
_COUNT = f"""
    SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp), MAX(length(data)), SUM({_IS_VALID})
    FROM messages GROUP BY topic_id
"""


class SqliteFile:
    """A file of recorded messages in sqlite3, the older format of rosbag2; see `McapFile` for the attributes.

    A database may be anything: tables that compute their rows, trees that lead back to themselves, rows of gigabytes.
    Only plain tables are read, within a number of steps that depends on the size of the file. A damaged one is refused:
    nothing tells its altered messages from the others.

    Args:
        path: the file.
        progress: called with the number of bytes read since the last call.

    Raises:
        BagError: it cannot be read, is empty, damaged, or no such file.
    """

    def __init__(self, path: Path, progress: Callable[[int], None] = lambda count: None) -> None:
        self.path = path
        if is_url(path):
            raise BagError(path, "is a database, which is read on its own machine only; copy it to this machine")
        try:
            size = path.stat().st_size
            with path.open("rb") as stream:
                magic = stream.read(HEAD_BYTES)
        except OSError as error:
            raise BagError(path, f"cannot be read: {error.strerror or error}") from error
        if not magic.startswith(b"SQLite format 3\0"):
            problem = substitute_problem(magic) or "is no sqlite3 file"
            raise BagError(path, problem if magic else "is empty, expected a sqlite3 file")
        self._max_steps = _MIN_STEPS + _STEPS_A_BYTE * size
        self.notes: dict[str, str] = {}
        self.unchecked = "has no checksums (sqlite3): damage to it cannot be noticed"
        self.others: Counter[str] = Counter()
        self.counts: dict[int, int] = {}
        self.damage: DamageReport | None = None
        try:
            with closing(self._connect()) as database:
                if (found := str(database.execute("PRAGMA integrity_check(1)").fetchone()[0])) != "ok":
                    raise self._damaged(found)
                self._check_tables(database)
                self.connections = _sqlite_connections(database)
                self._count_messages(database)
        except _SQLITE_ERRORS as error:
            # An OperationalError or DataError is no damage: no such column, for example, or too much work.
            if isinstance(error, sqlite3.DatabaseError) and not isinstance(
                error, (sqlite3.OperationalError, sqlite3.DataError)
            ):
                raise self._damaged(_reason_of(error)) from None
            raise BagError(path, f"cannot be read as a bag: {_reason_of(error)}") from None
        progress(size)
        self.facts = {"format": "sqlite3", "bytes": str(size), "checksums": "none"}

    def _check_tables(self, database: sqlite3.Connection) -> None:
        """Refuse a database whose tables are not those of rosbag2, but views or columns that compute what they hold."""
        for table, columns in _COLUMNS.items():
            query = "SELECT type, rootpage > 0 FROM sqlite_master WHERE name = ?"  # a virtual table has no page
            if database.execute(query, (table,)).fetchall() != [("table", 1)]:
                raise BagError(self.path, f"has no plain table {table}, which the database of a bag has")
            hidden = {row[1]: row[6] for row in database.execute(f"PRAGMA table_xinfo({table})")}
            missing = next((name for name in columns if hidden.get(name) != 0), None)
            if missing is not None:
                raise BagError(self.path, f"has no column {missing} in its table {table}, or one that is computed")

    def _count_messages(self, database: sqlite3.Connection) -> None:
        lost = longest = 0
        times: list[int] = []
        for topic, count, first, last, size, valid in database.execute(_COUNT):
            if topic not in self.connections or valid < count:
                lost += count - (valid if topic in self.connections else 0)
                continue
            self.counts[topic] = count
            times += first, last
            longest = max(longest, size)
        if lost:
            raise self._damaged(f"{lost} rows without a valid time, topic or data")
        if longest > MAX_BLOCK_BYTES:
            raise BagError(self.path, f"has a message of {longest} bytes; at most {MAX_BLOCK_BYTES} are read")
        self.start, self.end = min(times, default=0), max(times, default=0)

    def _damaged(self, problem: str) -> BagError:
        words = " ".join(problem.split())
        return BagError(self.path, f"is damaged ({words}), and has no checksums (sqlite3): nothing of it is used")

    def messages(self, connections: Collection[int], start: int, end: int) -> Iterator[StoredMessage]:
        """Yield the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was verified, or cannot be read any more.
        """
        wanted = sorted(set(connections) & set(self.counts))
        try:
            with closing(self._connect()) as database:
                marks = ",".join("?" * len(wanted))
                query = (
                    f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({marks})"
                    f" AND {_IS_VALID} AND timestamp BETWEEN ? AND ? ORDER BY timestamp, id"
                )
                rows = database.execute(query, (*wanted, max(start, self.start), min(end, self.end)))
                yield from (StoredMessage(time, self.connections[topic], data) for time, topic, data in rows)
        except _SQLITE_ERRORS as error:
            raise BagError(self.path, f"cannot be read any more: {_reason_of(error)}") from None

    def _connect(self) -> sqlite3.Connection:
        """Open the file read-only; nothing is written beside it either, unless a recorder left a journal."""
        journals = [self.path.with_name(self.path.name + end) for end in ("-wal", "-journal", "-shm")]
        for journal in journals:
            if journal.exists() and not journal.is_file():
                raise BagError(journal, "is a folder, pipe or device, expected the journal of a database")
        has_journal = any(journal.exists() for journal in journals[:2])
        mode = "mode=ro" if has_journal else "mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(os.fsencode(self.path.absolute()))}?{mode}", uri=True)
        database.text_factory = _decode_text
        if set_limit := getattr(database, "setlimit", None):  # from Python 3.11 on
            set_limit(0, 2 * MAX_BLOCK_BYTES)  # SQLITE_LIMIT_LENGTH
        left = self._max_steps

        def step() -> int:
            nonlocal left
            left -= _STEP_INTERVAL
            return int(left < 0)

        database.set_progress_handler(step, _STEP_INTERVAL)
        for pragma in ("trusted_schema=OFF", "query_only=ON", "cell_size_check=ON"):
            database.execute(f"PRAGMA {pragma}")
        return database


def _decode_text(data: bytes) -> str | None:
    """Return a text; None if it is not valid UTF-8."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return None


def _reason_of(error: Exception) -> str:
    """Return an error of sqlite3 in one line."""
    if "interrupted" in str(error):
        return "reading it takes more steps than a recording of its size does"
    return " ".join(str(error).split())


def _sqlite_connections(database: sqlite3.Connection) -> dict[int, Connection]:
    definitions = {}
    with suppress(*_SQLITE_ERRORS):  # Older files have none.
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        rows = database.execute(query)
        definitions = {row[0]: MessageDefinition(*row) for row in rows if all(isinstance(word, str) for word in row)}
    connections = {}
    rows = database.execute("SELECT * FROM topics")
    names = [column[0] for column in rows.description]
    for row in rows:
        values = dict(zip(names, row, strict=True))
        number, topic, kind, form = (values.get(name) for name in ("id", "name", "type", "serialization_format"))
        if number in connections:
            raise sqlite3.DatabaseError("its table of topics leads back to itself")
        if isinstance(number, int) and isinstance(topic, str) and isinstance(kind, str) and isinstance(form, str):
            entries = {QOS: values.get("offered_qos_profiles"), TYPE_HASH: values.get("type_description_hash")}
            metadata = {key: text for key, text in entries.items() if isinstance(text, str)}
            connections[number] = Connection(topic, definitions.get(kind, MessageDefinition(kind)), form, metadata)
    return connections


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
    data that may be wrong never is (see `bags/mcap.py` for the rule). Of a bag by URL, only what is read is
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

    def recorded_name(self, topic: str) -> str:
        """Return the name that a topic was recorded under."""
        return next(recorded for recorded, name in self._names.items() if name == topic)

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
            close = get_close_matches(absolute_topic(before), topics, n=1)
            meant = f"; did you mean {close[0]}?" if close else ""
            its = ", ".join(sorted(topics)) or "none"
            raise BagError(path, f"has no topic {absolute_topic(before)} to remap{meant}; its topics: {its}")
        names[known[0]] = absolute_topic(after)
    sources: dict[str, str] = {}
    for topic, name in sorted(names.items()):
        if name in sources:
            raise BagError(path, f"{sources[name]} and {topic} cannot both be {name}: their messages would be mixed")
        sources[name] = topic
    return names
