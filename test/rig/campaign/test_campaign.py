"""The closed loop without a graph: the same by its seed, other by another, and its command's files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import magnetosuture_thread.rig.campaign as campaign
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.cli import main
from magnetosuture_thread.commands.campaign import CampaignResult, draw_campaign
from magnetosuture_thread.commands.evaluate import evaluate_bags
from magnetosuture_thread.planning.procedure import Procedure, parse_procedure, read_procedure
from magnetosuture_thread.rig.campaign import RunResult, run_procedure, vary
from magnetosuture_thread.rig.closed_loop import LATENCY
from magnetosuture_thread.rig.setups import Setup, read_procedure_setup, read_setup

pytestmark = pytest.mark.slow

SHORT = {"goals": [{"go_to": {"position": [0.008, -0.0145], "tolerance": 1e-3}}], "setup": "hernia_ring"}


@pytest.fixture(scope="module")
def hernia() -> Setup:
    """Return the setup of the paper's hernia repair."""
    return read_setup("hernia_ring")


@pytest.fixture(scope="module")
def short() -> Procedure:
    """Return a procedure of one near place."""
    return parse_procedure(SHORT, "short")


@pytest.fixture(scope="module")
def first(hernia: Setup, short: Procedure) -> RunResult:
    """Return what came of it with seed 3."""
    return run_procedure(short, hernia, vary(hernia, 3))


def test_a_near_place_is_reached_by_the_whole_loop(first: RunResult):
    assert (first.success, first.reason) == (True, "")
    assert 0.0 < first.figures.ideal_time_s < first.figures.time_s < 1.5 * first.figures.ideal_time_s
    assert first.figures.min_needle_clearance_m > 1e-3
    assert (first.figures.max_thread_penetration_m, first.figures.wrap_degrees) == (0.0, 0.0)
    assert first.figures.max_tension_n > 0.0
    assert (first.last_instants, first.closest_instant) == ((), None)


def test_a_hernia_is_repaired_with_poses_that_come_late(hernia: Setup):
    found = run_procedure(read_procedure("hernia"), hernia, replace(vary(hernia, 703), latency=0.07))
    assert (found.success, found.reason) == (True, "")


def test_a_run_ends_at_a_fault_of_the_coil_bridge_and_names_it(hernia: Setup, short: Procedure):
    """All coils are connected the wrong way round, so that the needle moves oppositely."""
    drawn = vary(hernia, 3)
    reversed_gains = tuple(-gain for gain in drawn.setup.rig.coil_gains)
    reversed_rig = replace(drawn.setup, rig=replace(drawn.setup.rig, coil_gains=reversed_gains))
    result = run_procedure(short, hernia, replace(drawn, setup=reversed_rig.with_scene(hernia.scene)))
    assert not result.success
    assert result.reason.startswith("needle does not follow")
    assert result.simulated_s < 10.0


def test_a_rig_of_its_own_is_what_a_campaign_runs_on(short: Procedure, tmp_path: Path):
    file, truth, output = tmp_path / "short.yaml", tmp_path / "truth.yaml", tmp_path / "campaign"
    file.write_text(json.dumps(SHORT))
    truth.write_text("/**/rig_simulator: {ros__parameters: {coil_gains: [-1.0, -1.0, -1.0, -1.0]}}")
    assert main(["campaign", str(file), "--rig", str(truth), "--first-seed", "3", "--output", str(output)]) == 0
    (run,) = json.loads((output / "campaign.json").read_text())["runs"]
    assert run["reason"].startswith("needle does not follow")


def test_what_varies_stays_within_its_bounds_and_what_nodes_believe_does_not_vary(hernia: Setup):
    drawn = [vary(hernia, seed) for seed in range(40)]
    factors = np.array([each.setup.rig.viscosity / hernia.rig.viscosity for each in drawn])
    assert 0.7 <= factors.min() < 0.8 < 1.2 < factors.max() <= 1.3
    assert {each.setup.model for each in drawn} == {hernia.model}
    assert {each.setup.coils for each in drawn} == {hernia.coils}
    gains = np.array([each.setup.rig.coil_gains for each in drawn])
    assert np.abs(gains - 1.0).max() <= 0.05
    assert min(each.setup.rig.thread_friction for each in drawn) >= 0.0
    assert max(each.setup.rig.thread_friction for each in drawn) <= 0.3


