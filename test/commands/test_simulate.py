"""The whole graph around a simulated rig: nodes in processes of their own, everything recorded."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import cv2
import numpy as np
import pytest
from std_srvs.srv import Trigger

from benchmarks.page import running
from magnetosuture_thread import replay_offline
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import parse_scene_message
from magnetosuture_thread.cli import main
from magnetosuture_thread.commands import reproduce
from magnetosuture_thread.commands import simulate as simulate_command
from magnetosuture_thread.commands.simulate import SUMMARY_FILE, host_rig, simulate
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.nodes.clients import Participant, Services
from magnetosuture_thread.settings.errors import ConfigurationError, GraphError
from magnetosuture_thread.settings.interface import (
    NEEDLE_COMMAND,
    PROCEDURE_PLAN,
    PROCEDURE_STATE,
    SCENE,
    TIP_SETPOINT,
    Service,
)
from test.shared import wait_until

pytestmark = pytest.mark.whole_graph


SHORT = """
/**: {ros__parameters: {scene: dish_35mm}}
/**/rig_simulator:
  ros__parameters:
    needle_start: [0.004, 0.0, 0.0]
    thread_segments: 30
    frame_rate: 30.0
FAULTS
/**/path_follower:
  ros__parameters:
    waypoints: [0.0125, 0.0035]
"""
OPEN = """
/**: {ros__parameters: {scene: dish_35mm}}
/**/rig_simulator:
  ros__parameters: {needle_start: [0.003, -0.002, 0.0], thread_segments: 30, frame_rate: 20.0}
"""
NEAR = """
scene: dish_35mm_post
limits: {speed: 0.003}
goals: [{go_to: {position: [0.009, -0.003], tolerance: 0.003}}]
"""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scenario of one second."""
    path = tmp_path_factory.mktemp("scenario") / "short.yaml"
    path.write_text(SHORT.replace("FAULTS", ""))
    return path


@pytest.fixture(scope="module")
def run(scenario: Path, tmp_path_factory: pytest.TempPathFactory):
    """Run it at half the speed, for busy machines; return the bag, the figures and the progress."""
    bag = tmp_path_factory.mktemp("run") / "bag"
    shares: list[float] = []
    summary = simulate(str(scenario), bag, rate=0.5, progress=shares.append)
    return bag, summary, shares


def test_the_needle_follows_its_path_and_the_thread_is_predicted(run):
    _, summary, shares = run
    assert summary.setup == "short"
    assert summary.frames >= 20
    assert summary.tracked >= 0.9 * summary.frames
    assert summary.wrong == 0
    assert summary.predicted >= 0.9 * summary.tracked
    assert summary.tail_error < 8e-5
    assert summary.path_error < 2e-3  # how well is for a quiet machine to say
    assert summary.error_truth is not None
    assert summary.error_truth["mean"] < 2.0
    assert shares[-1] == 1.0


def test_a_rig_of_its_own_is_what_the_graph_runs_on(scenario: Path, tmp_path: Path):
    truth = tmp_path / "truth.yaml"
    truth.write_text("/**/rig_simulator: {ros__parameters: {coil_gains: [-1.0, -1.0, -1.0, -1.0]}}")
    with pytest.raises(GraphError, match="needle does not follow"):
        simulate(str(scenario), tmp_path / "bag", rate=0.5, rig=str(truth))


def test_the_bag_holds_everything_says_that_it_is_simulated_and_is_replayed(run, scenario: Path, tmp_path: Path):
    bag = Bag(run[0])
    assert bag.damage is None
    assert "whole rig" in bag.notes["simulated"]
    for topic in (
        *("/camera/image_raw/compressed", "/camera/camera_info", "/ground_truth/needle", "/ground_truth/thread"),
        *("/needle/measured_cp", "/needle/tracker_state", "/needle/servo_cv", "/needle/setpoint_cp", "/coils/currents"),
        *("/thread/measured", "/thread/predicted", "/thread/margins", "/thread/markers", "/scene", "/diagnostics"),
    ):
        assert bag.counts[topic] > 0, topic
    (scene,) = bag.records({"/scene"})
    assert parse_scene_message(scene.decode()) == read_scene("dish_35mm")
    assert scene.time == bag.start
    first = min(record.time for record in bag.records({"/ground_truth/needle"}))
    assert first - bag.start < 0.5e9  # the nodes' start is not in it
    scenario.rename(scenario.with_suffix(".gone"))  # the bag must know it by itself
    try:
        summary = replay_offline(run[0], tmp_path / "out")
    finally:
        scenario.with_suffix(".gone").rename(scenario)
    assert summary.setup == "short"
    assert summary.tracked >= 0.9 * summary.frames


