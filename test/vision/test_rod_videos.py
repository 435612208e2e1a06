"""A blunt rod in drawn videos of a dish without a dark rim."""

from __future__ import annotations

import math

import pytest

from benchmarks.vision.photographs import DIAMETER
from benchmarks.vision.rod_video import FRAME_RATE, SETTINGS, is_right, rod_video
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.scene.scene import Dish
from magnetosuture_thread.vision.tracker import VisionTracker

FRAMES = 5


@pytest.mark.parametrize(
    ("index", "seed"),
    [
        (6, 1),  # a bright rim around a bright floor
        (0, 2),  # a thin line over an end of the rod
    ],
)
def test_a_rod_without_a_thread_is_found_and_its_heading_is_unknown(index: int, seed: int):
    video, tracker = rod_video(index, seed), VisionTracker(SETTINGS, Scene(dish=Dish(DIAMETER)))
    found = 0
    for frame in range(FRAMES):
        photo, ends = video.image(frame)
        track = tracker.track(photo.image, frame / FRAME_RATE)
        assert tracker.dish is not None
        assert not tracker.dish.dark_field
        if len(track.tail):  # Another edge of the wall may be taken for the dish's in a frame, which then gives none.
            found += 1
            assert is_right(track, tracker.dish, ends, video.rows)
            assert track.covariance[2, 2] > math.pi**2 - 1.0
    assert found >= FRAMES - 1
