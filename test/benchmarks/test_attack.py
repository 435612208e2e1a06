"""The attack on bags: a few of each format, and that a broken promise would be noticed."""

from __future__ import annotations

import json
import time
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.__main__ import main
from benchmarks.attack import bags


def test_no_promise_is_broken_by_a_few_damaged_bags(tmp_path: Path):
    figures = tmp_path / "figures.json"
    code = main(["attack", "bags", "--count", "40", "--seed", "3", "--json", str(figures)])
    found = json.loads(figures.read_text())
    # Time depends on the machine, memory on the process that is forked: both are held in the documented run.
    assert code == 0 or all(line.endswith(("too_slow", "too_large")) for line in found["broken"])
    for own in (found["mcap"], found["sqlite3"]):
        assert own["bags"] == 20
        assert not any(own[promise] for promise in ("altered_as_sound", "silently_lost", "tracebacks"))


def test_a_reader_that_does_not_end_is_ended_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bags, "GRACE", -4.5)
    monkeypatch.setattr(bags, "_check", lambda bag, original: time.sleep(600.0))
    found, seconds, _ = bags.check_bag(tmp_path, Counter())
    assert found["ended"] == 1
    assert seconds < 60.0


@pytest.mark.slow
@pytest.mark.whole_graph
def test_no_node_ends_by_a_few_attacks(tmp_path: Path):
    figures = tmp_path / "figures.json"
    code = main(["attack", "nodes", "--count", "200", "--seed", "3", "--json", str(figures)])
    found = json.loads(figures.read_text())
    # How soon an answer comes, and whether the middleware loses one, depends on the machine too: see docs/results.md.
    late = [line for line in found["broken"] if "answers took longer" in line or "were not answered" in line]
    assert found["broken"] == late
    assert code == bool(late)
    assert found["ended"] == 0
    assert sum(found["sent"].values()) == 200
    assert min(found["sent"].values()) > 0
    assert all(found["answers"][name]["count"] > 3 for name in ("coil_bridge", "thread_model", "stop"))
