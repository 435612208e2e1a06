"""A procedure in the whole graph: the needle planner in place of the path follower."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.interface import NEEDLE_COMMAND, PROCEDURE_PLAN, PROCEDURE_STATE, SCENE, TIP_SETPOINT
from magnetosuture_thread.jobs.simulate import SUMMARY_FILE, simulate
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.scene import read_scene

SETUP = """
/**: {ros__parameters: {scene: dish_35mm}}
/**/rig_simulator:
  ros__parameters: {needle_start: [0.003, -0.002, 0.0], thread_segments: 30, frame_rate: 20.0}
"""
NEAR = """
scene: dish_35mm_post
limits: {speed: 0.003}
goals: [{go_to: {position: [0.009, -0.003], tolerance: 0.003}}]
"""


@pytest.fixture
def setup(tmp_path: Path) -> str:
    """Return the file of a setup without a path for the needle."""
    path = tmp_path / "open.yaml"
    path.write_text(SETUP)
    return str(path)


@pytest.mark.whole_graph
def test_the_needle_reaches_the_goals_and_the_summary_has_the_result(setup: str, tmp_path: Path):
    (tmp_path / "near.yaml").write_text(NEAR)
    output = tmp_path / "bag"
    summary = simulate(setup, output, rate=0.5, procedure=str(tmp_path / "near.yaml"))
    assert summary.procedure is not None
    assert (summary.procedure["state"], summary.procedure["goals_met"]) == ("done", 1)
    assert summary.procedure["min_clearance_m"] > 5e-4
    assert json.loads((output / SUMMARY_FILE).read_text())["procedure"] == summary.procedure
    bag = Bag(output)
    scenes = {parse_scene_message(record.decode()).version for record in bag.records({SCENE.recorded})}
    assert scenes == {read_scene("dish_35mm_post").version}  # the procedure's, in place of the setup's
    counts = bag.counts
    assert counts[PROCEDURE_STATE.recorded] > 5
    assert counts[PROCEDURE_PLAN.recorded] >= 1
    assert counts[NEEDLE_COMMAND.recorded] > 10
    assert counts[TIP_SETPOINT.recorded] > 10


@pytest.mark.parametrize(
    ("procedure", "reason"),
    [
        ("no_such_procedure", "expected a YAML file, or one of"),
        ("hernia", r"goals\[0\]\.pass_through\.between"),
    ],
)
def test_a_procedure_that_does_not_fit_the_scene_is_refused_before_anything_starts(
    setup: str, tmp_path: Path, procedure: str, reason: str
):
    with pytest.raises(ConfigurationError, match=reason):
        simulate(setup, tmp_path / "bag", procedure=procedure)
    assert not (tmp_path / "bag").exists()
