"""The simulated camera."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera

THREAD = np.array([[0.0, 0.0], [-0.005, 0.001], [-0.01, 0.0]])


def render(seed: int, scene: CameraScene | None = None, tail: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return one frame."""
    camera = DishCamera(scene or CameraScene(), DishView((322.0, 238.0), 8e-5), seed=seed)
    return camera.render(np.asarray(tail), 0.5, THREAD + tail)


def test_the_same_seed_gives_the_same_frame():
    assert (render(1) == render(1)).all()
    assert (render(1) != render(2)).any()


def test_a_needle_partly_or_wholly_out_of_the_image_is_drawn_without_an_error():
    for tail in ((0.024, 0.0), (0.0, 0.02), (-0.03, -0.03), (1.0, 1.0)):
        assert render(4, tail=tail).shape == (480, 640, 3)
