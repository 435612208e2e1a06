"""Needle and thread beside the shapes of a scene: what the mask is for, each shown to fail without it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene_files import read_scene, scene_from_mapping
from magnetosuture_thread.rig import camera as drawn
from magnetosuture_thread.rig.camera import DishCamera, Look
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import Track, VisionTracker
from test.vision.scenes import PIXEL, VIEW, Pose, line_error

STEEL = Look((70.0, 66.0, 62.0), (60.0, 56.0, 52.0), 0.2e-3, 10.0, 3.0)
OUTLINED = Look((200.0, 205.0, 215.0), (95.0, 95.0, 95.0), 0.25e-3)
POST = Disc((0.0077, 0.0039), 0.0015)
NEEDLE_LIKE = [[0.002, 0.0098], [0.0076, 0.0098], [0.009, 0.00999], [0.009, 0.01001], [0.0076, 0.0102], [0.002, 0.0102]]


def described(**shapes: Mapping[str, object]) -> Scene:
    """Return a scene of a 35 mm dish with instruments."""
    made = {name: {**shape, "kind": "instrument"} for name, shape in shapes.items()}
    return scene_from_mapping({"dish": {"diameter": 0.035, "depth": 0.003}, "shapes": made})


def frame_of(scene: Scene, look: Look, pose: Pose, thread: np.ndarray) -> np.ndarray:
    """Draw a frame in which all shapes of a scene look alike."""
    what = drawn.CameraScene(obstacles=scene.obstacles, looks=[look] * len(scene.shapes))
    return DishCamera(what, VIEW, seed=3).render(pose.tail, pose.heading, thread)


def seen_with_and_without(scene: Scene, frame: np.ndarray) -> tuple[Track, Track]:
    """Return what is seen of a frame with the scene, and with its dish alone."""
    settings = VisionTrackerSettings()
    return VisionTracker(settings, scene).look(frame), VisionTracker(settings, Scene(scene.dish)).look(frame)


def test_an_instrument_that_looks_like_a_needle_is_not_taken_for_one():
    scene = described(pointer={"polygon": {"outline": NEEDLE_LIKE}})
    pose = Pose(np.array([-0.002, -0.004]), 0.7)
    frame = frame_of(scene, STEEL, pose, np.array([[0.5, 0.5], [0.51, 0.5]]))
    masked, plain = seen_with_and_without(scene, frame)
    assert pose.is_right(masked)
    assert plain.reason.startswith("2 needles in the dish")  # no thread tells which


def test_without_a_needle_an_instrument_that_looks_like_one_gives_no_pose():
    scene = described(pointer={"polygon": {"outline": NEEDLE_LIKE}})
    frame = frame_of(scene, STEEL, Pose(np.array([0.5, 0.5]), 0.0), np.array([[0.5, 0.5], [0.51, 0.5]]))
    masked, plain = seen_with_and_without(scene, frame)
    assert "inside of a shape of the scene" in masked.reason
    assert plain.reason == ""


@pytest.mark.parametrize("gap", [0.05e-3, 0.2e-3])
def test_a_needle_beside_a_dark_post_is_found(gap: float):
    scene = read_scene("dish_35mm_post")
    pose = Pose(np.array([0.0042, 0.0039 - POST.radius - 0.0002 - gap]), 0.0)
    frame = frame_of(scene, STEEL, pose, np.linspace(pose.tail, pose.tail - (0.012, 0.0), 30))
    masked, plain = seen_with_and_without(scene, frame)
    assert pose.is_right(masked)
    ends = np.vstack([pose.tail, pose.at(1.0)])
    assert np.abs(plain.axis - ends).max() < 2.0 * PIXEL  # without the mask the axis at least


def test_a_thread_that_ends_at_a_dark_outline_is_not_followed_around_it():
    scene = described(tool={"capsule": {"start": [-0.008, -0.004], "end": [0.005, -0.004], "radius": 0.0008}})
    thread = np.array([[0.0085, -0.0026], [0.005, -0.00316], [0.003, -0.00316]])
    pose = Pose(thread[0], float(np.arctan2(0.00056, 0.0035)))
    masked, plain = seen_with_and_without(scene, frame_of(scene, OUTLINED, pose, thread))
    length = np.linalg.norm(np.diff(thread, axis=0), axis=1).sum()
    excess = [np.linalg.norm(np.diff(s.centreline, axis=0), axis=1).sum() / length - 1.0 for s in (masked, plain)]
    assert excess[0] < 0.1
    assert excess[1] > 0.3
    assert line_error(masked.centreline / PIXEL, thread / PIXEL)[1] > 0.95
