"""One thread from many bags: the shared stiffness, what differs between bags, and their intervals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import t as student

from magnetosuture_thread.calibration.fleet import fleet_mean


def test_equal_bags_are_averaged_by_their_weights():
    found = fleet_mean(np.array([1.0, 1.0, 4.0]), np.array([1.0, 1.0, 1e3]))
    assert found.mean == pytest.approx(1.0, abs=1e-5)
    assert found.scatter == 0.0
    assert found.offsets == pytest.approx([0.0, 0.0, 3.0], abs=1e-5)
    assert found.offset_halves[2] == pytest.approx(1960.0, rel=1e-3)


def test_bags_that_differ_by_more_than_their_errors_count_alike():
    values, errors = np.array([-0.2, 0.2, -0.1, 0.1]), np.full(4, 0.02)
    found = fleet_mean(values, errors)
    assert found.mean == pytest.approx(0.0, abs=1e-3)
    assert found.scatter**2 == pytest.approx(np.var(values, ddof=1) - 0.02**2)
    assert found.half == pytest.approx(student.ppf(0.975, 3) * np.std(values, ddof=1) / 2.0)


def test_intervals_hold_the_true_values_as_often_as_they_say():
    rng = np.random.default_rng(7)
    tau, runs, bags = 0.1, 2000, 8
    held, offsets_held, scatters = 0, 0, []
    for _ in range(runs):
        errors = rng.uniform(0.02, 0.15, bags)
        offsets = tau * rng.standard_normal(bags)
        found = fleet_mean(3.0 + offsets + errors * rng.standard_normal(bags), errors)
        held += abs(found.mean - 3.0) <= found.half
        offsets_held += int((abs(found.offsets - offsets) <= found.offset_halves).sum())
        scatters.append(found.scatter**2)
    deviation = math.sqrt(0.95 * 0.05 / runs)
    assert abs(held / runs - 0.95) < 4.0 * deviation
    assert 0.93 < offsets_held / (runs * bags) < 0.97
    assert math.sqrt(np.mean(scatters)) == pytest.approx(tau, rel=0.1)
