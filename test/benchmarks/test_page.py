"""The figures of the operator's page."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from benchmarks.page import KeyDelays, page_table


def test_each_key_is_answered_by_the_first_velocity_after_it():
    keys = [1.0, 2.0, 3.0, 5.0]
    moving = [1.010, 1.030, 1.050, 2.020, 2.040, 4.5, 5.9]  # nothing came of the third but late
    found = KeyDelays.between("the bridge", keys, moving)
    assert (found.count, found.lost) == (3, 1)
    assert found.median == pytest.approx(0.02)
    assert found.greatest == pytest.approx(0.9)
    assert KeyDelays.between("the bridge", [1.0, 2.0], [1.5]).lost == 1


def test_the_table_has_all_figures():
    console = Console(width=90, record=True, file=io.StringIO())
    console.print(page_table([KeyDelays("the filtered velocity at the bridge", 200, 1, 0.012, 0.031, 0.044)]))
    text = console.export_text()
    for figure in ("12.0", "31.0", "44.0", "200", "81", "simulated"):
        assert figure in text
