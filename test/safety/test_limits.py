"""Limits on vectors and on their change."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.safety.limits import approached, shortened


@pytest.mark.parametrize("vector", [(0.0, 0.0), (1e-320, 0.0), (3.0, -4.0), (1e308, 1e308), (-1e-5, 2e-5)])
@pytest.mark.parametrize("largest", [1e-6, 0.02, 1e3])
def test_a_vector_is_no_longer_than_allowed_and_keeps_its_direction(vector: tuple[float, float], largest: float):
    short = shortened(np.array(vector), largest)
    assert np.hypot(*short) <= largest * (1.0 + 1e-12)
    assert np.arctan2(*short) == pytest.approx(np.arctan2(*vector), rel=1e-12)
    if np.hypot(*vector) <= largest:
        assert short.tolist() == pytest.approx(vector, rel=1e-12)


def test_a_change_takes_as_many_steps_as_it_must():
    value, wanted = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    seen = []
    while not np.array_equal(value, wanted):
        value = approached(value, wanted, 0.5)
        seen.append(value.tolist())
    assert seen == [[1.0, 0.5], [1.0, 0.0], [1.0, -0.5], [1.0, -1.0]]
