"""Process noise: learned from innovations, and what errors that are left say of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.estimator.noise import (
    GRID,
    LEARNING_PRIOR,
    NOISE_TIME,
    SURE,
    SWITCHING,
    WINDOWS,
    NoiseModel,
    learn,
    learn_intensity,
    raised_intensity,
)


def raised_by(errors: np.ndarray, *, settled: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return intensities of windows whose filters expect an error, in standard deviations of 10 um, and before."""
    model, shape = NoiseModel.new(), (WINDOWS, len(GRID))
    known = np.broadcast_to(1e-5 * errors[:, None], shape).copy(), np.full(shape, 1e-10)
    everywhere = np.ones(WINDOWS, dtype=np.bool_)
    return raised_intensity(*known, model.likelihood, model.intensity, everywhere, 0.1, settled), model.intensity


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_errors_of_all_windows_together_raise_the_noise_of_all(side: float) -> None:
    """None of them alone would be sure: the thread as a whole is wrong by little."""
    errors = side * np.linspace(0.5, 2.5, WINDOWS)
    assert np.abs(errors).max() < SURE
    expected = 1e-10 * np.maximum(errors**2 - 1.0, 0.0).mean() / 0.1
    np.testing.assert_allclose(raised_by(errors)[0], expected, rtol=1e-12)
    np.testing.assert_array_equal(*raised_by(errors, settled=False))


def test_each_intensity_has_a_kalman_filter_and_the_likelihood_of_its_innovation() -> None:
    rng, interval, model = np.random.default_rng(2), 0.03, NoiseModel.new()
    error, variance = 1e-5 * rng.normal(size=(2, 12)), 1e-10 * rng.uniform(0.5, 2.0, (2, 12))
    known = model.likelihood[:2], model.intensity[:2]
    before = model._replace(error=error, variance=variance, likelihood=known[0], intensity=known[1])
    innovation, own = np.array([3e-5, np.nan]), np.array([2e-10, np.inf])
    after = learn_intensity(before, innovation, own, interval)
    prior = variance + GRID * interval
    np.testing.assert_allclose(1.0 / after[1][0], 1.0 / prior[0] + 1.0 / own[0])
    np.testing.assert_allclose(after[0][0] / after[1][0], error[0] / prior[0] + innovation[0] / own[0])
    likely = norm.pdf(innovation[0], error[0], np.sqrt(prior[0] + own[0]))
    weight = before.likelihood[0] ** np.exp(-interval / NOISE_TIME) * likely
    switched = SWITCHING * interval
    weight = (1.0 - switched) * weight / weight.sum() + switched / 12
    np.testing.assert_allclose(after[2][0], weight)
    assert after[3][0] == pytest.approx(np.prod(GRID**weight))
    # Where nothing is measured only the doubt grows.
    np.testing.assert_allclose(after[1][1], prior[1])
    for old, new in ((error, after[0]), (before.likelihood, after[2]), (before.intensity, after[3])):
        np.testing.assert_array_equal(new[1], old[1])


def test_of_the_first_frame_no_noise_is_known_and_later_ones_count_by_the_time_before() -> None:
    """Innovations that change sides from frame to frame are those of points ten times worse than the camera says."""
    model, unit, count, camera, scale = NoiseModel.new(), 1e-3, 48, 1e-4, 1.0
    place = np.linspace(0.1, 11.9, count)
    for k in range(5):
        innovation = np.full(count, (-1.0) ** k * np.sqrt(10.0 * camera / 2.0 / 3.0))  # 3 points in a window
        variance = np.full(count, camera * model.scale)
        points = MeasuredPoints(place, innovation, variance, np.ones(count), np.ones(count))
        model, innovations, _ = learn(model, points, np.full((2, 13), 1e-9), unit, 0.03, 1.0)
        if k == 0:
            assert model.ratio == 1.0
            np.testing.assert_allclose(innovations.variance, (model.sums.own + model.sums.known) * unit**2)
        else:
            scale += 0.03 / (0.03 * k + LEARNING_PRIOR) * (10.0 - scale)
            assert model.ratio != 1.0
        assert model.scale == pytest.approx(scale, rel=1e-6)
