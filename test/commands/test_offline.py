"""Recorded experiments without a graph."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.vision.frames import distorted, lens_with
from magnetosuture_thread.bags.message_types import MESSAGES as BUILDER
from magnetosuture_thread.bags.message_types import make, typestore
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands.observations import ObservationReader, predictions
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.commands.replay import replay_offline
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.interface import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    ESTIMATED_THREAD,
    GROUND_TRUTH_PULL,
    GROUND_TRUTH_THREAD,
    MARGINS,
    MATERIAL,
    MEASURED_THREAD,
    NEEDLE_POSE,
    PREDICTED_THREAD,
    SCENE,
)
from magnetosuture_thread.messages.packing import packed_pose, packed_wrench
from magnetosuture_thread.messages.reading import stamp_of
from magnetosuture_thread.messages.scene import packed_scene
from magnetosuture_thread.scene import SceneShape
from magnetosuture_thread.setups import read_setup
from magnetosuture_thread.vision.images import decode_image
from test.bags.bags import changed

SETUP = read_setup("petri_35mm_polyamide")


@pytest.fixture(scope="module")
def pose_bag(tmp_path_factory: pytest.TempPathFactory, straight_pull: ReferenceTrajectory) -> Path:
    """Return a bag of poses of one second."""
    path = tmp_path_factory.mktemp("poses") / "pull"
    render_bag(straight_pull, SETUP, path, duration=1.0, pose_noise=1e-5)
    return path


def at(message: Any, stamp: int) -> Any:
    """Return a message with another stamp."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return message


def test_sights_of_poses_hold_what_was_recorded(pose_bag: Path, straight_pull: ReferenceTrajectory):
    shares: list[float] = []
    found = ObservationReader(Recording(Bag(pose_bag)), SETUP, progress=shares.append)
    assert found.source == "poses"
    seen = list(found)
    assert (found.count, found.found, found.refused) == (30, 30, {})
    assert [s.stamp for s in seen] == [round((1.0 + k / 30.0) * 1e9) for k in range(30)]
    for k, observation in enumerate(seen):
        tail, _, thread = straight_pull.at(k / 30.0)
        assert np.linalg.norm(observation.tail - tail) < 6e-5
        assert np.linalg.norm(observation.heading) == pytest.approx(1.0, abs=1e-12)
        assert observation.measured.shape == (64, 2)
        assert np.array_equal(observation.measured[0], observation.tail)
        assert np.abs(observation.measured[-1] - thread[-1]).max() < 6e-5
        assert observation.ground_truth.shape == (51, 2)
        assert np.allclose(observation.ground_truth[0], tail, atol=1e-12)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_sights_of_frames_hold_what_the_tracker_sees(short_bag: Path, straight_pull: ReferenceTrajectory):
    found = ObservationReader(Recording(Bag(short_bag)), SETUP)
    seen = list(found)
    assert (found.source, found.count, found.found) == ("camera", 30, 28)
    assert found.refused == {"no needle for sure": 2}
    assert [bool(s.reason) for s in seen] == [True] * 2 + [False] * 28
    for k, observation in enumerate(seen[2:], 2):
        assert np.linalg.norm(observation.tail - straight_pull.at(k / 30.0)[0]) < 1e-4
        assert observation.measured.shape == (64, 2)
        assert observation.ground_truth.shape == (51, 2)
        assert observation.processing > 0.0


def test_frames_are_seen_through_the_lens_in_camera_info(short_bag: Path, tmp_path: Path):
    lens, bend = lens_with(-0.05, (640, 480)), distorted(-0.05)
    view = SETUP.rig.camera(SETUP.scene).view

    def through_lens(told: bool, old: RecordedMessage, message: Any) -> Any:
        if old.topic == CAMERA_INFO.recorded:
            message.k, message.d = lens.matrix.ravel(), lens.coefficients if told else np.zeros(5)
        elif old.topic == COMPRESSED_IMAGE.recorded:
            message.data = cv2.imencode(".png", bend(decode_image(message.data), view))[1].ravel()
        return message

    def tails(bag: Path) -> dict[int, np.ndarray]:
        found = ObservationReader(Recording(Bag(bag)), SETUP, duration=0.3)
        return {each.stamp: each.tail for each in found if not each.reason}

    plain, errors = tails(short_bag), []
    for told in (True, False):
        found = tails(changed(short_bag, tmp_path / f"{told}", partial(through_lens, told)))
        assert len(found) >= len(plain) - 1  # The first frame comes before its camera_info.
        errors.append(max(float(np.linalg.norm(tail - plain[stamp])) for stamp, tail in found.items()))
    assert errors[0] < 5e-5
    assert errors[1] > 2.0 * errors[0]


