"""The picture of a campaign, and why a run fails."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from magnetosuture_thread.commands.campaign import CampaignResult, draw_campaign
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.rig.campaign import RunFigures, RunInstant, RunResult
from magnetosuture_thread.rig.closed_loop import LoopFrame
from magnetosuture_thread.rig.setups import read_setup

GOOD = RunFigures(80.0, 75.0, 0.0003, 0.0, 0.4, 365.0, 1.5e-5, 12, -4.85e-4, -9988)


def instant(time: float, clearance: float = 0.004) -> RunInstant:
    """Return a instant with a needle at (1, 2) mm and a thread to the left of it."""
    thread = np.column_stack([np.linspace(0.001, -0.01, 5), np.full(5, 0.002)])
    frame = LoopFrame(time, thread[0], 0.0, thread, 1e-5, ThreadCondition(), np.array([0.002, 0.0]), "")
    axis = np.array([[0.001, 0.002], [0.0035, 0.002]])
    return RunInstant(frame, axis, clearance, 2, np.array([[0.0, 0.0], [0.01, 0.01]]))


def failed(seed: int, figures: RunFigures, reason: str, closest: RunInstant) -> RunResult:
    """Return a run that failed."""
    instants = tuple(instant(76.0 + 0.8 * k) for k in range(6))
    return RunResult(seed, False, reason, 2, figures, 82.0, instants, closest)


@pytest.mark.parametrize("failures", [0, 14])
def test_a_campaign_is_drawn_with_the_dish_of_each_failed_run(failures: int):
    close = replace(GOOD, min_needle_clearance_m=0.0002)
    runs = [RunResult(0, True, "", 5, GOOD, 81.0)]
    runs += [failed(seed, close, "too <close>", instant(20.0, 0.0002)) for seed in range(1, failures + 1)]
    result = CampaignResult(read_procedure("hernia"), read_setup("hernia_ring"), False, 0.02, runs)
    picture = imread(io.BytesIO(draw_campaign(result)), format="png")[..., :3]
    assert (np.abs(picture - np.array([0xC8, 0x10, 0x2E]) / 255).max(axis=2) < 0.05).any() == bool(failures)


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
