"""Tables of figures for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rich.table import Table

from magnetosuture_thread.commands.command import make_table


def figures_table(
    title: str, rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str], caption: str = ""
) -> Table:
    """Return a table with a row for each mapping of figures; `columns` has each column's cell, as `{error:.2f}`."""
    cells = [[cell.format(**row) for cell in columns.values()] for row in rows]
    return make_table(title, tuple(columns), cells, caption)
