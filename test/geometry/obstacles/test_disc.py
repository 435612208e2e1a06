"""Signed distances."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc


@pytest.mark.parametrize("dimension", [2, 3])
def test_signed_distance_and_its_gradient(dimension: int):
    disc = Disc(tuple(0.1 * np.arange(dimension)), 0.5)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, dimension))
    distance, normal = disc.signed_distance(points)
    inside = np.linalg.norm(points - disc.centre, axis=1) < 0.5
    assert ((distance < 0.0) == inside).all()
    for axis in range(dimension):
        step = np.zeros(dimension)
        step[axis] = 1e-6
        slope = (disc.signed_distance(points + step)[0] - disc.signed_distance(points - step)[0]) / 2e-6
        np.testing.assert_allclose(normal[:, axis], slope, atol=1e-6)


def test_the_centre_has_a_direction_too():
    distance, normal = Disc((0.1, 0.2), 0.5).signed_distance(np.array([[0.1, 0.2]]))
    assert distance.tolist() == [-0.5]
    assert np.linalg.norm(normal) == 1.0
