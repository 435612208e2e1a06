"""The needle's shape, poles and resistance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.rig.mechanics.field import Coil, CoilField
from magnetosuture_thread.rig.mechanics.needle import NeedleBody

FIELD = CoilField([Coil((0.05, 0.02, 0.0), (-1.0, 0.3, 0.0), 0.025, 0.03, 480.0)])


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


def test_half_a_circle_has_the_mean_drag_in_every_direction():
    needle = body(curvature=math.pi / 7e-3)
    along, across, _ = needle.drag
    mean = 0.5 * (along + across)
    np.testing.assert_allclose(needle.resistance[:2, :2], mean * np.eye(2), rtol=1e-9, atol=1e-9 * mean)
    np.testing.assert_allclose(needle.tip, [0.0, 2.0 * 7e-3 / math.pi], atol=1e-15)


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


def test_a_small_needle_is_a_dipole():
    needle = body(length=2e-4, diameter=2e-5)
    heading = 0.7
    direction = np.array([math.cos(heading), math.sin(heading)])
    moment = needle.pole * needle.length * direction
    assert needle.pole * needle.length == pytest.approx(1e6 * math.pi * 1e-10 * 2e-4)
    middle = np.array([0.004, -0.003])

    def at(place: np.ndarray) -> np.ndarray:
        return 2.0 * FIELD.per_current(np.array([[*place, 0.0]]))[0, 0, :2]

    half, h = 0.5 * needle.length * direction, 1e-4
    force, torque = needle.wrench(at(middle - half), at(middle + half), heading)
    slopes = np.array([(at(middle + h * e) - at(middle - h * e)) / (2.0 * h) for e in np.eye(2)])
    np.testing.assert_allclose(force, moment @ slopes, rtol=1e-4)
    about_middle = torque - (half[0] * force[1] - half[1] * force[0])
    field = at(middle)
    assert about_middle == pytest.approx(moment[0] * field[1] - moment[1] * field[0], rel=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [{"length": 5e-4}, {"diameter": -1.0}, {"curvature": 1e3}, {"magnetisation": math.inf}, {"viscosity": 0.0}],
)
def test_a_wrong_needle_is_refused(wrong: dict):
    with pytest.raises(ConfigurationError, match=next(iter(wrong))):
        body(**wrong)
