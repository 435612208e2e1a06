"""The dish is found where it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera, Lighting
from magnetosuture_thread.vision.dish import (
    LONG_SEARCH,
    DishWatch,
    find_dish,
    see_dish,
)
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from test.vision.scenes import NOWHERE, Pose, finger, render


def gray_of(centre: tuple[float, float], scale: float, seed: int, lighting: Lighting | None = None) -> np.ndarray:
    """Return the measured channel of a frame with a needle."""
    camera = DishCamera(CameraScene(), DishView(centre, scale), seed=seed, lighting=lighting)
    return np.ascontiguousarray(camera.render(np.zeros(2), 0.3, NOWHERE)[:, :, 1])


@pytest.mark.parametrize(
    ("centre", "scale", "seed"), [((322.0, 238.0), 8e-5, 0), ((300.4, 246.7), 8.6e-5, 1), ((341.0, 231.0), 9.5e-5, 2)]
)
@pytest.mark.parametrize("lighting", [Lighting(), Lighting(gain=0.5, slope=4.0, noise=3.0)])
def test_the_dish_is_found_to_a_quarter_of_a_pixel(centre, scale: float, seed: int, lighting: Lighting):
    found = find_dish(gray_of(centre, scale, seed, lighting), 0.035)
    assert found is not None
    assert np.linalg.norm(np.subtract(found.centre_px, centre)) < 0.25
    assert found.metres_per_pixel == pytest.approx(scale, rel=6e-3)


def test_a_hand_over_a_third_of_the_rim_does_not_move_the_dish():
    frame = render(Pose(np.zeros(2), 0.3), covers=(finger(np.array([0.008, 0.0]), 0.0, 0.024, (120.0, 150.0, 200.0)),))
    found = find_dish(np.ascontiguousarray(frame[:, :, 1]), 0.035)
    assert found is not None
    assert np.linalg.norm(np.subtract(found.centre_px, (322.0, 238.0))) < 0.5
    assert found.metres_per_pixel == pytest.approx(8e-5, rel=6e-3)


def test_a_dish_that_only_its_ellipse_tells_is_found_within_a_few_frames():
    bright = np.full((480, 640), 225, np.uint8)
    cv2.circle(bright, (322, 238), 200, 255, -1, cv2.LINE_AA)  # too little contrast for a rim
    assert see_dish(bright, VisionTrackerSettings(), 0.035, photographed=False) is None
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    assert watch.look(bright)[0] == ""  # in the first frame at once
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    for _ in range(2):
        assert watch.look(0 * bright)[0] != ""
    reasons = [watch.look(bright)[0] for _ in range(LONG_SEARCH)]
    assert reasons[0] != ""
    assert reasons[-1] == ""
