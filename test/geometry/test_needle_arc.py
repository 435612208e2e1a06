"""Arcs that needles lie along."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.geometry.needle_arc import needle_axis, needle_points
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.shared_parameters import check_needle

LENGTH = 0.007


@pytest.mark.parametrize("curvature", [0.0, 1e-9, 200.0, -440.0])
def test_an_arc_has_its_length_its_tangents_and_its_curvature(curvature: float):
    at = np.linspace(0.0, 1.0, 2001)
    points, tangents = needle_axis(np.array([0.001, -0.002]), 0.7, LENGTH, curvature, at)
    steps = np.diff(points, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1).sum(), LENGTH, rtol=1e-6)
    np.testing.assert_allclose(steps / (LENGTH / 2000), 0.5 * (tangents[1:] + tangents[:-1]), atol=1e-6)
    turned = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    assert turned[0] == pytest.approx(0.7)
    assert (turned[-1] - turned[0]) / LENGTH == pytest.approx(curvature, abs=1e-6)


@pytest.mark.parametrize("curvature", [0.0, 150.0, -300.0])
def test_points_of_the_body_reach_from_tail_to_tip_and_move_as_a_rigid_body(curvature: float):
    spacing = 0.0006
    points, turning = needle_points(LENGTH, curvature, spacing)
    expected, _ = needle_axis(np.zeros(2), 0.0, LENGTH, curvature, np.linspace(0.0, 1.0, len(points)))
    np.testing.assert_allclose(points, expected, atol=1e-15)
    assert len(points) % 2 == 1
    assert LENGTH / (len(points) - 1) <= spacing < LENGTH / (len(points) - 3)
    # Turned by a small angle about the middle of the chord, each point moves by the angle times half of the chord.
    angle = 1e-7
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = 0.5 * points[-1]
    moved = (points - middle) @ rotation.T + middle - points
    np.testing.assert_allclose(moved / (np.linalg.norm(middle) * angle), turning, atol=1e-6)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_needle_may_turn_by_a_half_circle_and_no_more(side: float):
    check_needle("rig", LENGTH, side * math.pi / LENGTH)
    with pytest.raises(ConfigurationError, match=r"rig\.needle_curvature.* at most 458 1/m"):
        check_needle("rig", LENGTH, side * 1.03 * math.pi / LENGTH)
