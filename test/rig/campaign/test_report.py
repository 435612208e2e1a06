"""The page of a campaign: pictures of failed runs, reasons, charts, and nothing loaded or run."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.commands.campaign import CampaignResult, write_page
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.rig.campaign import RunFigures, RunInstant, RunResult
from magnetosuture_thread.rig.closed_loop import LoopFrame
from magnetosuture_thread.rig.setups import read_setup

GOOD = RunFigures(80.0, 75.0, 0.0003, 0.0, 0.4, 365.0, 1.5e-5, 12, -4.85e-4, -9988)


def instant(time: float, clearance: float = 0.004, reason: str = "") -> RunInstant:
    """Return a instant with a needle at (1, 2) mm and a thread to the left of it."""
    thread = np.column_stack([np.linspace(0.001, -0.01, 5), np.full(5, 0.002)])
    frame = LoopFrame(time, thread[0], 0.0, thread, 1e-5, ThreadCondition(), np.array([0.002, 0.0]), reason)
    axis = np.array([[0.001, 0.002], [0.0035, 0.002]])
    return RunInstant(frame, axis, clearance, 2, np.array([[0.0, 0.0], [0.01, 0.01]]))


def failed(seed: int, figures: RunFigures, reason: str, closest: RunInstant) -> RunResult:
    """Return a run that failed."""
    instants = tuple(instant(76.0 + 0.8 * k) for k in range(6))
    return RunResult(seed, False, reason, False, 2, figures, 82.0, instants, closest)


def page_of(*runs: RunResult) -> str:
    """Return the page of a campaign of the hernia repair."""
    bags = {3: "bags/seed_3"}
    return write_page(CampaignResult(read_procedure("hernia"), read_setup("hernia_ring"), False, list(runs), {}, bags))


def test_each_failed_run_has_a_strip_of_its_last_seconds_and_of_its_closest_instant():
    close = failed(3, replace(GOOD, min_needle_clearance_m=0.0002), "too <close>", instant(20.0, 0.0002, "wall"))
    slow = failed(4, replace(GOOD, time_s=200.0), "too slow", instant(20.0, 0.0003))
    page = page_of(RunResult(2, True, "", True, 5, GOOD, 81.0), close, slow)
    assert re.findall(r'<article [^>]*id="([^"]+)"', page) == ["seed-3", "seed-4"]
    strips = page.split('<article class="run"')[1:]
    # The dish, six instants of the last seconds, in one of which the closest instant stands where it came earlier.
    assert [strip.count("<figure") for strip in strips] == [7, 7]
    times = [re.findall(r"<figcaption><b>([0-9.]+) s</b>", strip) for strip in strips]
    assert times[0] == ["80.00", "20.00", "76.80", "77.60", "78.40", "79.20", "80.00"]
    assert times[1] == ["80.00", "76.00", "76.80", "77.60", "78.40", "79.20", "80.00"]
    assert "at rest: wall" in strips[0]
    assert "too &lt;close&gt;" in page
    assert 'points="1.000,2.000 3.500,2.000"' in page  # the needle, in mm


def test_reasons_tiles_and_limits_follow_from_the_figures():
    close = failed(3, replace(GOOD, min_needle_clearance_m=0.0002), "", instant(79.0, 0.0002))
    page = page_of(RunResult(2, True, "", True, 5, GOOD, 81.0), close)
    assert re.search(r"came too close to wall or shape</th><td>1 of 2</td>", page)
    assert re.search(r"not all goals reached</th><td>1 of 2</td>", page)
    assert page.count(">1 of 2</span>") == 2  # tiles: succeeded, reached all goals
    assert re.findall(r'class="beyond">([^<]+)<', page) == ["0.200 mm"]
    assert '<td class="words">bags/seed_3</td>' in page


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("min_needle_clearance_m", {"min_needle_clearance_m": 0.00029}, "0.290 mm from wall or shape (0.295 allowed)"),
        ("max_thread_penetration_m", {"max_thread_penetration_m": 2e-6}, "2.0 µm in wall or shape"),
        ("longest_rest_s", {"longest_rest_s": 3.1}, "3.1 s (3 allowed)"),
        ("max_tension_n", {"max_tension_excess_n": 2e-5}, "0.02 mN above the limit of its goal"),
        ("max_friction_nodes", {"max_friction_excess": 3}, "3 more nodes under friction than its goal allows"),
        ("time_s", {"time_s": 113.0}, "113 s (112 allowed)"),
    ],
)
def test_a_figure_beyond_its_limit_is_named_with_what_is_allowed(name: str, change: dict[str, Any], words: str):
    assert GOOD.beyond_limits(0.0003) == {}
    found = replace(GOOD, **change).beyond_limits(0.0003)
    assert found.keys() == {name}
    assert words in found[name]


def test_the_page_loads_and_runs_nothing():
    page = page_of(RunResult(2, True, "", True, 5, GOOD, 81.0))
    assert not re.search(r"<(script|img|link|iframe|object)", page)
    assert all(link.startswith("#") for link in re.findall(r'(?:href|src)="([^"]*)"', page))
    assert "default-src 'none'" in page
    assert "Simulated:" in page
