"""Tables of figures for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rich.table import Table


def figures_table(
    title: str, rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str], caption: str = ""
) -> Table:
    """Return a table with a row for each mapping of figures.

    Args:
        title: of the table.
        rows: the figures of each row by their keys.
        columns: how a cell is written, by the column's name: `{error_percent:.2f}` for example.
        caption: below it.
    """
    table = Table(title=title, caption=caption)
    for index, name in enumerate(columns):
        table.add_column(name, justify="right" if index else "left")
    for row in rows:
        table.add_row(*(cell.format(**row) for cell in columns.values()))
    return table
