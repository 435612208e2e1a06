"""Headings and quaternions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.orientation import heading_angle, heading_from_quaternion, yaw_quaternion


@pytest.mark.parametrize("angle", np.linspace(-3.0, 3.0, 13).tolist())
def test_a_heading_comes_back_from_its_quaternion(angle: float):
    z, w = yaw_quaternion(angle)
    heading = heading_from_quaternion(0.0, 0.0, z, w, "field")
    assert heading == pytest.approx([math.cos(angle), math.sin(angle)], abs=1e-15)
    assert heading_angle(heading) == pytest.approx(angle, abs=1e-15)


@pytest.mark.parametrize(
    ("quaternion", "words"),
    [
        ((0.0, 0.0, 0.0, 0.0), "norm 0"),
        ((0.0, 0.0, 0.0, float("nan")), "norm nan"),
        ((1e300, 0.0, 0.0, 1e300), "expected a unit quaternion"),
        ((0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), "upright"),
    ],
)
def test_what_is_no_heading_is_refused(quaternion: tuple[float, float, float, float], words: str):
    with pytest.raises(InvalidInputError, match=words):
        heading_from_quaternion(*quaternion, "field")
