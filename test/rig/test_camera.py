"""The simulated camera."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera

THREAD = np.array([[0.0, 0.0], [-0.005, 0.001], [-0.01, 0.0]])


@pytest.mark.parametrize("tail", [(0.024, 0.0), (0.0, 0.02), (-0.03, -0.03), (1.0, 1.0)])
def test_a_needle_partly_or_wholly_out_of_the_image_is_drawn_without_an_error(tail: tuple[float, float]):
    camera = DishCamera(CameraScene(), DishView((322.0, 238.0), 8e-5), seed=4)
    assert camera.render(np.asarray(tail), 0.5, THREAD + tail).shape == (480, 640, 3)
