"""Reads the files of a bag in sqlite3, the older format of rosbag2, which has no checksums."""

from __future__ import annotations

import os
import sqlite3
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from magnetosuture_thread.bags.storage import (
    Connection,
    CorruptRegion,
    DamageReport,
    MessageDefinition,
    StoredMessage,
    pluralize,
)
from magnetosuture_thread.errors import BagError

UNCHECKED = "has no checksums (sqlite3): damage to it cannot be noticed"
_MAGIC = b"SQLite format 3\0"
_METADATA_COLUMNS = {
    "offered_qos_profiles": "offered_qos_profiles",
    "topic_type_hash": "type_description_hash",
}  # by metadata key
_MAX_ROW_ID = (1 << 63) - 1
# sqlite3 does not enforce column types, so that a row may hold anything.
_IS_VALID = (
    "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND timestamp >= 0 AND typeof(data) = 'blob'"
)


class SqliteFile:
    """A file of recorded messages in sqlite3; implements `BagStorage`, where the attributes are described.

    Args:
        path: the file.
        progress: called with the number of bytes read since the last call.

    Raises:
        BagError: it cannot be read, is empty, or is no such file.
    """

    def __init__(self, path: Path, progress: Callable[[int], None] = lambda count: None) -> None:
        self.path = path
        try:
            size = path.stat().st_size
            with path.open("rb") as stream:
                magic = stream.read(len(_MAGIC))
        except OSError as error:
            raise BagError(path, f"cannot be read: {error.strerror or error}") from None
        if magic != _MAGIC:
            raise BagError(path, "is no sqlite3 file" if magic else "is empty, expected a sqlite3 file")
        self.notes: dict[str, str] = {}
        self.unchecked = UNCHECKED
        self._rows: list[tuple[int, int]] | None = None  # time and id of each readable row, if not all are readable
        lost: int | None = None
        try:
            with closing(self._connect()) as database:
                self.connections = _connections(database)
                problem = _problem(database)
                if problem:
                    self._salvage(database)
                else:
                    lost = self._count_messages(database)
        except sqlite3.Error as error:
            raise BagError(path, f"cannot be read as a bag: {error}") from None
        progress(size)
        if lost:
            problem = f"{pluralize(lost, 'row')} without a valid time, topic or data"
        elif problem:
            problem = f"the database is malformed ({problem})"
        self.damage = DamageReport((CorruptRegion(path.name, 0, size, problem),), 0, 0, lost) if problem else None
        self.facts = {"format": "sqlite3", "bytes": str(size), "checksums": "none"}

    def messages(self, connections: Collection[int], start: int, end: int) -> Iterator[StoredMessage]:
        """Yield the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was verified, or cannot be read any more.
        """
        wanted = sorted(set(connections) & set(self.counts))
        try:
            with closing(self._connect()) as database:
                if self._rows is None:
                    marks = ",".join("?" * len(wanted))
                    query = f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({marks})"
                    between = f" AND {_IS_VALID} AND timestamp BETWEEN ? AND ? ORDER BY timestamp, id"
                    rows = database.execute(query + between, (*wanted, start, end))
                    yield from (StoredMessage(time, self.connections[topic], data) for time, topic, data in rows)
                    return
                query = "SELECT timestamp, topic_id, data FROM messages WHERE id = ?"
                for time, number in self._rows:
                    if start <= time <= end:
                        for stored_time, topic, data in database.execute(query, (number,)):
                            if topic in wanted:
                                yield StoredMessage(stored_time, self.connections[topic], data)
        except sqlite3.Error as error:
            raise BagError(self.path, f"cannot be read any more: {error}") from None

    def _connect(self) -> sqlite3.Connection:
        """Open the file read-only; nothing is written beside it either, unless a recorder left a journal."""
        journal = any(self.path.with_name(self.path.name + ending).exists() for ending in ("-wal", "-journal"))
        mode = "mode=ro" if journal else "mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(os.fsencode(self.path.absolute()))}?{mode}", uri=True)
        database.text_factory = _decode_text
        return database

    def _count_messages(self, database: sqlite3.Connection) -> int:
        """Count the valid messages, and return the number of invalid rows."""
        query = f"SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages WHERE {_IS_VALID} GROUP BY 1"
        found = [row for row in database.execute(query) if row[0] in self.connections]
        self.counts = {row[0]: row[1] for row in found}
        self.start = min((row[2] for row in found), default=0)
        self.end = max((row[3] for row in found), default=0)
        (total,) = database.execute("SELECT COUNT(*) FROM messages").fetchone()
        return int(total) - sum(int(row[1]) for row in found)

    def _salvage(self, database: sqlite3.Connection) -> None:
        """Find the readable rows of a malformed database."""
        times, numbers, counts = array("q"), array("q"), Counter[int]()
        for number, topic, time in _readable_rows(database):
            if topic in self.connections:
                times.append(time)
                numbers.append(number)
                counts[topic] += 1
        self.counts = dict(counts)
        self._rows = sorted(zip(times, numbers, strict=True))
        self.start, self.end = (self._rows[0][0], self._rows[-1][0]) if self._rows else (0, 0)


def _decode_text(data: bytes) -> str | None:
    """Return a text; None if it is not valid UTF-8."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return None


def _problem(database: sqlite3.Connection) -> str:
    """Return what is malformed; empty if nothing is."""
    try:
        found = str(database.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.DatabaseError as error:
        return str(error)
    return "" if found == "ok" else " ".join(found.split())


def _connections(database: sqlite3.Connection) -> dict[int, Connection]:
    definitions = {}
    try:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        rows = database.execute(query)
        definitions = {row[0]: MessageDefinition(*row) for row in rows if all(isinstance(word, str) for word in row)}
    except sqlite3.Error:
        pass  # Older files have none.
    connections = {}
    cursor = database.execute("SELECT * FROM topics")
    names = [column[0] for column in cursor.description]
    for row in cursor:
        values = dict(zip(names, row, strict=True))
        number, topic, kind, form = (values[name] for name in ("id", "name", "type", "serialization_format"))
        if isinstance(number, int) and all(isinstance(word, str) for word in (topic, kind, form)):
            entries = {key: values.get(column) for key, column in _METADATA_COLUMNS.items()}
            metadata = {key: text for key, text in entries.items() if isinstance(text, str)}
            connections[number] = Connection(topic, definitions.get(kind, MessageDefinition(kind)), form, metadata)
    return connections


def _readable_rows(database: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
    """Yield id, topic and time of each row that is fully readable."""
    last, stride = 0, 0
    query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
    while last < _MAX_ROW_ID:
        try:
            for number, topic, time, data in database.execute(query, (last,)):
                last, stride = number, 0
                if isinstance(data, bytes) and isinstance(topic, int) and isinstance(time, int) and time >= 0:
                    yield number, topic, time
            return
        except sqlite3.DatabaseError:
            # Skip row by row past the unreadable ones, then in growing steps.
            stride = max(1, min(2 * stride, _MAX_ROW_ID // 4))
            last += stride
