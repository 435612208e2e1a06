"""The needle's shape and resistance, and the field of the coils."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.rig.dynamics import MU_0, CoilField, NeedleBody


def body(**changes: float) -> NeedleBody:
    given = {"length": 7e-3, "diameter": 4e-4, "curvature": 0.0, "magnetisation": 1e6, "viscosity": 1.0}
    return NeedleBody(**{**given, **changes})


def test_a_straight_needle_has_the_drag_of_a_cylinder():
    needle, arm = body(), 3.5e-3
    along, across, turn = needle.drag
    expected = [[turn + across * arm**2, 0.0, across * arm], [0.0, along, 0.0], [across * arm, 0.0, across]]
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
    mirror = np.diag([-1.0, 1.0, -1.0])
    np.testing.assert_allclose(mirror @ left.resistance @ mirror, right.resistance, rtol=1e-12)
    assert np.linalg.eigvalsh(left.resistance).min() > 0.0
    np.testing.assert_allclose(left.resistance, left.resistance.T, rtol=1e-12)
    nearly = body(curvature=1e-4)
    np.testing.assert_allclose(nearly.resistance, body().resistance, rtol=1e-6, atol=1e-8)


def test_the_field_of_a_coil_is_that_of_a_solenoid_on_its_axis():
    radius, length, turns, distance = 0.02, 0.03, 480.0, 0.1
    z = np.array([0.0, 0.01, 0.025, 0.05])
    ends = [(z + end) / np.hypot(z + end, radius) for end in (0.5 * length, -0.5 * length)]
    expected = 0.5 * MU_0 * turns / length * (ends[0] - ends[1])

    def found(loops: int) -> np.ndarray:
        field = CoilField([0.7], distance, radius, length, turns, loops)
        along = np.array([math.cos(0.7), math.sin(0.7)])
        return np.array([along @ field.per_current((distance - away) * along)[:, 0] for away in z])

    # Half a radius beyond its end and farther, and within the coil itself.
    np.testing.assert_allclose(found(6)[2:], expected[2:], rtol=1e-6)
    np.testing.assert_allclose(found(6), expected, rtol=2e-5)
    np.testing.assert_allclose(found(20), expected, rtol=1e-10)
