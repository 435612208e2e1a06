"""The smooth path."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.guidance.path import SAMPLES_PER_SPAN, SmoothPath

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


@pytest.mark.parametrize("direction", [None, np.array([0.6, -0.8])])
@pytest.mark.parametrize("count", [2, 3, 4, 30])
def test_path_is_the_cubic_spline_of_scipy(count: int, direction: np.ndarray | None):
    corners = np.random.default_rng(count).uniform(-0.015, 0.015, (count, 2))
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    start: tuple[Literal[1, 2], np.ndarray] = (2, np.zeros(2)) if direction is None else (1, direction)
    spline = CubicSpline(knots, corners, bc_type=(start, (2, np.zeros(2))))
    path, length = SmoothPath(corners, direction), 0.0
    for begin, end in pairwise(knots):
        at = np.linspace(begin, end, SAMPLES_PER_SPAN)
        points, tangents = spline(at), spline(at, 1)
        length += np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        np.testing.assert_allclose(path.point(length), points[-1], atol=1e-12)
        np.testing.assert_allclose(path.tangent(length), tangents[-1] / np.linalg.norm(tangents[-1]), atol=1e-9)
    assert path.length == pytest.approx(length, rel=1e-12)


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