def test_the_files_of_each_seed_do_not_depend_on_the_number_of_processes(
    tmp_path: Path, short: Procedure, hernia: Setup, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "short.yaml"
    file.write_text(json.dumps(SHORT))
    common = ["campaign", str(file), "--seeds", "2", "--first-seed", "3", "--bags", "4"]
    for workers in ("1", "2"):
        assert main([*common, "--workers", workers, "--output", str(tmp_path / workers)]) == 0
    assert "runs succeeded (simulated)" in capsys.readouterr().out
    content = json.loads((tmp_path / "1" / "campaign.json").read_text())
    assert content["simulated"] is True
    assert [run["seed"] for run in content["runs"]] == [3, 4]
    assert content["successes"] == sum(run["success"] for run in content["runs"])
    named = {"reason", "time_s", "ideal_time_s", "min_needle_clearance_m", "longest_rest_s", "wrap_degrees"}
    assert named <= set(content["runs"][0])
    assert main([*common, "--output", str(tmp_path / "1")]) == 1  # exists already
    for name in ("campaign.json", "campaign.csv", "campaign.png", "bags/seed_4/seed_4_0.mcap"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()
    bag = Bag(tmp_path / "1" / "bags" / "seed_4")
    assert bag.notes["simulated"].endswith("seed 4")
    alone = run_procedure(short, hernia, vary(hernia, 4))  # neither recording nor another process changes anything
    assert content["runs"][1] == alone.to_json()
    counts = {topic.rsplit("/", 1)[-1]: count for topic, count in bag.counts.items()}
    frames = round(alone.simulated_s * hernia.rig.frame_rate)
    assert abs(counts["needle"] - frames) <= 1
    assert 0.8 * frames < counts["measured_cp"] == counts["margins"] == counts["servo_cv"] <= counts["needle"]
    assert 0.8 * frames < counts["estimated"] <= counts["measured_cp"]
    capsys.readouterr()
    replayed = ["replay", "--offline", str(bag.path), "--duration", "2", "--output", str(tmp_path / "replayed")]
    assert main(replayed) == 0
    assert "estimate error, mean" in capsys.readouterr().out
    assert counts["thread_pull"] == counts["needle"]
    (row,) = evaluate_bags([bag.path], tmp_path / "evaluated", duration=4.0)
    (figures,) = json.loads((tmp_path / "evaluated" / "table.json").read_text())["bags"]
    assert figures["needle_pull_error_percent"] == row["needle_pull_error_percent"]
    assert figures["needle_pull_error_percent"] > 0.0


CLOSED = """
dish: {diameter: 0.05}
shapes: {ring: {annulus: {center: [0.0, 0.0], inner_radius: 0.006, outer_radius: 0.008}}}
"""


def test_a_place_without_a_way_is_refused_before_anything_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "closed.yaml").write_text(CLOSED)
    file = tmp_path / "inside.yaml"
    goals = "[{go_to: {position: [0.012, 0.0]}}, {go_to: {position: [0.0, 0.0]}}]"
    file.write_text(f"{{setup: dish_50mm, scene: closed.yaml, goals: {goals}}}\n")
    assert main(["campaign", str(file), "--output", str(tmp_path / "out")]) == 1
    assert "goals[1]: no way for the needle to go_to" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    # A run that begins all the same, as that of another seed might, ends at once.
    procedure = read_procedure(str(file))
    setup = read_procedure_setup(procedure)
    found = run_procedure(procedure, setup, vary(setup, 0))
    assert found.reason.startswith("goals[1]: no way for the needle to go_to")
    assert found.reason.count(";") == 0  # no time where there is no ideal one
    assert found.simulated_s < 1.0


def test_with_the_camera_the_tracker_measures(hernia: Setup, short: Procedure, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(campaign, "MAX_TIME", 1.5)
    found = run_procedure(short, hernia, vary(hernia, 3), camera=True)
    moved = [instant.frame.commanded.any() for instant in found.last_instants]
    assert any(moved)
    assert not moved[0]
    assert moved[-1], "the picture of a run that failed has an arrow"
    assert draw_campaign(CampaignResult(short, hernia, True, LATENCY, [found])).startswith(b"\x89PNG")
