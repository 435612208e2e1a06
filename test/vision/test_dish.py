"""The dish is found, and only where there is one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import DishCamera, Scene
from magnetosuture_thread.vision.dish import find_dish

FAR = np.array([0.1, 0.1])


@pytest.mark.parametrize(
    ("centre", "scale", "seed"), [((322.0, 238.0), 8e-5, 0), ((300.4, 246.7), 8.6e-5, 1), ((341.0, 231.0), 9.5e-5, 2)]
)
def test_the_dish_is_found_to_half_a_pixel(centre: tuple[float, float], scale: float, seed: int):
    camera = DishCamera(Scene(), DishView(centre, scale), seed=seed)
    frame = camera.render(np.zeros(2), 0.3, np.array([[0.0, 0.0], [-0.01, 0.0]]))
    found = find_dish(np.ascontiguousarray(frame[:, :, 1]), 0.035)
    assert found is not None
    assert np.linalg.norm(np.subtract(found.centre_px, centre)) < 0.5
    assert found.metres_per_pixel == pytest.approx(scale, rel=5e-3)


def test_no_dish_is_found_where_there_is_none():
    noise = np.random.default_rng(0).integers(150, 200, (480, 640)).astype(np.uint8)
    plain = np.full((480, 640), 180, np.uint8)
    square = plain.copy()
    cv2.rectangle(square, (150, 60), (500, 410), 20, 8)
    for image in (noise, plain, square):
        assert find_dish(image, 0.035) is None
