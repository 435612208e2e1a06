"""Pixels and the dish frame."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.geometry.camera import DishView


def test_axes_and_scale():
    view = DishView((322.0, 238.0), 8e-5)
    np.testing.assert_allclose(view.to_dish(np.array([322.0, 238.0])), [0.0, 0.0])
    np.testing.assert_allclose(view.to_dish(np.array([332.0, 228.0])), [8e-4, 8e-4])


def test_there_and_back():
    view = DishView((300.5, 200.25), 1.3e-4)
    points = np.random.default_rng(1).uniform(-0.02, 0.02, (20, 2))
    np.testing.assert_allclose(view.to_dish(view.to_pixels(points)), points, atol=1e-15)
