"""The gain of each coil, estimated from the direction in which the needle lies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import CoilGainEstimator
from magnetosuture_thread.coils.settings import CoilBridgeSettings

SETTINGS = CoilBridgeSettings(motion_compensation=True)
COILS, NEEDLE = SETTINGS.coil_field(), SETTINGS.needle()
NOISE = 5e-3  # rad; of a tracked heading
FRAME = 0.05


def lie_along_field(
    estimator: CoilGainEstimator, gains: NDArray[np.float64], count: int, seed: int, turned: float = 0.0
) -> None:
    """Apply random currents and measure the needle that lies along the true field, turned from it by an angle."""
    random = np.random.default_rng(seed)
    for k in range(count):
        currents, middle = random.uniform(-4.0, 4.0, len(gains)), random.uniform(-0.005, 0.005, 2)
        angle = 0.0
        for _ in range(20):  # the field at the poles, where the needle lies along it
            chord = 0.5 * NEEDLE.chord * np.array([math.cos(angle), math.sin(angle)])
            field = 0.5 * (COILS.per_current(middle - chord) + COILS.per_current(middle + chord)) @ (gains * currents)
            angle = math.atan2(field[1], field[0])
        angle += turned + NOISE * random.standard_normal()
        heading = np.array([math.cos(angle), math.sin(angle)])
        stamp = 1.0 + FRAME * k
        estimator.apply(stamp - 0.01, currents)
        estimator.update(middle - 0.5 * NEEDLE.chord * heading, heading, stamp)


@pytest.mark.parametrize("seed", range(5))
def test_gains_are_found_but_for_a_common_factor(seed: int):
    gains = 1.0 + 0.05 * np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, 4)
    estimator = CoilGainEstimator(COILS, NEEDLE.kinematics)
    lie_along_field(estimator, gains, 200, seed)
    assert np.abs(gains / gains.mean() - 1.0).max() > 0.01
    np.testing.assert_allclose(estimator.gains / estimator.gains.mean(), gains / gains.mean(), atol=0.005)


def test_a_needle_that_something_holds_across_the_field_says_nothing_of_the_gains():
    gains = np.array([1.04, 0.97, 1.0, 0.99])
    estimator = CoilGainEstimator(COILS, NEEDLE.kinematics)
    lie_along_field(estimator, gains, 200, 4)
    before = estimator.gains.copy()
    lie_along_field(estimator, gains, 20, 5, turned=0.6)
    np.testing.assert_array_equal(estimator.gains, before)
