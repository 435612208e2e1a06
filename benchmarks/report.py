"""Tables of figures for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text


def figures_table(
    title: str, rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str], caption: str = ""
) -> Table:
    """Return a table with a row for each mapping of figures; `columns` has each column's cell, as `{error:.2f}`."""
    table = Table(title=title, caption=caption or None, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title_style="bold")
    for index, name in enumerate(columns):
        table.add_column(Text(name), justify="right" if index else "left")
    for row in rows:
        table.add_row(*(Text(cell.format(**row)) for cell in columns.values()))
    return table
