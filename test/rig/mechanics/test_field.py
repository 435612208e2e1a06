"""The coils' field against closed forms, numerical integration and Maxwell's equations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.rig.mechanics.field import MU_0, Coil, CoilField

RADIUS = 0.02
LOOP = Coil((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), RADIUS, 0.0, 1.0)
AXIS = np.array([1.0, 2.0, -0.5]) / math.sqrt(5.25)
TILTED = Coil((0.03, -0.02, 0.01), tuple(AXIS), 0.025, 0.03, 480.0)


def biot_savart(points: NDArray[np.float64], radius: float, count: int = 4000) -> NDArray[np.float64]:
    """Return the flux density of a loop around z by the trapezoidal rule, which is spectral on a circle."""
    angle = 2.0 * math.pi * np.arange(count) / count
    place = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    piece = 2.0 * math.pi / count * radius * np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(count)])
    away = points[:, None, :] - place
    return (
        MU_0 / (4.0 * math.pi) * np.sum(np.cross(piece, away) / np.linalg.norm(away, axis=2)[:, :, None] ** 3, axis=1)
    )


def derivatives(field: CoilField, point: NDArray[np.float64], h: float = 2e-5) -> NDArray[np.float64]:
    """Return dB_j / dx_i of the first coil by differences of fourth order."""

    def at(step: float) -> NDArray[np.float64]:
        return field.per_current(point + step * np.eye(3))[0]

    return (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h)


def test_a_solenoid_on_its_axis():
    length, turns = 0.03, 480.0
    coil = Coil((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), RADIUS, length, turns)
    z = np.array([0.0, 0.01, 0.025, 0.05])
    ends = [(z + end) / np.hypot(z + end, RADIUS) for end in (0.5 * length, -0.5 * length)]
    expected = 0.5 * MU_0 * turns / length * (ends[0] - ends[1])
    points = np.column_stack([0.0 * z, 0.0 * z, z])
    found = CoilField([coil]).per_current(points)[0, :, 2]
    # Half a radius beyond its end and farther, and within the coil itself.
    np.testing.assert_allclose(found[2:], expected[2:], rtol=1e-6)
    np.testing.assert_allclose(found, expected, rtol=2e-5)
    np.testing.assert_allclose(CoilField([coil], loops=20).per_current(points)[0, :, 2], expected, rtol=1e-10)


@pytest.mark.parametrize("rho", [1e-12, 1e-6, 1e-4, 1.0e-4 * RADIUS, 0.0051 * RADIUS, 0.4 * RADIUS, 1.3 * RADIUS])
def test_a_loop_off_its_axis(rho: float):
    # The power series ends and the closed form begins near 0.005 radii.
    points = np.array([[rho * 0.6, -rho * 0.8, z] for z in (-0.7 * RADIUS, 0.2 * RADIUS, 3.0 * RADIUS)])
    found, expected = CoilField([LOOP]).per_current(points)[0], biot_savart(points, RADIUS)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11 * float(np.abs(expected).max()))
    slope = 0.75 * MU_0 * RADIUS**2 * points[:, 2] / (RADIUS**2 + points[:, 2] ** 2) ** 2.5
    if rho < 1e-5:
        np.testing.assert_allclose(found[:, 0], slope * points[:, 0], rtol=1e-6)


def test_the_field_obeys_maxwell():
    field = CoilField([TILTED])
    for point in np.random.default_rng(1).uniform(-0.01, 0.01, (5, 3)):
        slopes = derivatives(field, point)
        size = np.abs(slopes).max()
        assert abs(np.trace(slopes)) < 1e-7 * size
        assert np.abs(slopes - slopes.T).max() < 1e-7 * size
