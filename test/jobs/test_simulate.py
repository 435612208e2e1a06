"""The whole graph around a simulated rig: nodes in processes of their own, everything recorded."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import cv2
import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.cli import main
from magnetosuture_thread.errors import BagError, ConfigurationError, GraphError
from magnetosuture_thread.jobs import simulate as simulate_module
from magnetosuture_thread.jobs.replay import replay_live
from magnetosuture_thread.jobs.simulate import simulate
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.nodes.recorder import Recorder
from magnetosuture_thread.reproduce import thread_behavior as thread_behavior_module
from magnetosuture_thread.resources import find_setup_file
from magnetosuture_thread.scene import read_scene

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


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scenario of one second."""
    path = tmp_path_factory.mktemp("scenario") / "short.yaml"
    path.write_text(SHORT.replace("FAULTS", ""))
    return path


@pytest.fixture(scope="module")
def run(scenario: Path, tmp_path_factory: pytest.TempPathFactory):
    """Run it at half the speed, for busy machines; return the bag, the figures and what was said."""
    bag = tmp_path_factory.mktemp("run") / "bag"
    said: list[str] = []
    shares: list[float] = []
    summary = simulate(str(scenario), bag, rate=0.5, log=said.append, progress=shares.append)
    return bag, summary, said, shares


def test_the_needle_follows_its_path_and_the_thread_is_predicted(run):
    _, summary, said, shares = run
    assert summary.setup == "short"
    assert summary.frames >= 20
    assert summary.tracked >= 0.9 * summary.frames
    assert summary.wrong == 0
    assert summary.predicted >= 0.9 * summary.tracked
    assert summary.tail_error < 8e-5
    assert summary.path_error < 2e-3  # how well is for a quiet machine to say
    assert summary.error_truth is not None
    assert summary.error_truth["mean"] < 2.0
    assert summary.seen_share > 0.9
    assert any("this machine only" in line for line in said)
    assert shares[-1] == 1.0


def test_a_run_whose_bridge_is_stopped_ends_and_says_so(scenario: Path, tmp_path: Path):
    """The emergency stop is pressed from another process than the bridge's, as the run begins."""

    def log(text: str) -> None:
        if text == "running":
            assert main(["coils", "stop"]) == 0

    with pytest.raises(GraphError, match="coil_bridge: fault: emergency stop; what was recorded is in"):
        simulate(str(scenario), tmp_path / "bag", log=log)
    states = [record.decode() for record in Bag(tmp_path / "bag").records({"/coils/state"})]
    assert states[-1].emergency_stopped
    assert not any(states[-1].current)


def test_the_driver_for_real_boards_drives_simulated_ones_in_the_loop(scenario: Path, tmp_path: Path):
    summary = simulate(str(scenario), tmp_path / "bag", boards=True)
    assert summary.path_error < 2e-3
    states = [r.decode() for r in Bag(tmp_path / "bag").records({"/coils/state"})]
    following = [state for state in states if not state.reasons]
    assert following
    assert {state.driver for state in following} == {"roboclaw"}
    assert max(abs(current) for state in following for current in state.measured_current) > 0.5


def test_the_bag_holds_everything_and_says_that_it_is_simulated(run):
    bag = Bag(run[0])
    assert bag.damage is None
    assert "simulated" in bag.notes
    assert bag.notes["setup"].endswith("short")
    for topic in (
        "/camera/image_raw/compressed",
        "/camera/camera_info",
        "/ground_truth/needle",
        "/ground_truth/thread",
        "/ground_truth/thread_pull",
        "/needle/measured_cp",
        "/needle/tracker_state",
        "/needle/servo_cv",
        "/needle/setpoint_cp",
        "/needle/setpoint_cv",
        "/coils/currents",
        "/thread/measured",
        "/thread/predicted",
        "/thread/margins",
        "/thread/markers",
        "/scene",
        "/diagnostics",
    ):
        assert bag.counts[topic] > 0, topic
    (told,) = bag.records({"/scene"})
    assert parse_scene_message(told.decode()) == read_scene("dish_35mm")
    assert told.time == bag.start
    first = min(record.time for record in bag.records({"/ground_truth/needle"}))
    assert first - bag.start < 0.5e9  # the nodes' start is not in it
    covariances = [record.decode().pose.covariance for record in bag.records({"/needle/measured_cp"})]
    assert all(0.0 < covariance[0] < 1e-8 for covariance in covariances)


