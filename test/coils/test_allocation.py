"""From velocities to currents."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.coils.allocation import CoilArray

FOUR = (0.0, np.pi / 2, np.pi, -np.pi / 2)


@pytest.mark.parametrize(
    ("velocity", "currents"),
    [
        ((0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        ((0.005, 0.0), (1.0, 0.0, 0.0, 0.0)),
        ((-0.01, 0.0), (0.0, 0.0, 2.0, 0.0)),
        ((0.005, -0.01), (1.0, 0.0, 0.0, 2.0)),
    ],
)
def test_the_coil_ahead_pulls(velocity: tuple[float, float], currents: tuple[float, ...]):
    found = CoilArray(FOUR, 0.005, 5.0).allocate(np.array(velocity))
    np.testing.assert_allclose(found.currents, currents, atol=1e-3)
    np.testing.assert_allclose(found.velocity, velocity, atol=1e-5)
    assert not found.saturated


def test_saturation_is_reported_with_the_velocity_really_reached():
    found = CoilArray(FOUR, 0.005, 2.0).allocate(np.array([0.05, 0.0]))
    assert found.saturated
    assert found.currents[0] == pytest.approx(2.0)
    np.testing.assert_allclose(found.velocity, [0.01, 0.0], atol=1e-5)


@given(vx=st.floats(-1.0, 1.0), vy=st.floats(-1.0, 1.0), turn=st.floats(-3.0, 3.0))
def test_currents_never_leave_their_limits(vx: float, vy: float, turn: float):
    coils = CoilArray([angle + turn for angle in FOUR], 0.005, 3.0)
    found = coils.allocate(np.array([vx, vy]))
    assert (found.currents >= 0.0).all()
    assert (found.currents <= 3.0).all()
    assert np.all(np.isfinite(found.currents))
    reach = np.hypot(vx, vy)
    if reach < 0.01:
        np.testing.assert_allclose(found.velocity, [vx, vy], atol=2e-4 * max(reach, 1e-6) + 1e-6)
