"""The tables of a catalog: Parquet files, and a journal of the bags that were added since; needs the extra `cluster`.

A bag's figures are appended to the journal, a line of JSON, as soon as they are there. Whatever ends the process then,
the next one goes on from there; half a line at the end is cut off. At the end both tables are written anew, with what
the journal adds, and replace the old ones one after the other; then the journal is deleted. Until it is, all of this
can be done again with the same result.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import duckdb

from magnetosuture_thread.catalog.query import connect, quoted, seconds_beside
from magnetosuture_thread.catalog.series import COLUMNS, COUNTS
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.tables import failed_row, flat

MAX_LINE_BYTES = 1 << 25  # of the journal: some ten hours of one bag
WHOLE_NUMBERS = ("frames", "tracked", "predicted", "silences", "refused", "contact_frames", "recorded_at_ns", "bytes")
TEXTS = ("bag", "path", "problem", "least_added_m", "material", "scene", "version")
# What a catalog adds to the row of an evaluation; see `FACTS` of the reference.
FACTS = ("material", "thread_length_m", "segments", "scene", "dish_diameter_m", "recorded_at_ns", "bytes", "version")


def bag_columns() -> dict[str, str]:
    """Return the SQL type of each column of the table `bags`: those of an evaluation, and `FACTS`."""
    empty = flat(failed_row("", "", ""))
    return {name: _type(name, value) for name, value in {**empty, **dict.fromkeys(FACTS)}.items()}


def second_columns() -> dict[str, str]:
    """Return the SQL type of each column of the table `seconds`."""
    return {
        "path": "VARCHAR",
        "second": "BIGINT",
        **dict.fromkeys(COUNTS, "BIGINT"),
        **dict.fromkeys(COLUMNS, "DOUBLE"),
    }


def _type(name: str, value: object) -> str:
    if name in TEXTS or isinstance(value, str):
        return "VARCHAR"
    return "BIGINT" if name in WHOLE_NUMBERS or name.endswith("_frames") else "DOUBLE"


class Catalog:
    """The tables `bags` and `seconds` of a catalog.

    Args:
        file: of the table of bags (.parquet); that of seconds and the journal are beside it.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.seconds_file = seconds_beside(file)
        self.journal = file.with_suffix(".journal")

    def known(self) -> dict[str, str]:
        """Return the version of each bag that is in the tables or the journal, by its path.

        Raises:
            BagError: a file of the catalog cannot be read.
        """
        versions: dict[str, str] = {}
        self._repair_journal()
        with closing(connect(self.file)) as database:
            for table in self._tables(database):
                versions |= dict(self._run(database, f"SELECT path, version FROM {table}").fetchall())
        return versions

    def append(self, bag: Mapping[str, Any], seconds: Sequence[Mapping[str, Any]]) -> None:
        """Add a bag to the journal, at once.

        Args:
            bag: its row, by column.
            seconds: rows of its seconds, without the path.

        Raises:
            BagError: it cannot be written.
        """
        row = {name: bag.get(name) for name in bag_columns()}
        rows = [{"path": bag["path"], **second} for second in seconds]
        try:
            with self.journal.open("a", encoding="utf-8") as stream:
                line = {"at_byte": stream.tell(), "bag": row, "seconds": rows}
                stream.write(json.dumps(line, separators=(",", ":"), allow_nan=False) + "\n")
        except OSError as error:
            raise BagError(self.journal, f"cannot be written: {error.strerror or error}") from None

    def write(self, gone: Collection[str]) -> None:
        """Write both tables anew: with the bags of the journal, and without those that are gone.

        Args:
            gone: paths of bags that are in the tables no longer.

        Raises:
            BagError: a file cannot be read or written.
        """
        if not (gone or self.journal.exists() or not self.file.exists()):
            return
        self._repair_journal()
        with closing(connect(self.file)) as database:
            self._run(database, "CREATE TEMP TABLE gone AS SELECT unnest(?::VARCHAR[]) AS path", [sorted(gone)])
            self._load_journal(database)
            # The last line of a bag counts: it may have changed while its catalog was made.
            self._run(
                database, "CREATE TEMP TABLE fresh AS SELECT path, max(at_byte) AS at_byte FROM journal GROUP BY path"
            )
            replaced = "path IN (SELECT path FROM gone UNION ALL SELECT path FROM fresh)"
            added = "FROM journal SEMI JOIN fresh USING (path, at_byte) WHERE path NOT IN (SELECT path FROM gone)"
            for file, content, order in (
                (self.seconds_file, "unnest(seconds)", "path, second"),
                (self.file, "bag", "path"),
            ):
                name = "second" if file == self.seconds_file else "bag"
                select = f"SELECT {name}.* FROM (SELECT {content} AS {name} {added})"
                if file.exists():
                    old = f"SELECT * FROM read_parquet({quoted(file)}) WHERE NOT {replaced}"
                    select = f"({old}) UNION ALL BY NAME ({select})"
                partial = file.with_name(f".{file.name}.partial")
                options = "(FORMAT parquet, COMPRESSION zstd)"
                self._run(database, f"COPY (SELECT * FROM ({select}) ORDER BY {order}) TO {quoted(partial)} {options}")
        for file in (self.seconds_file, self.file):
            os.replace(file.with_name(f".{file.name}.partial"), file)
        self.journal.unlink(missing_ok=True)

    def _run(
        self, database: duckdb.DuckDBPyConnection, sql: str, parameters: Sequence[Any] = ()
    ) -> duckdb.DuckDBPyConnection:
        try:
            return database.execute(sql, list(parameters))
        except duckdb.Error as error:
            raise BagError(self.file, f"is no catalog that can be used: {str(error).strip().splitlines()[0]}") from None

    def _tables(self, database: duckdb.DuckDBPyConnection) -> Iterator[str]:
        """Yield what has the versions of bags, the latest last."""
        if self.file.exists():
            yield f"read_parquet({quoted(self.file)})"
        if self.journal.exists():
            self._load_journal(database)
            yield "(SELECT path, bag.version AS version FROM journal ORDER BY at_byte)"

    def _load_journal(self, database: duckdb.DuckDBPyConnection) -> None:
        """Make a view of the journal: where each line begins, path, bag and seconds."""
        bag, seconds = f"STRUCT({_fields(bag_columns())})", f"STRUCT({_fields(second_columns())})[]"
        read = f"SELECT 0::BIGINT AS at_byte, NULL::{bag} AS bag, NULL::{seconds} AS seconds LIMIT 0"
        if self.journal.exists() and self.journal.stat().st_size:
            columns = f"columns = {{at_byte: 'BIGINT', bag: '{bag}', seconds: '{seconds}'}}"
            options = f"format = 'newline_delimited', maximum_object_size = {MAX_LINE_BYTES}, {columns}"
            read = f"SELECT * FROM read_json({quoted(self.journal)}, {options})"
        self._run(database, f"CREATE OR REPLACE TEMP VIEW journal AS SELECT *, bag.path AS path FROM ({read})")

    def _repair_journal(self) -> None:
        """Cut off half a line at the end, of a process that was ended while it wrote."""
        if not self.journal.exists():
            return
        with self.journal.open("r+b") as stream:
            size = end = stream.seek(0, os.SEEK_END)
            while end:
                begin = max(0, end - (1 << 16))
                stream.seek(begin)
                found = stream.read(end - begin).rfind(b"\n")
                if found >= 0:
                    end = begin + found + 1
                    break
                end = begin
            if end < size:
                stream.truncate(end)


def _fields(columns: Mapping[str, str]) -> str:
    return ", ".join(f'"{name}" {kind}' for name, kind in columns.items())