def test_replay_takes_the_bag(run, scenario: Path, tmp_path: Path):
    scenario.rename(scenario.with_suffix(".gone"))  # the bag must know it by itself
    try:
        summary = replay_live(run[0], tmp_path / "out")
    finally:
        scenario.with_suffix(".gone").rename(scenario)
    assert summary.setup == "short"
    assert "whole rig" in summary.simulated
    assert summary.tracked >= 0.9 * summary.frames
    assert summary.error_truth is not None
    assert summary.commands > 20


def test_under_faults_the_tracker_is_right_or_silent_and_the_needle_goes_on(tmp_path: Path):
    path = tmp_path / "faults.yaml"
    faults = ["dropped_frames 0.2 0.2", "glare 0.4 0.3", "late_frames 0.8 0.3", "hand 1.2 0.4"]
    path.write_text(SHORT.replace("FAULTS", f"    faults: {faults}"))
    summary = simulate(str(path), tmp_path / "bag")
    assert summary.lost > 0
    assert summary.wrong == 0
    assert summary.tracked > 15


def test_with_a_simulated_clock_it_runs_faster_than_real_time_and_can_be_ended_before_its_path(tmp_path: Path):
    # Few frames: how many a second can be tracked is for a benchmark.
    path = tmp_path / "short.yaml"
    path.write_text(SHORT.replace("FAULTS", "").replace("frame_rate: 30.0", "frame_rate: 8.0") + "    speed: 0.0006\n")
    said: list[str] = []
    recording: list[float] = []  # s, of the machine's own time
    summary = simulate(
        str(path),
        tmp_path / "bag",
        rate=2.0,
        duration=4.0,
        log=said.append,
        progress=lambda share: recording.append(time.monotonic()),
    )
    assert "running at 2 times the speed" in said
    assert summary.tracked >= 0.5 * summary.frames
    bag = Bag(tmp_path / "bag")
    assert bag.start < 1000e9  # on the simulation's own clock
    assert bag.duration > 1.4 * (recording[-1] - recording[0])  # how soon nodes start and end is left out
    assert summary.duration < 4.5  # the whole path takes 33 s


def test_a_run_begins_with_the_first_prediction_or_after_a_while_without_any(monkeypatch: pytest.MonkeyPatch):
    """The first frames may take long: see what the recorder is asked for, without a graph."""

    class Waiting(Recorder):
        def __init__(self, frames: int) -> None:  # none of a graph
            self.spins: list[float] = []
            self.taken = Counter()
            self._frames = frames

        def silent(self) -> list[str]:
            return []

        def spin(self, duration: float) -> None:
            self.spins.append(duration)
            self.taken["/thread/predicted"] += len(self.spins) == self._frames

    recorder = Waiting(frames=7)
    simulate_module._wait(recorder, lambda: None, print)
    assert recorder.spins == 7 * [simulate_module.POLL_PERIOD] + [simulate_module.SETTLING_TIME]
    monkeypatch.setattr(simulate_module, "PREDICTION_TIMEOUT", 0.0)
    never = Waiting(frames=-1)
    simulate_module._wait(never, lambda: None, print)
    assert never.spins == [simulate_module.SETTLING_TIME]


def test_of_each_node_it_is_logged_once_that_it_compiles():
    logged: set[str] = set()
    lines: list[str] = []
    for texts in ({"a": "loading", "b": "compiling b"}, {"a": "compiling a", "b": "compiling b"}, {"a": "compiling a"}):
        simulate_module.log_compiling(texts, logged, lines.append)
    assert lines == ["b: compiling b", "a: compiling a"]


