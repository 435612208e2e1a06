"""Recorded experiments without a graph: what is observed in a bag, and what is predicted and written of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from magnetosuture_thread import replay_offline
from magnetosuture_thread.bags.packing import packed_compressed_image
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.reading import stamp_of
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.evaluation.recorded import BagInput, ObservationReader, Step, chosen_source, predictions
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import SceneShape
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError
from test.bags.bags import changed, make, scene_message, stamped
from test.shared import known, run_python
from test.vision.scenes import rod

SETUP = read_setup("petri_35mm_polyamide")
SCENE, POSE, FRAME = interface.SCENE, interface.NEEDLE_POSE.recorded, interface.COMPRESSED_IMAGE.recorded
MEASURED, TRUTH = interface.MEASURED_THREAD.recorded, interface.GROUND_TRUTH_THREAD.recorded
LATE = round(1.9e9)  # ns; the last three messages of each topic are later


@pytest.fixture(scope="module")
def pose_bag(tmp_path_factory: pytest.TempPathFactory, straight_pull: ReferenceTrajectory) -> Path:
    """Return a bag of poses of one second."""
    path = tmp_path_factory.mktemp("poses") / "pull"
    render_bag(straight_pull, SETUP, path, duration=1.0, pose_noise=1e-5)
    return path


def observed(bag: Path, start: float = 0.0) -> ObservationReader:
    """Return what is observed in a bag."""
    recording = Recording(Bag(bag))
    source = chosen_source(recording, "auto")
    return ObservationReader(BagInput(recording, SETUP, source, start, recording.duration - start))


def without(bag: Path, folder: Path, *topics: str) -> Path:
    """Write a bag again without some topics."""
    return changed(bag, folder, lambda old, message: None if old.topic in topics else message)


def restamped(bag: Path, folder: Path, stamp: Callable[[RecordedMessage, int], int]) -> Path:
    """Write a bag again with other stamps in its messages."""

    def change(old: RecordedMessage, message: Any) -> Any:
        time = message.header.stamp
        time.sec, time.nanosec = divmod(stamp(old, stamp_of(old)), 10**9)
        return message

    return changed(bag, folder, change)


def test_what_cannot_be_replayed_is_refused_and_nothing_is_left(pose_bag: Path, tmp_path: Path):
    (tmp_path / "empty.mcap").write_bytes(b"")
    blind = without(pose_bag, tmp_path / "blind", POSE, MEASURED, interface.NEEDLE_COMMAND.recorded)
    unseen = without(pose_bag, tmp_path / "unseen", MEASURED)
    for bag, selection, words in (
        (pose_bag, {"source": "camera"}, "camera/image_raw/compressed"),
        (blind, {}, "has no messages on"),
        (tmp_path / "empty.mcap", {}, r"empty\.mcap"),
        (pose_bag, {"start": 7.0}, "asked to start at 7 s"),
        (unseen, {}, "30 of 30 poses had a needle; waiting for the thread to be seen"),
    ):
        with pytest.raises(BagError, match=words):
            replay_offline(bag, tmp_path / "out", **selection)
    assert not (tmp_path / "out").exists()
    straight = predictions(observed(unseen), replace(SETUP.model, initial_shape="straight"), SETUP.scene)
    steps = [event for event in straight if isinstance(event, Step)]
    assert [step.result.prediction is not None for step in steps] == [True] * 30


@pytest.mark.parametrize("topic", [POSE, MEASURED])
def test_millimetres_are_noticed(pose_bag: Path, tmp_path: Path, topic: str):
    def millimetres(old: RecordedMessage, message: Any) -> Any:
        if old.topic == topic:
            for pose in getattr(message, "poses", None) or [message.pose]:
                pose.pose.position.x *= 1e3
        return message

    with pytest.raises(BagError, match=rf"{topic} .*the dish is 0\.035 m wide; are these millimetres"):
        replay_offline(changed(pose_bag, tmp_path / "bag", millimetres), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_two_runs_write_the_same_bag(pose_bag: Path, tmp_path: Path):
    summary = replay_offline(pose_bag, tmp_path / "a")
    assert (summary.frames, summary.tracked, summary.predicted, summary.source) == (30, 30, 30, "poses")
    error = known(summary.error_truth)
    assert (error["count"], error["maximum"] < 1.0) == (30, True)
    command = ("-m", "magnetosuture_thread.cli", "replay", "--offline", pose_bag, "--output", "b")
    assert "times as fast as recorded" in run_python(*command, cwd=tmp_path)
    for name in ("bag_0.mcap", "metadata.yaml"):
        assert (tmp_path / "a" / "bag" / name).read_bytes() == (tmp_path / "b" / "bag" / name).read_bytes()
    assert json.loads((tmp_path / "a" / "summary.json").read_text())["predicted"] == 30
    assert cv2.imread(str(tmp_path / "a" / "summary.png")) is not None
    made = (interface.PREDICTED_THREAD, interface.ESTIMATED_THREAD, interface.MARGINS)
    topics = [POSE, MEASURED, *(channel.recorded for channel in made)]
    assert +Bag(tmp_path / "a" / "bag").counts == {SCENE.recorded: 1, **dict.fromkeys(topics, 30)}


def test_stamps_that_go_back_are_refused_and_a_time_that_goes_back_by_more_begins_anew(
    pose_bag: Path, short_bag: Path, tmp_path: Path
):
    def back(old: RecordedMessage, stamp: int) -> int:
        return stamp - 500_000_000 * (old.topic in (POSE, FRAME) and stamp > LATE)

    for bag, tracked in ((pose_bag, 30), (short_bag, 26)):
        summary = replay_offline(restamped(bag, tmp_path / f"back{tracked}", back), tmp_path / f"out{tracked}")
        assert (summary.frames, summary.tracked, summary.predicted) == (30, tracked, min(tracked, 28))
        assert summary.refused["a stamp not newer than the last"] == 2
    anew = restamped(pose_bag, tmp_path / "anew", lambda old, stamp: stamp + 3 * 10**9 * (stamp < 1.5e9))
    summary = replay_offline(anew, tmp_path / "out")
    assert summary.predicted == 30
    assert known(summary.error_seen)["maximum"] < 1.0


def test_a_recorded_point_at_the_tip_gives_a_needle_without_a_thread_its_direction(tmp_path: Path):
    ends, random = np.array([[-0.004, 0.002], [0.003, 0.002]]), np.random.default_rng(0)
    tip = make("geometry_msgs/msg/PointStamped", stamped(1), make("geometry_msgs/msg/Point", *ends[1]))
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(FRAME, interface.COMPRESSED_IMAGE.type_name)
        bag.add_topic(interface.NEEDLE_TIP.recorded, interface.NEEDLE_TIP.type_name)
        for index in range(12):
            at = 10**9 + index * 10**9 // 30
            noisy = np.clip(rod(ends) + random.normal(0.0, 2.0, (480, 640, 3)), 0, 255).astype(np.uint8)
            bag.write(FRAME, at, packed_compressed_image(at, encode_jpeg(noisy, 95)))
            if index == 4:
                bag.write_message(interface.NEEDLE_TIP.recorded, at, tip)
    found = list(observed(tmp_path / "bag"))
    assert [bool(len(each.tail)) for each in found] == [False] * 7 + [True] * 5
    assert found[-1].tail == pytest.approx(ends[0], abs=2e-4)


def test_broken_pictures_and_poses_are_counted(pose_bag: Path, short_bag: Path, tmp_path: Path):
    def torn(old: RecordedMessage, message: Any) -> Any:
        if old.topic == FRAME and stamp_of(old) > LATE:
            message.data = message.data[:7]
        if old.topic == POSE and stamp_of(old) > LATE:
            message.pose.pose.orientation.w = 3.0
        return message

    summary = replay_offline(changed(short_bag, tmp_path / "torn", torn), tmp_path / "out")
    broken = "image.data: got damaged bytes, expected a JPEG or PNG image, or BMP, TIFF, WebP, as a whole"
    assert summary.refused == {"no needle for sure": 2, broken: 2}
    summary = replay_offline(changed(pose_bag, tmp_path / "bent", torn), tmp_path / "out2")
    assert (summary.tracked, summary.refused) == (28, {"a pose that is not valid": 2})


def test_a_damaged_bag_is_played_as_far_as_it_is_intact(short_bag: Path, tmp_path: Path):
    whole = next(short_bag.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    said: list[str] = []
    summary = replay_offline(tmp_path / "cut.mcap", tmp_path / "out", log=said.append)
    assert 0 < summary.predicted < 28
    assert summary.damage == str(Bag(tmp_path / "cut.mcap").damage)
    assert any(summary.damage in line for line in said)


def test_scene_and_material_count_from_when_they_were_said(pose_bag: Path, tmp_path: Path):
    scene, too_fine = (
        SETUP.scene.add(SceneShape("post", "instrument", Disc((0.0, 0.006), radius))) for radius in (2e-3, 1e-5)
    )
    times = [round(time * 1e9) for time in (1.39, 1.5, 1.61)]
    scenes = map(scene_message, times, (scene, scene, too_fine), ("", "f" * 16, ""))
    header = make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(times[-1], 10**9)), "dish")
    told = [(SCENE, *each) for each in zip(times, scenes, strict=True)]
    told.append((interface.MATERIAL, times[-1], make(interface.MATERIAL.type_name, header, name="silk_6_0")))
    bag = changed(pose_bag, tmp_path / "told", added=told)
    for start, first in ((0.0, 12), (0.5, 0)):
        seen = observed(bag, start=start)
        steps = [event for event in predictions(seen, SETUP.model, SETUP.scene) if isinstance(event, Step)]
        assert [step.scene for step in steps] == [SETUP.scene] * first + [scene] * (len(steps) - first)
        assert [step.result.scene_version for step in steps] == [step.scene.version for step in steps if step.scene]
        assert {step.settings.material for step in steps} == {SETUP.model.material, "silk_6_0"}
        assert steps[-1].settings.material == "silk_6_0"
        assert all(step.result.prediction is not None for step in steps)
        assert sum(seen.refused.values()) == 2
    replay_offline(bag, tmp_path / "again")
    said = [record.decode().version for record in Bag(tmp_path / "again" / "bag").records({SCENE.recorded})]
    assert said[:2] == [SETUP.scene.version, scene.version]  # so that what comes of it can be replayed in its turn
