"""The smooth path."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.guidance.path import SmoothPath

CORNERS = np.array([[0.0, 0.0], [0.01, 0.002], [0.012, 0.01], [0.0, 0.012]])


def test_path_passes_its_waypoints_with_the_initial_direction():
    path = SmoothPath(CORNERS, np.array([0.0, -1.0]))
    along = np.linspace(0.0, path.length, 5000)
    points = np.array([path.point(length) for length in along])
    for corner in CORNERS:
        assert np.linalg.norm(points - corner, axis=1).min() < 5e-6
    np.testing.assert_allclose(path.tangent(0.0), [0.0, -1.0], atol=1e-9)


def test_path_is_parametrised_by_arc_length():
    path = SmoothPath(CORNERS)
    step = path.length / 400
    for length in np.linspace(0.0, path.length - step, 50):
        moved = path.point(length + step) - path.point(length)
        assert np.linalg.norm(moved) == pytest.approx(step, rel=2e-3)
        assert moved / np.linalg.norm(moved) @ path.tangent(length + 0.5 * step) > 0.9999


def test_arc_length_is_clamped_to_the_path():
    path = SmoothPath(CORNERS)
    np.testing.assert_allclose(path.point(-1.0), CORNERS[0])
    np.testing.assert_allclose(path.point(path.length + 1.0), CORNERS[-1], atol=1e-12)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 2)),
        np.zeros((2, 2)),
        np.array([[0.0, 0.0], [np.nan, 1.0]]),
        CORNERS[[0, 1, 1, 2]],
        CORNERS[[0, 1, 1]] + [[0.0, 0.0], [0.0, 0.0], [0.0, 4e-19]],
    ],
    ids=["one point", "no way", "not finite", "twice the same", "almost the same"],
)
def test_invalid_waypoints_are_rejected(points: np.ndarray):
    with pytest.raises(InvalidInputError, match="waypoints"):
        SmoothPath(points)
