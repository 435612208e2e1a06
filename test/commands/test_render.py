"""Recording simulated bags."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.errors import BagError, ConfigurationError
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.setups import read_setup
from magnetosuture_thread.vision.images import decode_image


def test_the_bag_holds_frames_commands_and_truth_and_says_that_it_is_simulated(short_bag: Path):
    bag = Bag(short_bag)
    assert bag.damage is None
    assert bag.counts == {
        "/camera/image_raw/compressed": 30,
        "/camera/camera_info": 30,
        "/needle/servo_cv": 30,
        "/scene": 1,
        "/ground_truth/needle": 30,
        "/ground_truth/thread": 30,
    }
    assert bag.notes["setup"] == "petri_35mm_polyamide"
    assert "straight_pull" in bag.notes["simulated"]
    messages = {render_bag.topic: render_bag.decode() for render_bag in bag.records(set(bag.topics))}
    assert decode_image(messages["/camera/image_raw/compressed"].data).shape == (480, 640, 3)
    assert messages["/needle/servo_cv"].twist.linear.x == pytest.approx(0.003, rel=1e-6)
    assert messages["/ground_truth/needle"].pose.position.x == pytest.approx(0.003 + 0.003 * 29 / 30)
    assert len(messages["/ground_truth/thread"].poses) == 51
    info = messages["/camera/camera_info"]
    # A point 5 mm east of the dish's centre, 0.3 m below the camera, is seen 62.5 px right of it.
    assert info.k[0] * 0.005 / 0.3 == pytest.approx(0.005 / (0.035 / (0.9115 * 480)))


@pytest.mark.parametrize(
    ("metadata", "discs", "words"),
    [
        ({"material": {"L_m": 0.15}}, (), r"thread_model\.thread_length: got 0\.019, expected 0\.15"),
        ({"boundary": "pinned"}, (), r"thread_model\.attachment: got 'clamped', expected pinned"),
        ({}, (Disc((0.0, 0.0), 0.002),), r"scene: got \(\), expected .*radius=0\.002"),
    ],
)
def test_a_setup_for_another_thread_is_refused(
    tmp_path: Path, straight_pull: ReferenceTrajectory, metadata: dict, discs: tuple[Disc, ...], words: str
):
    other = replace(straight_pull, metadata=metadata, discs=discs)
    with pytest.raises(ConfigurationError, match=words):
        render_bag(other, read_setup("petri_35mm_polyamide"), tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []


def test_times_that_are_not_there_are_refused_and_nothing_is_left(tmp_path: Path):
    times = np.linspace(0.0, 1.0, 5)
    reference = ReferenceTrajectory("short", times, np.zeros((5, 2)), np.zeros(5), np.zeros((5, 3, 2)), (), {})
    for start, duration in ((0.5, 2.0), (3.0, None), (-1.0, 0.5)):
        with pytest.raises(BagError, match="has the times 0 to 1 s"):
            render_bag(reference, read_setup("petri_35mm_polyamide"), tmp_path / "bag", start=start, duration=duration)
    assert not (tmp_path / "bag").exists()


def test_poses_take_the_place_of_frames(tmp_path: Path, straight_pull: ReferenceTrajectory):
    setup = read_setup("petri_35mm_polyamide")
    for name, seed in (("one", 3), ("same", 3), ("other", 4)):
        count = render_bag(straight_pull, setup, tmp_path / name, rate=60.0, pose_noise=1e-4, seed=seed)
        assert count == 120
    bag = Bag(tmp_path / "one")
    topics = (
        "/needle/measured_cp",
        "/thread/measured",
        "/needle/servo_cv",
        "/ground_truth/needle",
        "/ground_truth/thread",
    )
    assert bag.counts == {"/scene": 1, **dict.fromkeys(topics, 120)}
    assert bag.notes["simulated"] == "needle poses and seen thread from the reference trajectory straight_pull"
    off: list[float] = []
    turned: list[float] = []
    seen: list[float] = []
    for index, each in enumerate(bag.records({"/needle/measured_cp", "/thread/measured"})):
        message = each.decode()
        if each.topic == "/needle/measured_cp":
            tail, _, _ = straight_pull.at(index // 2 / 60.0)
            position = message.pose.pose.position
            off += [position.x - tail[0], position.y - tail[1]]
            turned.append(2.0 * np.arctan2(message.pose.pose.orientation.z, message.pose.pose.orientation.w))
            assert message.pose.covariance[0] == pytest.approx(1e-8)
        else:
            assert len(message.poses) == 64
            assert (message.poses[0].pose.position.x, message.poses[0].pose.position.y) == (position.x, position.y)
            seen += [pose.pose.position.y - 0.002 for pose in message.poses[1:]]
    assert np.std(off) == pytest.approx(1e-4, rel=0.2)
    assert np.std(seen) == pytest.approx(1e-4, rel=0.1)
    assert np.std(turned) == pytest.approx(1e-4 / setup.vision.needle_length, rel=0.3)
    data = {name: next((tmp_path / name).glob("*.mcap")).read_bytes() for name in ("one", "same", "other")}
    stored = {name: [each.data for each in Bag(tmp_path / name).records({topics[0]})] for name in data}
    assert stored["one"] == stored["same"] != stored["other"]


@pytest.mark.parametrize("poses", [False, True])
def test_a_bag_begins_with_the_scene(tmp_path: Path, straight_pull: ReferenceTrajectory, poses: bool):
    setup = read_setup("petri_35mm_polyamide")
    render_bag(straight_pull, setup, tmp_path / "bag", duration=0.2, pose_noise=0.0 if poses else None)
    bag = Bag(tmp_path / "bag")
    first = next(iter(bag.records(set(bag.topics))))
    assert first.topic == "/scene"
    assert first.time == bag.start
    assert parse_scene_message(first.decode()) == setup.scene
    assert sum(1 for _ in bag.records({"/scene"})) == 1
