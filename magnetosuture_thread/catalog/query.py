"""Queries on a catalog by DuckDB; needs the extra `cluster`, and little else, so that an answer comes soon."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import duckdb

from magnetosuture_thread.errors import BagError, ConfigurationError

SUFFIX = ".parquet"
MAX_RAM = "400MB"  # of DuckDB; beyond, it writes to the disk


def query_catalog(file: Path, sql: str, parameters: Sequence[Any] = ()) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Return the columns and rows that a query gives on the tables `bags` and `seconds`.

    Args:
        file: of the table of bags.
        sql: of DuckDB.
        parameters: in place of its question marks.

    Raises:
        BagError: there is no catalog.
        ConfigurationError: the query cannot be run.
    """
    tables = {"bags": file, "seconds": seconds_beside(file)}
    if not file.exists():
        raise BagError(file, "does not exist; `magnetosuture catalog ROOT --output FILE` makes it")
    with closing(connect(file)) as database:
        try:
            for name, table in tables.items():
                database.execute(f"CREATE VIEW {name} AS SELECT * FROM read_parquet({quoted(table)})")
            done = database.execute(sql, list(parameters))
            return [column[0] for column in done.description or ()], done.fetchall()
        except duckdb.Error as error:
            raise ConfigurationError("--query", sql, f"SQL of DuckDB ({' '.join(str(error).split())})") from None


def seconds_beside(file: Path) -> Path:
    """Return the file of the table of seconds, beside that of the table of bags.

    Raises:
        ConfigurationError: the name of the latter does not end as that of a Parquet file.
    """
    if file.suffix != SUFFIX:
        raise ConfigurationError("--output", str(file), f"a file that ends with {SUFFIX}")
    return file.with_suffix(f".seconds{SUFFIX}")


def connect(file: Path) -> duckdb.DuckDBPyConnection:
    """Return a database in memory, which spills to a folder beside a catalog."""
    spill = str(file.absolute().parent / f".{file.name}.spill")
    return duckdb.connect(config={"memory_limit": MAX_RAM, "temp_directory": spill})


def quoted(path: Path) -> str:
    """Return a path as a text of SQL."""
    return "'" + str(path).replace("'", "''") + "'"
