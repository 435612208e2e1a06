"""Replaying bags through the live graph: nodes in processes of their own, outputs recorded."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError, ConfigurationError, GraphError
from magnetosuture_thread.jobs.replay import replay

pytestmark = pytest.mark.whole_graph


def test_a_bag_is_replayed_judged_and_recorded(short_bag: Path, tmp_path: Path):
    said: list[str] = []
    shares: list[float] = []
    summary = replay(short_bag, tmp_path / "out", say=said.append, progress=shares.append)
    assert summary.setup == "petri_35mm_polyamide"
    assert "straight_pull" in summary.simulated
    assert (summary.frames, summary.tracked, summary.predicted) == (30, 28, 28)  # the first in the third frame
    assert summary.commands == 30
    assert summary.driven > 0  # all of them, unless the machine is so loaded that the watchdog bites
    assert summary.error_seen is not None
    assert summary.error_truth is not None
    assert summary.error_truth["maximum"] < 1.0
    assert summary.error_seen["count"] == summary.error_truth["count"] == 28
    assert 0.95 < summary.seen_share <= 1.0
    assert {margin.kind for margin in summary.least_margins} == {"connectivity", "compression"}
    assert summary.residual < 1e-5
    assert summary.stretch < 1e-3
    for spread in summary.latency.values():
        assert spread is not None
        assert 0.0 < spread.median < 1.0
    assert any("this machine only" in line for line in said)
    assert shares[-1] == pytest.approx(1.0, abs=0.05)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["tracked"] == 28
    picture = cv2.imread(str(tmp_path / "out" / "summary.png"))
    assert picture is not None
    assert picture.shape[1] > 1000
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "bag",
        "logs",
        "summary.json",
        "summary.png",
    ]
    recorded = Bag(tmp_path / "out" / "bag")
    recorded.check()
    assert recorded.counts["/thread/predicted"] == 28
    assert recorded.counts["/coils/currents"] >= 30
    assert recorded.counts["/diagnostics"] > 0
    with Reader(tmp_path / "out" / "bag") as reader:
        assert reader.message_count == sum(recorded.counts.values())
    stamps = [r.decode().header.stamp for r in recorded.records({"/thread/predicted"})]
    times = np.array([stamp.sec + stamp.nanosec * 1e-9 for stamp in stamps])
    np.testing.assert_allclose(np.diff(times), 1.0 / 30.0, atol=1e-6)
    # It was played in real time, not all at once; a loaded machine takes longer to answer.
    logged = [r.time for r in recorded.records({"/thread/predicted"})]
    assert (logged[-1] - logged[0]) * 1e-9 > 0.5
    # Time begins with the bag: before, outputs are logged at its start, in the order in which they came.
    assert min(r.time for r in recorded.records()) >= Bag(short_bag).start
    said_of_it = [r.decode().status[0] for r in recorded.records({"/diagnostics"})]
    tracker = [status.message for status in said_of_it if status.name.startswith("vision_tracker")]
    assert tracker[-1] == "tracking" or tracker[-1].startswith("no camera frame for")  # after the bag's end
    assert "no camera frame yet" not in tracker[tracker.index("tracking") :]


def rewritten(bag: Path, folder: Path, types: dict[str, str], notes: dict[str, str]) -> Path:
    """Write a bag again with other types for its topics; topics without a type are left out."""
    with BagWriter(folder, notes) as writer:
        for topic, type_name in types.items():
            writer.add_topic(topic, type_name)
        for record in Bag(bag).records(set(types)):
            writer.write(record.topic, record.time, record.data)
    return folder


FRAMES, COMMANDS = "/camera/image_raw/compressed", "/needle/servo_cv"
COMPRESSED, TWIST = "sensor_msgs/msg/CompressedImage", "geometry_msgs/msg/TwistStamped"


def test_bad_bags_are_refused_before_anything_is_written(short_bag: Path, tmp_path: Path):
    mcap = next(short_bag.glob("*.mcap"))
    whole = mcap.read_bytes()
    (tmp_path / "text.mcap").write_text("hello, this is no bag")
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    middle = len(whole) // 2
    (tmp_path / "flipped.mcap").write_bytes(whole[:middle] + bytes([whole[middle] ^ 8]) + whole[middle + 1 :])
    blind = rewritten(short_bag, tmp_path / "blind", {COMMANDS: TWIST}, {})
    wrong = rewritten(short_bag, tmp_path / "wrong", {FRAMES: "std_msgs/msg/Header", COMMANDS: TWIST}, {})
    odd = rewritten(short_bag, tmp_path / "odd", {FRAMES: COMPRESSED, COMMANDS: "std_msgs/msg/Header"}, {})
    before = set(tmp_path.iterdir())
    for bag, words in (
        (tmp_path / "missing", "does not exist"),
        (tmp_path / "text.mcap", "is no mcap file"),
        (tmp_path / "cut.mcap", "is cut off"),
        (tmp_path / "flipped.mcap", "is damaged"),
        (blind, f"has no messages on {FRAMES}"),
        (wrong, f"topic {FRAMES} is of type std_msgs/msg/Header, expected {COMPRESSED}"),
        (odd, f"topic {COMMANDS} is of type std_msgs/msg/Header, expected {TWIST}"),
    ):
        with pytest.raises(BagError) as caught:
            replay(bag, tmp_path / "out")
        assert words in str(caught.value)
        assert bag.name in str(caught.value)
        assert "\n" not in str(caught.value)
    assert set(tmp_path.iterdir()) == before


def test_an_output_that_exists_is_not_touched(short_bag: Path, tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("precious")
    with pytest.raises(BagError, match="exists already"):
        replay(short_bag, tmp_path / "out")
    assert (tmp_path / "out" / "mine").read_text() == "precious"


def test_a_bad_setup_is_refused_before_anything_starts(short_bag: Path, tmp_path: Path):
    path = tmp_path / "bad.yaml"
    path.write_text("thread_model: {ros__parameters: {length: 19.0}}\n")
    with pytest.raises(ConfigurationError, match=r"thread_model\.length: got 19\.0"):
        replay(short_bag, tmp_path / "out", setup_name=str(path))
    assert not (tmp_path / "out").exists()


def test_a_bag_without_commands_is_played(short_bag: Path, tmp_path: Path):
    """And one that names no set-up gets the default, which is said."""
    silent = rewritten(short_bag, tmp_path / "silent", {FRAMES: COMPRESSED}, {})
    said: list[str] = []
    summary = replay(silent, tmp_path / "out", say=said.append)
    assert (summary.frames, summary.tracked, summary.commands, summary.driven) == (30, 28, 0, 0)
    assert summary.error_truth is None
    assert "the bag names no set-up; taking petri_35mm_polyamide" in said
    assert summary.simulated == ""


def test_a_bag_in_which_nothing_is_seen_fails_and_leaves_nothing(short_bag: Path, tmp_path: Path):
    """The needle that is expected is far longer than the one in the frames."""
    path = tmp_path / "other.yaml"
    path.write_text(
        "".join(
            f"{node}: {{ros__parameters: {{needle_length: 0.02}}}}\n"
            for node in ("vision_tracker", "coil_bridge", "path_follower")
        )
    )
    with pytest.raises(
        GraphError,
        match=r"none of 30 frames gave a prediction, 0 had a needle; .*vision_tracker: .*searching: no needle",
    ):
        replay(short_bag, tmp_path / "out", setup_name=str(path), rate=4.0)
    assert [p.name for p in tmp_path.iterdir()] == ["other.yaml"]


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_replay_ends_its_nodes_and_leaves_nothing(tmp_path: Path, end: signal.Signals):
    example = Path(__file__).parents[2] / "examples" / "post_wrap"
    command = [sys.executable, "-u", "-m", "magnetosuture_thread.cli", "replay", str(example), "--output", "out"]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A test run in a shell's background inherits an ignored SIGINT; a user's terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("playing"):
            break
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(children) == 3
    process.send_signal(end)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []
    assert not any(Path(f"/proc/{child}").exists() for child in children)


def test_the_example_bag_is_tracked_in_every_frame(tmp_path: Path):
    example = Path(__file__).parents[2] / "examples" / "post_wrap"
    summary = replay(example, tmp_path / "out")
    assert summary.frames == 240
    assert summary.tracked == summary.predicted == summary.frames - 2  # the first pose comes in the third frame
    assert summary.commands == 240
    assert summary.contact_frames > 100
    obstacle = next(margin for margin in summary.least_margins if margin.kind == "obstacle")
    assert obstacle.clearance > -1e-6
    assert summary.error_seen is not None
    assert summary.error_seen["maximum"] < 1.0
    shutil.rmtree(tmp_path / "out")
