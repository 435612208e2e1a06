"""Limits on vectors and on their change."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.safety.limits import limit_norm, rate_limit


@pytest.mark.parametrize("vector", [(0.0, 0.0), (1e-320, 0.0), (3.0, -4.0), (1e308, 1e308), (-1e-5, 2e-5)])
@pytest.mark.parametrize("max_norm", [1e-6, 0.02, 1e3])
def test_limit_norm_keeps_direction_and_maximum_norm(vector: tuple[float, float], max_norm: float):
    limited = limit_norm(np.array(vector), max_norm)
    assert np.hypot(*limited) <= max_norm * (1.0 + 1e-12)
    assert np.arctan2(*limited) == pytest.approx(np.arctan2(*vector), rel=1e-12)
    if np.hypot(*vector) <= max_norm:
        assert limited.tolist() == pytest.approx(vector, rel=1e-12)


def test_rate_limit_reaches_the_target_in_the_fewest_steps():
    value, target = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    values = []
    while not np.array_equal(value, target):
        value = rate_limit(value, target, 0.5)
        values.append(value.tolist())
    assert values == [[1.0, 0.5], [1.0, 0.0], [1.0, -0.5], [1.0, -1.0]]