def test_thread_behavior_draws_each_scenario(run, scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What is drawn is a run of the whole graph: the one that was recorded above."""

    def recorded(setup: str, output: Path, **_: Any) -> None:
        assert setup == str(scenario)
        shutil.copytree(run[0], output)

    monkeypatch.setattr(reproduce, "simulate", create_autospec(simulate, side_effect=recorded))
    runs = reproduce.thread_behavior(tmp_path / "out", [str(scenario)])
    assert [each.summary.error_truth for each in runs] == [run[1].error_truth]
    assert cv2.imread(str(tmp_path / "out" / "behaviour.png")) is not None
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["behaviour.json", "behaviour.png", "short"]


@pytest.mark.parametrize("procedure", ["", NEAR])
def test_a_run_whose_bridge_is_stopped_ends_with_the_reason(scenario: Path, tmp_path: Path, procedure: str):
    """The emergency stop is pressed from another process than the bridge's, as the run begins."""
    file, bag = tmp_path / "near.yaml", tmp_path / "bag"
    file.write_text(procedure)

    def log(text: str) -> None:
        if text == "running":
            assert main(["coils", "stop"]) == 0

    with pytest.raises(GraphError, match="coil_bridge: fault: emergency stop"):
        simulate(str(scenario), bag, log=log, procedure=str(file) if procedure else "")
    if procedure:
        outcome = json.loads((bag / SUMMARY_FILE).read_text())["procedure"]
        assert outcome["state"] == "not begun"
        assert outcome["reason"].startswith("coil_bridge: fault: emergency stop")
    states = [record.decode() for record in Bag(bag).records({"/coils/state"})]
    assert states[-1].emergency_stopped
    assert not any(states[-1].current)


@pytest.mark.parametrize("recorded", [True, False])
def test_a_run_that_fails_names_its_bag_where_there_is_one(
    scenario: Path,
    tmp_path: Path,
    recorded: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    bag = tmp_path / "bag"

    def fail(setup: str, output: Path, **options: Any) -> None:
        if recorded:
            output.mkdir()
        raise GraphError("coil_bridge: fault: needle does not follow")

    monkeypatch.setattr(simulate_command, "simulate", fail)
    assert main(["simulate", str(scenario), "--output", str(bag)]) == 1
    shown = "".join("".join(capsys.readouterr()).split())
    assert "needledoesnotfollow" in shown
    assert (f"whatwasrecordedisin{bag}" in shown) is recorded


def test_a_procedure_that_nobody_resumes_ends_the_run_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(simulate_command, "MAX_PAUSE", 1.0)
    (tmp_path / "near.yaml").write_text(NEAR.replace("speed: 0.003", "speed: 0.0002"))  # which leaves time to pause it
    (tmp_path / "open.yaml").write_text(OPEN)

    def pause(share: float) -> None:
        if share and not paused:
            paused.append(True)
            with Participant("person") as person:
                services = Services(person.node, {Service.PAUSE_PROCEDURE: Service.PAUSE_PROCEDURE.type_name})
                assert asyncio.run(services.call(Service.PAUSE_PROCEDURE, Trigger.Request(), timeout=10.0)).success

    paused: list[bool] = []
    bag = tmp_path / "bag"
    procedure = str(tmp_path / "near.yaml")
    simulate(str(tmp_path / "open.yaml"), bag, rate=0.5, procedure=procedure, progress=pause)
    outcome = json.loads((bag / SUMMARY_FILE).read_text())["procedure"]
    assert outcome["state"] == "failed"
    assert outcome["reason"] == "nobody resumes the procedure: paused by a person"


def test_under_faults_the_tracker_is_right_or_silent_and_boards_are_driven_by_the_real_driver(tmp_path: Path):
    path = tmp_path / "faults.yaml"
    faults = ["dropped_frames 0.2 0.2", "glare 0.4 0.3", "late_frames 0.8 0.3", "hand 1.2 0.4"]
    path.write_text(SHORT.replace("FAULTS", f"    faults: {faults}"))
    summary = simulate(str(path), tmp_path / "bag", boards=True)
    assert summary.lost > 0
    assert summary.wrong == 0
    assert summary.tracked > 15
    states = [record.decode() for record in Bag(tmp_path / "bag").records({"/coils/state"})]
    following = [state for state in states if not state.reasons]
    assert {state.driver for state in following} == {"roboclaw"}
    assert max(abs(current) for state in following for current in state.measured_current) > 0.5


def test_a_bare_needle_waits_for_a_commissioning_that_nobody_begins(tmp_path: Path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT.replace("FAULTS", ""))
    host_rig(str(path), tmp_path / "bag", rate=0.5, duration=1.0, rig="random:1")
    bag = Bag(tmp_path / "bag")
    states = [record.decode() for record in bag.records({"/coils/state"})]
    assert "no pulse" in states[-1].reasons
    assert not any(state.armed for state in states)
    lengths = [record.decode().poses for record in bag.records({"/ground_truth/thread"})]
    first, last = lengths[-1][0].pose.position, lengths[-1][-1].pose.position
    assert np.hypot(first.x - last.x, first.y - last.y) <= 1.1e-3  # a stub


def test_what_cannot_be_simulated_is_refused_before_anything_starts(tmp_path: Path):
    still, raw = tmp_path / "still.yaml", tmp_path / "raw.yaml"
    still.write_text(OPEN)
    raw.write_text(SHORT.replace("FAULTS", "") + "/**/vision_tracker: {ros__parameters: {image_transport: raw}}\n")
    for setup, procedure, reason in (
        (still, "", r"path_follower\.waypoints"),
        (raw, "", r"vision_tracker\.image_transport"),
        (still, "no_such_procedure", "expected a YAML file, or one of"),
        (still, "hernia", r"goals\[0\]\.pass_through\.between"),
    ):
        with pytest.raises(ConfigurationError, match=reason):
            simulate(str(setup), tmp_path / "bag", procedure=procedure)
    assert not (tmp_path / "bag").exists()


def test_an_interrupted_run_on_a_simulated_clock_keeps_what_was_recorded(scenario: Path, tmp_path: Path):
    options = ("--output", tmp_path / "bag", "--duration", "60", "--rate", "1.5")
    with running("simulate", scenario, *options) as command:
        command.find("(running at 1.5 times the speed)")

        def recorded() -> bool:  # a second or more of the run
            return sum(path.stat().st_size for path in tmp_path.glob(".bag*/*.mcap")) >= 1_500_000

        wait_until(recorded, "a recording", 60.0)
        assert command.end() == 1
        shown = command.output.read_text() + command.errors.read_text()
    assert f"what was recorded is in {tmp_path / 'bag'}" in " ".join(shown.split())
    bag = Bag(tmp_path / "bag")
    assert bag.counts["/needle/measured_cp"] > 10
    assert bag.start < 1000e9  # on the simulation's own clock


def test_the_goals_of_a_procedure_are_met_and_the_summary_has_the_result(tmp_path: Path):
    (tmp_path / "near.yaml").write_text(NEAR)
    (tmp_path / "open.yaml").write_text(OPEN)
    output = tmp_path / "bag"
    summary_file = tmp_path / "figures.json"
    arguments = ["--procedure", str(tmp_path / "near.yaml"), "--rate", "0.5", "--json", str(summary_file)]
    assert main(["simulate", str(tmp_path / "open.yaml"), "--output", str(output), *arguments]) == 0
    assert (output / SUMMARY_FILE).read_text() == summary_file.read_text()
    assert '"state": "done"' in summary_file.read_text()
    assert '"goals_met": 1' in summary_file.read_text()
    bag = Bag(output)
    scenes = {parse_scene_message(record.decode()).version for record in bag.records({SCENE.recorded})}
    assert scenes == {read_scene("dish_35mm_post").version}  # the procedure's, in place of the setup's
    for channel, count in ((PROCEDURE_STATE, 5), (PROCEDURE_PLAN, 0), (NEEDLE_COMMAND, 10), (TIP_SETPOINT, 10)):
        assert bag.counts[channel.recorded] > count
