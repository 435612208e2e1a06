"""The figures of the operator's page."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from benchmarks.page.report import KeyDelays, PageReport, page_lines, page_table


def test_each_key_is_answered_by_the_first_velocity_after_it():
    keys = [1.0, 2.0, 3.0, 5.0]
    moving = [1.010, 1.030, 1.050, 2.020, 2.040, 4.5, 5.9]  # nothing came of the third but late
    found = KeyDelays.between("the bridge", keys, moving)
    assert (found.count, found.lost) == (3, 1)
    assert found.median == pytest.approx(0.02)
    assert found.greatest == pytest.approx(0.9)


def test_the_last_key_may_be_without_an_answer():
    assert KeyDelays.between("the bridge", [1.0, 2.0], [1.5]).lost == 1


def test_the_table_tells_all():
    delays = KeyDelays("the filtered velocity at the bridge", 200, 1, 0.012, 0.031, 0.044)
    report = PageReport("petri_150mm_silk", 81, (delays,), 29.9, 30.0, 30.0)
    console = Console(width=90, record=True, file=io.StringIO())
    console.print(page_table(report))
    text = console.export_text()
    for figure in ("12.0", "31.0", "44.0", "200", "81", "simulated"):
        assert figure in text
    assert "29.9 pictures" in page_lines(report)[1]
    assert json.loads(json.dumps(report.to_json()))["delays"][0]["lost"] == 1