def test_the_source_must_be_there(pose_bag: Path, tmp_path: Path):
    with pytest.raises(BagError, match="camera/image_raw/compressed"):
        ObservationReader(Recording(Bag(pose_bag)), SETUP, source="camera")
    blind = changed(
        pose_bag, tmp_path / "blind", lambda old, m: m if old.topic == GROUND_TRUTH_THREAD.recorded else None
    )
    for source in ("auto", "poses"):
        with pytest.raises(BagError, match="has no messages on"):
            ObservationReader(Recording(Bag(blind)), SETUP, source=source)
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(BagError, match=r"empty\.mcap"):
        replay_offline(tmp_path / "empty.mcap", tmp_path / "out")
    with pytest.raises(BagError, match="asked to start at 7 s"):
        replay_offline(pose_bag, tmp_path / "out", start=7.0)
    assert not (tmp_path / "out").exists()


def test_two_runs_write_the_same_bag(pose_bag: Path, tmp_path: Path):
    summary = replay_offline(pose_bag, tmp_path / "a" / "out")
    assert (summary.frames, summary.tracked, summary.predicted, summary.source) == (30, 30, 30, "poses")
    assert summary.error_truth is not None
    assert summary.error_truth["count"] == 30
    assert summary.error_truth["maximum"] < 1.0
    assert summary.speed is not None
    command = [sys.executable, "-m", "magnetosuture_thread.cli", "replay", "--offline", str(pose_bag), "--output", "b"]
    shown = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert shown.returncode == 0, shown.stderr
    assert "times as fast as recorded" in shown.stdout
    one, other = tmp_path / "a" / "out", tmp_path / "b"
    names = sorted(path.name for path in (one / "bag").iterdir())
    assert names == sorted(path.name for path in (other / "bag").iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    for name in names:
        assert (one / "bag" / name).read_bytes() == (other / "bag" / name).read_bytes()
    assert json.loads((one / "summary.json").read_text())["predicted"] == 30
    assert cv2.imread(str(one / "summary.png")) is not None
    counts = Bag(one / "bag").counts
    assert {topic: counts[topic] for topic in counts if counts[topic]} == {
        SCENE.recorded: 1,
        **{
            channel.recorded: 30
            for channel in (NEEDLE_POSE, MEASURED_THREAD, PREDICTED_THREAD, ESTIMATED_THREAD, MARGINS)
        },
    }


def test_millimetres_are_noticed(pose_bag: Path, tmp_path: Path):
    def pose(old: RecordedMessage, message: Any) -> Any:
        if old.topic == NEEDLE_POSE.recorded:
            message.pose.pose.position.x *= 1e3
        return message

    def thread(old: RecordedMessage, message: Any) -> Any:
        if old.topic == MEASURED_THREAD.recorded:
            for each in message.poses:
                each.pose.position.x *= 1e3
        return message

    for name, change in ((NEEDLE_POSE.recorded, pose), (MEASURED_THREAD.recorded, thread)):
        bag = changed(pose_bag, tmp_path / name.replace("/", "_"), change)
        with pytest.raises(BagError) as caught:
            replay_offline(bag, tmp_path / "out")
        for words in (name, "the dish is 0.035 m wide", "are these millimetres"):
            assert words in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_stamps_that_go_back_are_refused_and_counted(pose_bag: Path, short_bag: Path, tmp_path: Path):
    def back(old: RecordedMessage, message: Any) -> Any:
        stamp = stamp_of(old)
        late = old.topic in (NEEDLE_POSE.recorded, COMPRESSED_IMAGE.recorded) and stamp > round(1.9e9)
        return at(message, stamp - 500_000_000) if late else message

    for bag, tracked in ((pose_bag, 30), (short_bag, 26)):
        summary = replay_offline(changed(bag, tmp_path / f"{bag.parent.name}", back), tmp_path / f"out{tracked}")
        assert (summary.frames, summary.tracked) == (30, tracked)
        assert summary.refused["a stamp not newer than the last"] == 2
        assert summary.predicted == min(tracked, 28)


def test_time_that_goes_back_by_more_begins_anew(pose_bag: Path, tmp_path: Path):
    def back(old: RecordedMessage, message: Any) -> Any:
        stamp = stamp_of(old)
        return at(message, stamp + (3 * 10**9 if stamp < 1.5e9 else 0))

    summary = replay_offline(changed(pose_bag, tmp_path / "back", back), tmp_path / "out")
    assert summary.predicted == 30
    assert summary.error_seen is not None
    assert summary.error_seen["maximum"] < 1.0


def test_broken_pictures_and_poses_are_counted(pose_bag: Path, short_bag: Path, tmp_path: Path):
    def torn(old: RecordedMessage, message: Any) -> Any:
        if old.topic == COMPRESSED_IMAGE.recorded and stamp_of(old) > round(1.9e9):
            message.data = message.data[:7]
        if old.topic == NEEDLE_POSE.recorded and stamp_of(old) > round(1.9e9):
            message.pose.pose.orientation.w = 3.0
        return message

    summary = replay_offline(changed(short_bag, tmp_path / "torn", torn), tmp_path / "out")
    assert summary.refused == {"no needle for sure": 2, "a broken picture": 2}
    summary = replay_offline(changed(pose_bag, tmp_path / "bent", torn), tmp_path / "out2")
    assert (summary.tracked, summary.refused) == (28, {"a pose that is none": 2})


def test_nothing_predicted_is_said_with_the_reason(pose_bag: Path, tmp_path: Path):
    blind = changed(pose_bag, tmp_path / "blind", lambda old, m: None if old.topic == MEASURED_THREAD.recorded else m)
    with pytest.raises(BagError, match="30 of 30 poses had a needle; waiting for the thread to be seen"):
        replay_offline(blind, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    steps = list(
        predictions(
            ObservationReader(Recording(Bag(blind)), SETUP), replace(SETUP.model, initial_shape="straight"), SETUP.scene
        )
    )
    assert len(steps) == 30
    assert all(step.result.prediction is not None for step in steps)


def test_a_damaged_bag_is_played_as_far_as_it_is_intact(short_bag: Path, tmp_path: Path):
    whole = next(short_bag.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    damage = Bag(tmp_path / "cut.mcap").damage
    assert damage is not None
    said: list[str] = []
    summary = replay_offline(tmp_path / "cut.mcap", tmp_path / "out", log=said.append)
    assert 0 < summary.predicted < 28
    assert summary.damage == str(damage)
    assert any(str(damage) in line for line in said)


def test_tracker_follows_a_recorded_scene(short_bag: Path, tmp_path: Path):
    source = Bag(short_bag)
    wider = replace(SETUP.scene, dish=replace(SETUP.scene.dish, diameter=0.07))
    with BagWriter(tmp_path / "wider", source.notes) as writer:
        for topic, type_name in (*source.topics.items(), (SCENE.recorded, SCENE.type_name)):
            writer.add_topic(topic, type_name)
        for render_bag in source.records(set(source.topics)):
            writer.write(render_bag.topic, render_bag.time, render_bag.data)
        stamp = round(1.39e9)
        writer.write(SCENE.recorded, stamp, packed_scene(stamp, wider))
    for start, found in ((0.0, 12), (0.5, 0)):
        seen = ObservationReader(Recording(Bag(tmp_path / "wider")), SETUP, start=start)
        # In a dish of twice the diameter, what was the needle is twice as long.
        tracked = [observation.found for observation in seen]
        assert sum(tracked) == sum(tracked[:found]) >= found - 2


def test_scene_and_material_count_from_when_they_were_said(pose_bag: Path, tmp_path: Path):
    source, scene = Bag(pose_bag), SETUP.scene.add(SceneShape("post", "instrument", Disc((0.0, 0.006), 0.002)))
    too_fine = SETUP.scene.add(SceneShape("pin", "instrument", Disc((0.0, 0.006), 1e-5)))
    with BagWriter(tmp_path / "told", source.notes) as writer:
        for topic, type_name in (
            *source.topics.items(),
            (SCENE.recorded, SCENE.type_name),
            (MATERIAL.recorded, MATERIAL.type_name),
        ):
            writer.add_topic(topic, type_name)
        for render_bag in source.records(set(source.topics)):
            writer.write(render_bag.topic, render_bag.time, render_bag.data)
        for time, told, version in ((1.39, scene, scene.version), (1.5, scene, "f" * 16), (1.61, too_fine, "")):
            stamp = round(time * 1e9)
            message: Any = typestore().deserialize_cdr(packed_scene(stamp, told), SCENE.type_name)
            message.version = version or message.version
            writer.write_message(SCENE.recorded, stamp, message)
        silk = make(
            MATERIAL.type_name,
            header=BUILDER.header(stamp, "dish"),
            name="silk_6_0",
            diameter=0.0,
            elastic_modulus=0.0,
            viscosity=0.0,
            drag_anisotropy=0.0,
            rest_curvature=np.empty(0),
            attachment="",
            attachment_offset=np.empty(0),
        )
        writer.write_message(MATERIAL.recorded, stamp, silk)
    for start, first in ((0.0, 12), (0.5, 0)):
        seen = ObservationReader(Recording(Bag(tmp_path / "told")), SETUP, start=start)
        steps = list(predictions(seen, SETUP.model, SETUP.scene))
        assert [step.scene for step in steps] == [SETUP.scene] * first + [scene] * (len(steps) - first)
        assert [step.result.scene_version for step in steps] == [step.scene.version for step in steps if step.scene]
        assert {step.settings.material for step in steps} == {SETUP.model.material, "silk_6_0"}
        assert steps[-1].settings.material == "silk_6_0"
        assert all(step.result.prediction is not None for step in steps)
        assert sum(seen.refused.values()) == 2
    replay_offline(tmp_path / "told", tmp_path / "again")
    said = [render_bag.decode().version for render_bag in Bag(tmp_path / "again" / "bag").records({SCENE.recorded})]
    # So that what comes of it can be replayed in its turn.
    assert said[:2] == [SETUP.scene.version, scene.version]


def test_the_true_pull_comes_with_the_pose_of_its_stamp(tmp_path: Path):
    stamps = [k * 10**8 for k in range(1, 5)]
    with BagWriter(tmp_path / "bag", {}) as bag:
        for channel in (NEEDLE_POSE, GROUND_TRUTH_PULL):
            bag.add_topic(channel.recorded, channel.type_name)
        for k, stamp in enumerate(stamps):
            pose = packed_pose(stamp, np.zeros(2), np.array([1.0, 0.0]))
            bag.write(NEEDLE_POSE.recorded, stamp, pose)
            pull = packed_wrench(stamp, np.array([1e-6 * k, math.nan if k == 1 else -2e-6]), 3e-9)
            if k == 2:
                pull = pull.replace(b"dish", b"else")
            if k < 3:
                bag.write(GROUND_TRUTH_PULL.recorded, stamp, pull)
    reader = ObservationReader(
        Recording(Bag(tmp_path / "bag")), read_setup("petri_35mm_polyamide"), "poses", 0.0, None, lambda share: None
    )
    first, *others = reader
    assert first.true_pull == pytest.approx([0.0, -2e-6])
    assert [len(each.true_pull) for each in others] == [0, 0, 0]
    assert sum("thread_pull" in why for why in reader.refused) >= 1
    assert [each.stamp for each in (first, *others)] == stamps
