"""A bag's file in sqlite3, rosbag2's older format, which has no checksums."""

from __future__ import annotations

import os
import sqlite3
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from magnetosuture_thread.bags.damage import Damage, Place, counted
from magnetosuture_thread.bags.storage import Connection, Definition, Item
from magnetosuture_thread.errors import BagError

UNCHECKED = "has no checksums (sqlite3): damage to it cannot be noticed"
_MAGIC = b"SQLite format 3\0"
_STRIDE = 1 << 16  # rows that are left out at first where one cannot be read; then fewer and fewer
_OFFERED = {
    "offered_qos_profiles": "offered_qos_profiles",
    "topic_type_hash": "type_description_hash",
}  # column by word
_LARGEST_ROW = (1 << 63) - 1
# sqlite3 holds a column to no type, so that a row may have anything in it.
_USABLE = "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND timestamp >= 0 AND typeof(data) = 'blob'"


class SqliteFile:
    """A file of recorded messages in sqlite3; a `Storage`, where the attributes are told.

    Args:
        path: the file.
        progress: called with the number of bytes looked through since the last call.

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
        self._rows: list[tuple[int, int]] | None = None  # time and number of each that can be read, if not all can
        lost: int | None = None
        try:
            with closing(self._connect()) as database:
                self.connections = _connections(database)
                problem = _problem(database)
                if problem:
                    self._salvage(database)
                else:
                    lost = self._look_through(database)
        except sqlite3.Error as error:
            raise BagError(path, f"cannot be read as a bag: {error}") from None
        progress(size)
        if lost:
            problem = f"{counted(lost, 'row')} without a time, a topic or data that can be used"
        elif problem:
            problem = f"the database is malformed ({problem})"
        self.damage = Damage((Place(path.name, 0, size, problem),), 0, 0, lost) if problem else None
        self.facts = {"format": "sqlite3", "bytes": str(size), "checksums": "none"}

    def items(self, connections: Collection[int], start: int, end: int) -> Iterator[Item]:
        """Go through the messages of some connections from `start` to `end` [ns], both included, by time.

        Raises:
            BagError: the file has changed since it was looked through, or cannot be read any more.
        """
        wanted = sorted(set(connections) & set(self.counts))
        try:
            with closing(self._connect()) as database:
                if self._rows is None:
                    marks = ",".join("?" * len(wanted))
                    query = f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({marks})"
                    between = f" AND {_USABLE} AND timestamp BETWEEN ? AND ? ORDER BY timestamp, id"
                    rows = database.execute(query + between, (*wanted, start, end))
                    yield from (Item(time, self.connections[topic], data) for time, topic, data in rows)
                    return
                query = "SELECT timestamp, topic_id, data FROM messages WHERE id = ?"
                for time, number in self._rows:
                    if start <= time <= end:
                        for said, topic, data in database.execute(query, (number,)):
                            if topic in wanted:
                                yield Item(said, self.connections[topic], data)
        except sqlite3.Error as error:
            raise BagError(self.path, f"cannot be read any more: {error}") from None

    def _connect(self) -> sqlite3.Connection:
        """Open the file so that nothing is ever written, not even beside it, unless a recorder left a journal."""
        journal = any(self.path.with_name(self.path.name + ending).exists() for ending in ("-wal", "-journal"))
        mode = "mode=ro" if journal else "mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(os.fsencode(self.path.absolute()))}?{mode}", uri=True)
        database.text_factory = _text
        return database

    def _look_through(self, database: sqlite3.Connection) -> int:
        """Count what can be used, and return the number of rows that cannot."""
        query = f"SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages WHERE {_USABLE} GROUP BY 1"
        found = [row for row in database.execute(query) if row[0] in self.connections]
        self.counts = {row[0]: row[1] for row in found}
        self.start = min((row[2] for row in found), default=0)
        self.end = max((row[3] for row in found), default=0)
        (total,) = database.execute("SELECT COUNT(*) FROM messages").fetchone()
        return int(total) - sum(int(row[1]) for row in found)

    def _salvage(self, database: sqlite3.Connection) -> None:
        """Find the rows that can be read in a database that is broken."""
        times, numbers, counts = array("q"), array("q"), Counter[int]()
        for number, topic, time in _readable(database):
            if topic in self.connections:
                times.append(time)
                numbers.append(number)
                counts[topic] += 1
        self.counts = dict(counts)
        self._rows = sorted(zip(times, numbers, strict=True))
        self.start, self.end = (self._rows[0][0], self._rows[-1][0]) if self._rows else (0, 0)


def _text(data: bytes) -> str | None:
    """Return a text; None if it is none."""
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
        definitions = {row[0]: Definition(*row) for row in rows if all(isinstance(word, str) for word in row)}
    except sqlite3.Error:
        pass  # Older files have none.
    connections = {}
    cursor = database.execute("SELECT * FROM topics")
    names = [column[0] for column in cursor.description]
    for row in cursor:
        told = dict(zip(names, row, strict=True))
        number, topic, kind, form = (told[name] for name in ("id", "name", "type", "serialization_format"))
        if isinstance(number, int) and all(isinstance(word, str) for word in (topic, kind, form)):
            offered = {key: told.get(column) for key, column in _OFFERED.items()}
            words = {key: word for key, word in offered.items() if isinstance(word, str)}
            connections[number] = Connection(topic, definitions.get(kind, Definition(kind)), form, words)
    return connections


def _readable(database: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
    """Yield number, topic and time of each row that can be read whole; leave out those that cannot."""
    last, stride = 0, 0
    query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
    while last < _LARGEST_ROW:
        try:
            for number, topic, time, data in database.execute(query, (last,)):
                last, stride = number, 0
                if isinstance(data, bytes) and isinstance(topic, int) and isinstance(time, int) and time >= 0:
                    yield number, topic, time
            return
        except sqlite3.DatabaseError:
            # Row by row past the broken ones, then in greater and greater steps.
            stride = max(1, min(2 * stride, _LARGEST_ROW // 4))
            last += stride
