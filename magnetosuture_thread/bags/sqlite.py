"""Reads the files of a bag in sqlite3, the older format of rosbag2, which has no checksums.

A database may be anything: tables that compute their rows, trees that lead back to themselves, rows of gigabytes. Only
plain tables are read, within a number of steps that depends on the size of the file. A damaged one is refused: nothing
tells its altered messages from the others.
"""

from __future__ import annotations

import os
import sqlite3
import stat
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from magnetosuture_thread.bags.storage import (
    QOS,
    TYPE_HASH,
    Connection,
    DamageReport,
    MessageDefinition,
    StoredMessage,
)
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.files import is_url
from magnetosuture_thread.untrusted import MAX_BLOCK_BYTES

UNCHECKED = "has no checksums (sqlite3): damage to it cannot be noticed"
_ERRORS = (sqlite3.Error, OverflowError, UnicodeDecodeError)  # the last: in the words of an error about a damaged name
_MAGIC = b"SQLite format 3\0"
_MAX_TIME = (1 << 63) - 1
_LIMIT_LENGTH = 0  # SQLITE_LIMIT_LENGTH
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
    """A file of recorded messages in sqlite3; see `McapFile` for the attributes.

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
                magic = stream.read(len(_MAGIC))
        except OSError as error:
            raise BagError(path, f"cannot be read: {error.strerror or error}") from error
        if magic != _MAGIC:
            raise BagError(path, "is no sqlite3 file" if magic else "is empty, expected a sqlite3 file")
        self._max_steps = _MIN_STEPS + _STEPS_A_BYTE * size
        self.notes: dict[str, str] = {}
        self.unchecked = UNCHECKED
        self.others: Counter[str] = Counter()
        self.counts: dict[int, int] = {}
        self.damage: DamageReport | None = None
        try:
            with closing(self._connect()) as database:
                if (found := str(database.execute("PRAGMA integrity_check(1)").fetchone()[0])) != "ok":
                    raise self._damaged(found)
                self._check_tables(database)
                self.connections = _connections(database)
                self._count_messages(database)
        except (sqlite3.OperationalError, sqlite3.DataError) as error:  # no such table, or too much work: no damage
            raise BagError(path, f"cannot be read as a bag: {_reason_of(error)}") from None
        except sqlite3.DatabaseError as error:
            raise self._damaged(_reason_of(error)) from None
        except _ERRORS as error:
            raise BagError(path, f"cannot be read as a bag: {_reason_of(error)}") from None
        progress(size)
        self.facts = {"format": "sqlite3", "bytes": str(size), "checksums": "none"}

    def _check_tables(self, database: sqlite3.Connection) -> None:
        """Refuse a database whose tables are not those of rosbag2, but views or columns that compute what they hold."""
        for table, columns in _COLUMNS.items():
            kinds = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()
            if [kind for kind, _ in kinds] != ["table"] or "virtual" in str(kinds[0][1]).lower().split("(")[0]:
                raise BagError(self.path, f"has no table {table}, which the database of a bag has")
            found = {row[1]: row[6] for row in database.execute(f"PRAGMA table_xinfo({table})")}
            missing = next((name for name in columns if found.get(name) != 0), None)
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
                rows = database.execute(query, (*wanted, max(start, -_MAX_TIME), min(end, _MAX_TIME)))
                yield from (StoredMessage(time, self.connections[topic], data) for time, topic, data in rows)
        except _ERRORS as error:
            raise BagError(self.path, f"cannot be read any more: {_reason_of(error)}") from None

    def _connect(self) -> sqlite3.Connection:
        """Open the file read-only; nothing is written beside it either, unless a recorder left a journal."""
        names = [self.path.name + end for end in ("-wal", "-journal", "-shm")]
        sidecars = [path for name in names if (path := self.path.with_name(name)).exists()]
        for sidecar in sidecars:
            if not stat.S_ISREG(sidecar.stat().st_mode):
                raise BagError(sidecar, "is a folder, pipe or device, expected the journal of a database")
        journal = any(not path.name.endswith("-shm") for path in sidecars)
        mode = "mode=ro" if journal else "mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(os.fsencode(self.path.absolute()))}?{mode}", uri=True)
        database.text_factory = _decode_text
        if set_limit := getattr(database, "setlimit", None):  # from Python 3.11 on
            set_limit(_LIMIT_LENGTH, 2 * MAX_BLOCK_BYTES)
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
    """Return an error of sqlite3 in words."""
    if "interrupted" in str(error):
        return "reading it takes more steps than a recording of its size does"
    return " ".join(str(error).split())


def _connections(database: sqlite3.Connection) -> dict[int, Connection]:
    definitions = {}
    try:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        rows = database.execute(query)
        definitions = {row[0]: MessageDefinition(*row) for row in rows if all(isinstance(word, str) for word in row)}
    except _ERRORS:
        pass  # Older files have none.
    connections = {}
    database.row_factory = sqlite3.Row
    for row in database.execute("SELECT * FROM topics"):
        values = dict(row)
        number, topic, kind, form = (values.get(name) for name in ("id", "name", "type", "serialization_format"))
        if number in connections:
            raise sqlite3.DatabaseError("its table of topics leads back to itself")
        if isinstance(number, int) and isinstance(topic, str) and isinstance(kind, str) and isinstance(form, str):
            entries = {QOS: values.get("offered_qos_profiles"), TYPE_HASH: values.get("type_description_hash")}
            metadata = {key: text for key, text in entries.items() if isinstance(text, str)}
            connections[number] = Connection(topic, definitions.get(kind, MessageDefinition(kind)), form, metadata)
    database.row_factory = None
    return connections
