"""The limits on the size of a velocity and on its change."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.safety.motion import limit_pair, limit_velocity


@pytest.mark.parametrize("vector", [(0.0, 0.0), (1e-320, 0.0), (3.0, -4.0), (1e308, 1e308), (-1e-5, 2e-5)])
@pytest.mark.parametrize("max_norm", [1e-6, 0.02, 1e3])
def test_limit_pair_keeps_direction_and_maximum_norm(vector: tuple[float, float], max_norm: float):
    limited = limit_pair(*vector, max_norm)
    assert np.hypot(*limited) <= max_norm * (1.0 + 1e-12)
    assert np.arctan2(*limited) == pytest.approx(np.arctan2(*vector), rel=1e-12)
    if np.hypot(*vector) <= max_norm:
        assert limited == pytest.approx(vector, rel=1e-12)


def test_a_limited_change_reaches_the_target_in_the_fewest_steps():
    value: tuple[float, float] = (1.0, 1.0)
    values: list[tuple[float, float]] = []
    while value != (1.0, -1.0):
        x, y, _, _ = limit_velocity((1.0, -1.0), 1.0, math.inf, value, 0.5)
        value = (x, y)
        values.append(value)
    assert values == [(1.0, 0.5), (1.0, 0.0), (1.0, -0.5), (1.0, -1.0)]
