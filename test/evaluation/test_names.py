"""No name of a bag reaches a table raw."""

from __future__ import annotations

from magnetosuture_thread.evaluation.tables import failed_row, flat, table_csv

NASTY = "a\x1b[31m\u202eb\x9b1m"


def test_tables_show_names_escaped():
    row = failed_row(NASTY, NASTY, NASTY)
    table = table_csv([row])
    assert len(flat(row)) == table.splitlines()[0].count(",") + 1
    assert not set(table) & {"\x1b", "\u202e", "\x9b"}
    assert r"\x1b" in table
