"""Rendering trajectories to simulated bags."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import parse_scene_message
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import BagError, ConfigurationError
from magnetosuture_thread.vision.images import decode_image

SETUP = read_setup("petri_35mm_polyamide")
FRAME, INFO, SCENE = "/camera/image_raw/compressed", "/camera/camera_info", "/scene"
POSE, MEASURED = "/needle/measured_cp", "/thread/measured"
MOTION = ("/needle/servo_cv", "/ground_truth/needle", "/ground_truth/thread")


def test_the_bag_holds_frames_commands_and_truth_and_says_that_it_is_simulated(short_bag: Path):
    bag = Bag(short_bag)
    assert bag.damage is None
    assert bag.counts == {SCENE: 1, **dict.fromkeys((FRAME, INFO, *MOTION), 30)}
    assert "straight_pull" in bag.notes["simulated"]
    first, *others = bag.records(set(bag.topics))
    assert (first.topic, first.time) == (SCENE, bag.start)
    assert parse_scene_message(first.decode()) == SETUP.scene
    messages = {record.topic: record.decode() for record in others}
    assert decode_image(messages[FRAME].data).shape == (480, 640, 3)
    assert messages["/needle/servo_cv"].twist.linear.x == pytest.approx(0.003, rel=1e-6)
    assert messages["/ground_truth/needle"].pose.position.x == pytest.approx(0.003 + 0.003 * 29 / 30)
    assert len(messages["/ground_truth/thread"].poses) == 51
    # A point 5 mm east of the dish's centre, 0.3 m below the camera, is seen 62.5 px right of it.
    assert messages[INFO].k[0] * 0.005 / 0.3 == pytest.approx(0.005 / (0.035 / (0.9115 * 480)))


@pytest.mark.parametrize(
    ("metadata", "discs", "words"),
    [
        ({"material": {"L_m": 0.15}}, (), r"thread_model\.thread_length: got 0\.019, expected 0\.15"),
        ({}, (Disc((0.0, 0.0), 0.002),), r"scene: got \(\), expected .*radius=0\.002"),
    ],
)
def test_a_setup_for_another_thread_is_refused(
    tmp_path: Path, straight_pull: ReferenceTrajectory, metadata: dict, discs: tuple[Disc, ...], words: str
):
    other = replace(straight_pull, metadata=metadata, discs=discs)
    with pytest.raises(ConfigurationError, match=words):
        render_bag(other, SETUP, tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("start", "duration"), [(0.5, 2.0), (-1.0, 0.5)])
def test_times_that_are_not_there_are_refused_and_nothing_is_left(tmp_path: Path, start: float, duration: float | None):
    times = np.linspace(0.0, 1.0, 5)
    reference = ReferenceTrajectory("short", times, np.zeros((5, 2)), np.zeros(5), np.zeros((5, 3, 2)), (), {})
    with pytest.raises(BagError, match="has the times 0 to 1 s"):
        render_bag(reference, SETUP, tmp_path / "bag", start=start, duration=duration)
    assert not (tmp_path / "bag").exists()


def test_poses_take_the_place_of_frames(tmp_path: Path, straight_pull: ReferenceTrajectory):
    bags = {}
    for name, seed in (("one", 3), ("same", 3), ("other", 4)):
        assert render_bag(straight_pull, SETUP, tmp_path / name, rate=60.0, pose_noise=1e-4, seed=seed) == 120
        bags[name] = Bag(tmp_path / name)
    bag = bags["one"]
    assert bag.counts == {SCENE: 1, **dict.fromkeys((POSE, MEASURED, *MOTION), 120)}
    poses, threads = (list(bag.records({topic})) for topic in (POSE, MEASURED))
    tails = np.array([(each.decode().pose.pose.position.x, each.decode().pose.pose.position.y) for each in poses])
    truth = np.array([straight_pull.at(index / 60.0)[0] for index in range(120)])
    assert np.std(tails - truth) == pytest.approx(1e-4, rel=0.2)
    assert poses[0].decode().pose.covariance[0] == pytest.approx(1e-8)
    measured = np.array(
        [[(each.pose.position.x, each.pose.position.y) for each in record.decode().poses] for record in threads]
    )
    assert measured.shape == (120, 64, 2)
    assert np.array_equal(measured[:, 0], tails)  # a measured thread begins at the measured tail
    assert np.std(measured[:, 1:, 1]) == pytest.approx(1e-4, rel=0.1)
    stored = {name: [record.data for record in made.records({POSE})] for name, made in bags.items()}
    assert stored["one"] == stored["same"] != stored["other"]
