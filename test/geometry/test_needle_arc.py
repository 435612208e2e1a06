"""Arcs that needles lie along, their headings and quaternions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magnetosuture_thread.geometry.needle_arc import heading_angle, heading_from_quaternion, needle_axis, yaw_quaternion
from magnetosuture_thread.settings.errors import InvalidInputError

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


@pytest.mark.parametrize("angle", np.linspace(-3.0, 3.0, 13).tolist())
def test_a_heading_comes_back_from_its_quaternion(angle: float):
    z, w = yaw_quaternion(angle)
    heading = heading_from_quaternion(0.0, 0.0, z, w, "field")
    assert heading == pytest.approx([math.cos(angle), math.sin(angle)], abs=1e-15)
    assert heading_angle(heading) == pytest.approx(angle, abs=1e-15)


@pytest.mark.parametrize("size", [1.0, 0.9901, 1.0016, 1.0099])
def test_of_a_tilted_needle_the_heading_is_that_of_its_projection(size: float):
    rotations = Rotation.random(20, rng=np.random.default_rng(1))
    for quaternion, along in zip(rotations.as_quat(), rotations.apply([1.0, 0.0, 0.0])[:, :2], strict=True):
        x, y, z, w = (size * quaternion).tolist()
        heading = heading_from_quaternion(x, y, z, w, "field")
        assert math.hypot(*heading) == pytest.approx(1.0, abs=1e-12)
        assert heading == pytest.approx(along / np.linalg.norm(along), abs=1e-12)


@pytest.mark.parametrize(
    ("quaternion", "words"),
    [
        ((0.0, 0.0, 0.0, 0.0), "norm 0"),
        ((0.0, 0.0, 0.0, 1.012), "norm 1.012"),
        ((1e300, 0.0, 0.0, 1e300), "expected a unit quaternion"),
        ((0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), "upright"),
    ],
)
def test_what_is_no_heading_is_refused(quaternion: tuple[float, float, float, float], words: str):
    with pytest.raises(InvalidInputError, match=words):
        heading_from_quaternion(*quaternion, "field")
