"""The needle's shape, poles and resistance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.rig.mechanics.needle import NeedleBody


def body(**changes: float) -> NeedleBody:
    given = {"length": 7e-3, "diameter": 4e-4, "curvature": 0.0, "magnetisation": 1e6, "viscosity": 1.0}
    return NeedleBody(**{**given, **changes})


def test_a_straight_needle_has_the_drag_of_a_cylinder():
    needle = body()
    p, unit = 17.5, math.pi * 7e-3
    along = 2.0 * unit / (math.log(p) - 0.207 + 0.980 / p - 0.133 / p**2)
    across = 4.0 * unit / (math.log(p) + 0.839 + 0.185 / p + 0.233 / p**2)
    turn = unit * 7e-3**2 / (3.0 * (math.log(p) - 0.662 + 0.917 / p - 0.050 / p**2))
    arm = 3.5e-3
    expected = [[along, 0.0, 0.0], [0.0, across, across * arm], [0.0, across * arm, turn + across * arm**2]]
    np.testing.assert_allclose(needle.resistance, expected, rtol=1e-12, atol=1e-18)
    # Slender bodies sink nearly twice as fast along themselves; turning costs more than the local drag says.
    assert 1.2 < across / along < 2.0
    assert turn > across * 7e-3**2 / 12.0


def test_a_curved_needle_is_an_arc_to_the_left_and_its_mirror_image_to_the_right():
    left, right = body(curvature=100.0), body(curvature=-100.0)
    outline = left.outline(50)
    np.testing.assert_allclose(np.hypot(outline[:, 0], outline[:, 1] - 0.01), 0.01, rtol=1e-12)
    assert (outline[1:, 1] > 0.0).all()
    assert np.linalg.norm(np.diff(outline, axis=0), axis=1).sum() == pytest.approx(7e-3, rel=1e-3)
    mirror = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(mirror @ left.resistance @ mirror, right.resistance, rtol=1e-12)
    assert np.linalg.eigvalsh(left.resistance).min() > 0.0
    np.testing.assert_allclose(left.resistance, left.resistance.T, rtol=1e-12)
    nearly = body(curvature=1e-4)
    np.testing.assert_allclose(nearly.resistance, body().resistance, rtol=1e-6, atol=1e-8)
