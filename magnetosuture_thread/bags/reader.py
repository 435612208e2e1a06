"""Reads bags, in mcap or sqlite3: verifies the whole bag as it is opened, then yields its messages by time."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import astuple, dataclass, field
from difflib import get_close_matches
from functools import cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import zstandard

from magnetosuture_thread.bags import absolute_topic, storage
from magnetosuture_thread.bags.mcap import McapFile
from magnetosuture_thread.bags.message_types import MessageDecoder
from magnetosuture_thread.bags.storage import CDR, Budget, Connection, CorruptRegion, DamageReport, MessageDefinition
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import HEAD_BYTES, is_url, substitute_problem

# Tables of rosbag2 with columns that are read. One that is no table, or computes a column, may hold anything.
_TABLES = {
    "topics": {"id", "name", "type", "serialization_format"},
    "messages": {"id", "topic_id", "timestamp", "data"},
    "message_definitions": set[str](),
}


class SqliteFile:
    """A file of recorded messages in sqlite3, the older format of rosbag2; see `McapFile` for the attributes.

    Only plain tables are read. A damaged one is refused: nothing tells its altered messages from the others.

    Args:
        path: the file.
        progress: called with the number of bytes read since the last call.

    Raises:
        BagError: it cannot be read, is empty, damaged, or no such file.
    """

    def __init__(self, path: Path, progress: Callable[[int], None] = lambda count: None) -> None:
        if is_url(path):
            raise BagError(path, "is a database, which is read on its own machine only; copy it to this machine")
        self.path = path
        self.notes: dict[str, str] = {}
        self.has_no_checksum = "has no checksums (sqlite3): damage to it cannot be noticed"
        self.others: Counter[str] = Counter()
        self.counts: dict[int, int] = {}
        self.damage: DamageReport | None = None
        with storage.refusing_unreadable(path), path.open("rb") as stream:
            size, head = path.stat().st_size, stream.read(HEAD_BYTES)
        if not head.startswith(b"SQLite format 3\0"):
            problem = substitute_problem(head) or "is no sqlite3 file"
            raise BagError(path, problem if head else "is empty, expected a sqlite3 file")
        try:
            with closing(self._connect()) as database:
                problem = str(database.execute("PRAGMA integrity_check(1)").fetchone()[0])
                if problem != "ok":
                    raise sqlite3.DatabaseError(problem)
                for table in _TABLES:
                    self._check_table(database, table)
                self.connections = _sqlite_connections(database)
                self._count_messages(database)
        except (sqlite3.OperationalError, OverflowError) as error:  # no such column, for example: no damage
            raise BagError(path, f"cannot be read as a bag: {_one_line(error)}") from None
        except sqlite3.Error as error:
            problem = f"is damaged ({_one_line(error)}), and has no checksums (sqlite3): nothing of it is used"
            raise BagError(path, problem) from None
        progress(size)
        self.facts = {"format": "sqlite3", "bytes": str(size), "checksums": "none"}

    def _connect(self) -> sqlite3.Connection:
        """Open the file read-only; nothing is written beside it either, unless a recorder left a journal."""
        journals = [self.path.with_name(self.path.name + end) for end in ("-wal", "-journal", "-shm")]
        if strange := next((path for path in journals if path.exists() and not path.is_file()), None):
            raise BagError(strange, "is a folder, pipe or device, expected the journal of a database")
        mode = "mode=ro" if any(path.exists() for path in journals[:2]) else "mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(bytes(self.path.absolute()))}?{mode}", uri=True)
        for pragma in ("trusted_schema=OFF", "query_only=ON", "cell_size_check=ON"):
            database.execute(f"PRAGMA {pragma}")
        return database

    def _check_table(self, database: sqlite3.Connection, table: str) -> None:
        """Refuse a table of rosbag2 that is a view or a virtual table, which has no page, or computes what it holds."""
        query, needed = "SELECT type, rootpage > 0 FROM sqlite_master WHERE name = ?", _TABLES[table]
        rows = database.execute(query, (table,)).fetchall()
        if rows != [("table", 1)] and (rows or needed):
            raise BagError(self.path, f"has no plain table {table}, which the database of a bag has")
        columns = {row[1]: row[6] for row in database.execute(f"PRAGMA table_xinfo({table})")}
        plain = {name for name, hidden in columns.items() if not hidden}
        if problem := ", ".join(sorted((needed - plain) | (columns.keys() - plain))):
            raise BagError(self.path, f"has no column {problem} in its table {table}, or one that is computed")

    def _count_messages(self, database: sqlite3.Connection) -> None:
        """Set counts and times, or refuse a row that has no valid ones: sqlite3 does not enforce column types."""
        query = """
            SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp), MAX(length(data)), SUM(timestamp >= 0
            AND typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND typeof(data) = 'blob')
            FROM messages GROUP BY topic_id
        """
        times: list[int] = []
        for topic, count, first, last, longest, valid in database.execute(query):
            if topic not in self.connections or valid < count:
                raise sqlite3.DatabaseError(f"{count} rows of which some have no valid time, topic or data")
            if longest > storage.MAX_RECORD_BYTES:
                problem = f"has a message of {longest} bytes; at most {storage.MAX_RECORD_BYTES} are read"
                raise BagError(self.path, problem)
            self.counts[topic] = count
            times += first, last
        self.start, self.end = min(times, default=0), max(times, default=0)

    def messages(self, connections: Collection[int], start: int, end: int) -> Iterator[storage.StoredMessage]:
        """Yield the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was verified, or cannot be read any more.
        """
        wanted = sorted(set(connections) & set(self.counts))
        where = f"topic_id IN ({','.join('?' * len(wanted))}) AND timestamp BETWEEN ? AND ?"
        query = f"SELECT timestamp, topic_id, data FROM messages WHERE {where} ORDER BY timestamp, id"
        try:
            with closing(self._connect()) as database:
                for time, topic, data in database.execute(query, (*wanted, max(start, self.start), min(end, self.end))):
                    yield storage.StoredMessage(time, self.connections[topic], data)
        except (sqlite3.Error, OverflowError) as error:
            raise BagError(self.path, f"cannot be read any more: {_one_line(error)}") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _sqlite_connections(database: sqlite3.Connection) -> dict[int, Connection]:
    """Return the connections; before Jazzy the table of topics had fewer columns, and there were no definitions."""
    database.row_factory = sqlite3.Row
    columns = {row["name"] for row in database.execute("PRAGMA table_info(message_definitions)")}
    rows = database.execute("SELECT * FROM message_definitions") if "encoded_message_definition" in columns else ()
    parts = "topic_type", "encoding", "encoded_message_definition"
    definitions = {row["topic_type"]: MessageDefinition(*(row[part] for part in parts)) for row in rows}
    connections = {}
    for row in map(dict[str, Any], database.execute("SELECT * FROM topics")):
        definition = definitions.get(row["type"]) or MessageDefinition(row["type"])
        metadata = {storage.QOS: row.get("offered_qos_profiles"), storage.TYPE_HASH: row.get("type_description_hash")}
        texts = {key: text for key, text in metadata.items() if isinstance(text, str)}
        connection = Connection(row["name"], definition, row["serialization_format"], texts)
        named = (connection.topic, connection.serialization, *astuple(definition))
        if isinstance(row["id"], int) and all(isinstance(text, str) for text in named):
            connections[row["id"]] = connection
    database.row_factory = None
    return connections


Progress = Callable[[float], None]
BagFile = McapFile | SqliteFile
DecoderOf = Callable[[MessageDefinition], MessageDecoder]


@dataclass(slots=True)  # not frozen, which would make creating one four times as slow
class RecordedMessage:
    """A recorded message; not to be changed.

    Attributes:
        topic: with its leading slash.
        type_name: for example `sensor_msgs/msg/Image`.
        time: when it was recorded [ns].
        data: CDR bytes.
        definition: of its type in the bag; ours if None.
        decoder_of: gives the bag's decoder of a definition.
    """

    topic: str
    type_name: str
    time: int
    data: bytes
    definition: MessageDefinition | None = field(default=None, repr=False, compare=False)
    decoder_of: DecoderOf = field(
        default=cache(partial(MessageDecoder, budget=Budget("messages", 0))), repr=False, compare=False
    )

    @property
    def decoder(self) -> MessageDecoder:
        """Decoder of messages of this type."""
        return self.decoder_of(self.definition or MessageDefinition(self.type_name))

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
        has_no_checksum: why damage may not have been noticed, in one line; empty if it would have been.
        salvaged_without_checksum: why even what is read may be wrong, in one line; empty if nothing speaks against it.
            An earlier version salvaged such bags from damaged ones without checksums; their notes say so for good.
        remarks: on files of the bag that are not read, a line each.
        facts: properties of each file, for a person.
        others: number of records that are neither messages nor ours, by kind.
        custom_data: entries of others in its metadata.yaml.

    Raises:
        BagError: there is no such bag, it cannot be read, holds nothing intact, or lacks a topic to remap.
    """

    def __init__(
        self, path: Path, *, remap: Mapping[str, str] | None = None, progress: Progress = lambda fraction: None
    ) -> None:
        self.path = path
        files = storage.find_bag_files(path)
        budget = Budget(path, sum(_file_size(file) for file in files.files))
        # Parses a definition once. Bags do not share it: whether one is still parsed depends on those before it.
        self._decoder_of = cache(partial(MessageDecoder, budget=budget))
        self._files, problems = _open(files.files, budget, progress)
        lost = [DamageReport((region,), 0, region.end, None) for region in (*files.lost, *problems)]
        self.damage = storage.merge_reports([*(file.damage for file in self._files), *lost])
        self.remarks, self.custom_data = files.remarks, files.custom_data
        self.facts = [{"file": file.path.name, **file.facts} for file in self._files]
        self.others = sum((file.others for file in self._files), Counter[str]())
        self.notes = next((file.notes for file in self._files if file.notes), files.notes)
        self.salvaged_without_checksum = self.notes.get("unverified", "")
        doubt = next((file.has_no_checksum for file in self._files if file.has_no_checksum), "")
        self.has_no_checksum = doubt or self.notes.get(storage.NO_CHECKSUM_NOTE, "")
        filled = [file for file in self._files if file.counts]
        if not filled:
            raise BagError(files.files[0], f"{self.damage}; nothing intact" if self.damage else "holds no messages")
        self.start = min(file.start for file in filled)
        self.end = max(file.end for file in filled)
        self.duration = (self.end - self.start) * 1e-9
        self._names = apply_remap(path, {connection.topic for connection in self.connections()}, remap or {})
        self.counts: Counter[str] = Counter()
        types: dict[str, dict[str, None]] = {}
        for file in self._files:
            for number, connection in file.connections.items():
                name = self._names[connection.topic]
                self.counts[name] += file.counts.get(number, 0)
                types.setdefault(name, {})[connection.type_name] = None
        self.topics = {name: next(iter(kinds)) for name, kinds in types.items() if len(kinds) == 1}
        self.conflicts = {name: tuple(kinds) for name, kinds in types.items() if len(kinds) > 1}

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
                raise BagError(self.path, self.conflict(topic))
        stored = self.stored(set(self.topics if topics is None else topics), start, duration)
        return (record for _, record in self._records(stored, refused, cdr_only=True))

    def conflict(self, topic: str) -> str:
        """Return in words that a topic has two types."""
        return f"topic {topic} has two types, {' and '.join(self.conflicts[topic])}; expected one"

    def stored(
        self, topics: Collection[str] | None = None, start: float = 0.0, duration: float | None = None
    ) -> Iterator[storage.StoredMessage]:
        """Yield messages by time as they are stored, whatever their type or serialization; see `records`."""
        wanted, first = set(self.counts) if topics is None else topics, self.start + round(start * 1e9)
        last = self.end if duration is None else first + round(duration * 1e9)
        parts = []
        for file in sorted(self._files, key=lambda file: file.start):
            numbers = [number for number, c in file.connections.items() if self._names[c.topic] in wanted]
            if numbers:
                parts.append((file.start, file.messages(numbers, first, last)))
        return storage.merge_by_time(parts)

    def load(self, item: storage.StoredMessage) -> bytes:
        """Return a stored message as it was before the recorder packed it, if it did.

        Raises:
            BagError: it cannot be unpacked.
        """
        # No CDR message begins as one of zstd does: its first byte is 0.
        if item.connection.serialization != CDR or not item.data.startswith(b"\x28\xb5\x2f\xfd"):
            return item.data
        try:
            return storage.unpack_zstd(item.data)
        except (zstandard.ZstdError, MemoryError) as error:
            topic = self._names[item.connection.topic]
            raise BagError(topic, f"a packed message cannot be unpacked: {error}") from None

    def every_record(self, refused: Counter[str]) -> Iterator[tuple[Connection, RecordedMessage]]:
        """Yield all messages by time with their connections, also of topics with two types, and that are not CDR.

        Args:
            refused: counts the messages that cannot be decompressed, by reason.
        """
        return self._records(self.stored(), refused)

    def connections(self) -> list[Connection]:
        """Return the connections of all files, under their recorded names."""
        return [connection for file in self._files for connection in file.connections.values()]

    def name_of(self, connection: Connection) -> str:
        """Return the remapped topic of a connection."""
        return self._names[connection.topic]

    def recorded_name(self, topic: str) -> str:
        """Return the name that a topic was recorded under."""
        return next(recorded for recorded, name in self._names.items() if name == topic)

    def _records(
        self, stored: Iterable[storage.StoredMessage], refused: Counter[str] | None, cdr_only: bool = False
    ) -> Iterator[tuple[Connection, RecordedMessage]]:
        """Yield messages; those that cannot be decompressed or have another serialization are counted, or raise."""
        for item in stored:
            kind, topic = item.connection, self._names[item.connection.topic]
            try:
                if cdr_only and kind.serialization != CDR:
                    raise BagError(topic, f"its messages are written as {kind.serialization!r}, expected {CDR!r}")
                data = self.load(item)
            except BagError as error:
                if refused is None:
                    raise
                refused[str(error)] += 1
                continue
            yield kind, RecordedMessage(topic, kind.type_name, item.time, data, kind.definition, self._decoder_of)


def _open(files: list[Path], budget: Budget, progress: Progress) -> tuple[list[BagFile], list[CorruptRegion]]:
    """Open the files of a bag; of several, unreadable ones are returned as corrupt regions.

    Raises:
        BagError: none can be read, or one cannot be fetched: a network that fails is no damage.
    """
    opened: list[BagFile] = []
    problems: list[CorruptRegion] = []
    cause: BaseException | None = None
    total, done = sum(map(_file_size, files)), 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(min(1.0, done / max(total, 1)))

    for file in files:
        try:
            opened.append(SqliteFile(file, advance) if file.suffix == ".db3" else McapFile(file, budget, advance))
        except BagError as error:
            if len(files) == 1 or (is_url(file) and isinstance(error.__cause__, OSError)):
                raise
            problems.append(CorruptRegion(file.name, 0, _file_size(file), error.problem))
            cause = cause or error.__cause__
    if not opened:
        raise BagError(files[0].parent, f"holds no file that can be read; {problems[0]}") from cause
    return opened, problems


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