def test_a_scenario_without_a_path_is_refused(tmp_path: Path):
    path = tmp_path / "still.yaml"
    path.write_text("/**: {ros__parameters: {scene: dish_35mm}}\n")
    with pytest.raises(ConfigurationError, match=r"path_follower\.waypoints"):
        simulate(str(path), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_raw_frames_are_refused_as_the_bag_would_not_hold_them(tmp_path: Path):
    path = tmp_path / "raw.yaml"
    path.write_text(SHORT.replace("FAULTS", "") + "/**/vision_tracker: {ros__parameters: {image_transport: raw}}\n")
    with pytest.raises(ConfigurationError, match=r"vision_tracker\.image_transport"):
        simulate(str(path), tmp_path / "bag")


def test_a_run_without_a_measured_needle_fails_but_its_bag_and_logs_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(simulate_module, "PREDICTION_TIMEOUT", 2.0)  # s; in vain
    monkeypatch.setattr(simulate_module, "EXTRA_TIME", 5.0)
    path = tmp_path / "dark.yaml"
    path.write_text(SHORT.replace("FAULTS", "    light_gain: 0.06"))
    with pytest.raises(GraphError, match=r"tracked in no frame; .*vision_tracker: searching"):
        simulate(str(path), tmp_path / "bag", duration=0.5)
    assert Bag(tmp_path / "bag").counts["/ground_truth/needle"] > 3
    assert "ready" in (tmp_path / "bag" / "logs" / "rig_simulator.log").read_text()


def test_an_output_that_exists_is_not_touched(scenario: Path, tmp_path: Path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="exists already"):
        simulate(str(scenario), tmp_path / "bag")


def test_a_node_that_cannot_start_ends_the_run_with_its_last_words(tmp_path: Path):
    path = tmp_path / "odd.yaml"
    # What a barrier's class is only the node finds out.
    other = "/**/thread_model: {ros__parameters: {barriers: ['no_such_module:Thing']}}\n"
    path.write_text(SHORT.replace("FAULTS", "") + other)
    with pytest.raises(GraphError, match=r"perception ended with exit code 1: error: .*no_such_module"):
        simulate(str(path), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_an_interrupted_run_leaves_nothing_behind(scenario: Path, tmp_path: Path):
    command = [
        sys.executable,
        "-m",
        "magnetosuture_thread.cli",
        "simulate",
        str(scenario),
        "--output",
        str(tmp_path / "bag"),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert process.stdout is not None
        next(line for line in process.stdout if b"starting" in line)
        time.sleep(0.5)  # into the start of the nodes; where exactly does not matter
        process.send_signal(signal.SIGINT)
        process.wait(30.0)
    assert process.returncode != 0
    assert list(tmp_path.iterdir()) == []


def test_thread_behavior_draws_each_scenario(run, scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What is drawn is a run of the whole graph: the one that was recorded above."""

    def recorded(setup: str, output: Path, **_: Any) -> None:
        assert setup == str(scenario)
        shutil.copytree(run[0], output)

    monkeypatch.setattr(thread_behavior_module, "simulate", create_autospec(simulate, side_effect=recorded))
    runs = thread_behavior_module.thread_behavior(tmp_path / "out", [str(scenario)])
    assert len(runs) == 1
    assert runs[0].summary.error_truth is not None
    assert runs[0].summary.error_truth == run[1].error_truth
    picture = cv2.imread(str(tmp_path / "out" / "behaviour.png"))
    assert picture is not None
    assert picture.shape[1] > 1000
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["behaviour.json", "behaviour.png", "short"]


def test_the_scenarios_of_the_paper_ship():
    for name in ("petri_35mm_polyamide", "petri_150mm_silk"):
        assert find_setup_file(name).exists()


def test_an_interrupted_run_that_has_begun_keeps_what_was_recorded(scenario: Path, tmp_path: Path):
    command = [sys.executable, "-u", "-m", "magnetosuture_thread.cli", "simulate", str(scenario)]
    command += ["--output", str(tmp_path / "bag"), "--duration", "60"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        next(line for line in process.stdout if "running" in line)
        deadline = time.monotonic() + 60.0
        # a second or more of the run
        while sum(path.stat().st_size for path in tmp_path.glob(".bag*/*.mcap")) < 1_500_000:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
    assert process.returncode == 1
    assert f"what was recorded is in {tmp_path / 'bag'}" in " ".join(rest.split())
    assert Bag(tmp_path / "bag").counts["/needle/measured_cp"] > 10


def test_an_interruption_waits_until_what_came_is_recorded(scenario: Path, tmp_path: Path, interrupting):
    with pytest.raises(KeyboardInterrupt):
        simulate(str(scenario), tmp_path / "bag", duration=60.0, progress=interrupting)
    assert len(interrupting.went_on) == 1
    assert (tmp_path / "bag" / "metadata.yaml").exists()
