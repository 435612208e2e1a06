"""Pixels and the dish frame."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView


def test_x_is_to_the_right_and_of_a_turned_dish_counter_clockwise_as_seen():
    np.testing.assert_allclose(DishView((322.0, 238.0), 8e-5).to_dish(np.array([332.0, 228.0])), [8e-4, 8e-4])
    view = DishView((320.0, 240.0), 1e-4, np.radians(90.0))
    np.testing.assert_allclose(view.to_pixels(np.array([1e-3, 0.0])), [320.0, 230.0], atol=1e-9)  # up in the image
    np.testing.assert_allclose(view.to_pixels(np.array([0.0, 1e-3])), [310.0, 240.0], atol=1e-9)
    np.testing.assert_allclose(view.directions_to_dish(np.array([0.0, -1.0])), [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("rotation", [0.0, 0.4, -2.9])
def test_there_and_back(rotation: float):
    view = DishView((300.5, 200.25), 1.3e-4, rotation)
    points = np.random.default_rng(1).uniform(-0.02, 0.02, (20, 2))
    np.testing.assert_allclose(view.to_dish(view.to_pixels(points)), points, atol=1e-15)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(view.directions_to_dish(view.directions_to_pixels(directions)), directions, atol=1e-15)


@pytest.mark.parametrize("factor", [4.0, 0.5])
def test_in_a_shrunk_image_a_point_is_as_far_from_the_images_corner(factor: float):
    """The corner of the top left pixel is at (-0.5, -0.5) in both; from there a pixel is as long as `factor` ones."""
    view, points = DishView((300.5, 200.25), 1.3e-4, 0.4), np.random.default_rng(1).uniform(-0.02, 0.02, (20, 2))
    shrunk = view.shrunk(factor)
    np.testing.assert_allclose(shrunk.to_pixels(points) + 0.5, (view.to_pixels(points) + 0.5) / factor, rtol=1e-12)
