"""Process noise: learned from innovations, and what errors that are left say of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from magnetosuture_thread.model.estimator.correction import CorrectionBuffers, MeasuredPoints
from magnetosuture_thread.model.estimator.innovations import WindowSums, weigh
from magnetosuture_thread.model.estimator.noise import (
    GRID,
    LEARNING_PRIOR,
    MAX_SQUARE,
    RATIO_TIME,
    SCALE_TIME,
    SURE,
    SWITCHING,
    WINDOWS,
    NoiseBank,
    grow,
    intensity_with_excess,
    interpolate_to_nodes,
    learn,
    match_innovations,
    shift_errors,
)
from magnetosuture_thread.model.estimator.noise_model import NoiseModel, propagate_errors, take_correction


def bank_with(errors: np.ndarray, deviation: float) -> NoiseBank:
    """Return a bank that expects an error of the estimate in each window, with a standard deviation [m]."""
    bank = NoiseBank.of(WINDOWS)
    bank.error[:] = errors[:, None]
    bank.variance[:] = deviation**2
    return bank


def intensity_of(bank: NoiseBank, *, settled: bool = True) -> np.ndarray:
    intensity = np.empty(WINDOWS)
    intensity_with_excess(bank, np.zeros(WINDOWS), 0.1, settled, intensity)
    return intensity


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_errors_of_all_windows_together_raise_the_noise_of_all(side: float) -> None:
    """None of them alone would be sure: the thread as a whole is wrong by little."""
    errors = side * np.linspace(0.5, 2.5, WINDOWS)
    assert np.abs(errors).max() < SURE
    bank = bank_with(1e-5 * errors, 1e-5)
    expected = 1e-10 * np.maximum(errors**2 - 1.0, 0.0).mean() / 0.1
    np.testing.assert_allclose(intensity_of(bank), expected, rtol=1e-12)
    np.testing.assert_array_equal(intensity_of(bank, settled=False), bank.intensity)


def test_errors_as_expected_raise_nothing() -> None:
    errors = np.random.default_rng(1).normal(0.0, 1.0, WINDOWS)
    bank = bank_with(1e-5 * errors, 1e-5)
    assert (errors**2).mean() < 2.0
    np.testing.assert_array_equal(intensity_of(bank), bank.intensity)


def test_an_error_of_one_window_that_is_sure_raises_the_noise_there() -> None:
    errors = np.zeros(WINDOWS)
    errors[4] = 4.0
    bank = bank_with(1e-5 * errors, 1e-5)
    raised = intensity_of(bank)
    assert raised[4] == pytest.approx(bank.intensity[4] + 1e-10 * (16.0 - 9.0) / 0.1)
    np.testing.assert_array_equal(np.delete(raised, 4), np.delete(bank.intensity, 4))


def test_each_intensity_has_a_kalman_filter_and_the_likelihood_of_its_innovation() -> None:
    rng, interval, forgotten = np.random.default_rng(2), 0.03, 0.5
    bank = NoiseBank.of(2)
    bank.error[:], bank.variance[:] = 1e-5 * rng.normal(size=(2, 12)), 1e-10 * rng.uniform(0.5, 2.0, (2, 12))
    before, innovation, variance = bank.copied(), np.array([3e-5, 0.0]), np.array([2e-10, np.inf])
    learn(bank, GRID, innovation, variance, interval, forgotten)
    prior = before.variance + GRID * interval
    np.testing.assert_allclose(1.0 / bank.variance[0], 1.0 / prior[0] + 1.0 / variance[0])
    np.testing.assert_allclose(
        bank.error[0] / bank.variance[0], before.error[0] / prior[0] + innovation[0] / variance[0]
    )
    likely = norm.pdf(innovation[0], before.error[0], np.sqrt(prior[0] + variance[0]))
    weight = before.weight[0] ** np.exp(-interval / forgotten) * likely
    switched = SWITCHING * interval
    weight = (1.0 - switched) * weight / weight.sum() + switched / 12
    np.testing.assert_allclose(bank.weight[0], weight)
    assert bank.intensity[0] == pytest.approx(np.prod(GRID**weight))
    # Where nothing is measured only the doubt grows.
    np.testing.assert_allclose(bank.variance[1], prior[1])
    for one, other in ((bank.error, before.error), (bank.weight, before.weight), (bank.intensity, before.intensity)):
        np.testing.assert_array_equal(one[1], other[1])
    shift_errors(bank, np.array([0.0, 2e-6]))
    np.testing.assert_allclose(bank.error[1], before.error[1] - 2e-6)


def test_what_is_expected_of_innovations_is_matched_to_those_of_a_frame() -> None:
    """Of three windows the second was not measured in the frame before, and the third is not now."""
    unit, scale, ratio, nan = 2e-3, 1.5, 0.8, np.nan
    sums = WindowSums(
        np.array([0.02, -0.01, nan]), np.array([3e-4, 2e-4, np.inf]), np.array([1e-4, 4e-4, nan]), np.ones(3)
    )
    last, last_variance = np.array([0.05, nan, 0.01]) * unit, np.array([1e-4, np.inf, 1e-4]) * unit**2
    mean, variance, expected = np.empty((3, 3))
    found = match_innovations(sums, unit, scale, ratio, 0.03, 1.0, last, last_variance, mean, variance, expected)
    np.testing.assert_allclose(mean, sums.mean * unit)
    np.testing.assert_allclose(variance, np.array([2e-4, 4e-4 / 3.0, np.inf]) * unit**2)
    np.testing.assert_allclose(expected, 0.8 * np.array([4e-4, 6e-4, nan]) * unit**2)
    square = 0.5 * (0.02**2 / (0.8 * 4e-4) + 0.01**2 / (0.8 * 6e-4))
    assert found[1] == pytest.approx(0.8 * np.exp(0.03 / RATIO_TIME * (square - 1.0)))
    of_camera = 0.03**2 / (2e-4 + 1e-4)  # (nu_k - nu_{k-1})^2 / 2 r
    assert found[0] == pytest.approx(1.5 + 0.03 / (1.0 + LEARNING_PRIOR) * (of_camera - 1.5))
    surprise = sums._replace(mean=100.0 * sums.mean)
    found = match_innovations(surprise, unit, scale, ratio, 0.03, 99.0, last, last_variance, mean, variance, expected)
    assert found[1] == pytest.approx(0.8 * np.exp(0.03 / RATIO_TIME * (MAX_SQUARE - 1.0)))
    assert found[0] == pytest.approx(1.5 + 0.03 / (SCALE_TIME + LEARNING_PRIOR) * (16.0 - 1.5))


def points_along(rng: np.random.Generator, count: int, segments: int) -> MeasuredPoints:
    """Return points in the first half of a thread, with innovations that none of the robust weights takes for wrong."""
    place = np.sort(rng.uniform(0.0, 0.5 * segments, count))
    variance = rng.uniform(1e-4, 2e-4, count)
    return MeasuredPoints(place, 1e-3 * rng.normal(size=count), variance, rng.uniform(0.2, 1.0, count))


def test_sums_of_the_windows_are_those_of_their_points() -> None:
    rng, segments = np.random.default_rng(3), 12
    points, prior = points_along(rng, 40, segments), rng.uniform(1e-5, 1e-4, 13)
    weights, sums = np.empty(40), WindowSums.of(4)
    weigh(points, prior, weights, sums)
    np.testing.assert_array_equal(weights, 1.0)
    for w in range(2):
        inside = (points.place >= 3.0 * w) & (points.place < 3.0 * (w + 1))
        precision = (points.share / points.variance)[inside]
        assert sums.own[w] == pytest.approx(1.0 / precision.sum())
        assert sums.mean[w] == pytest.approx(np.average(points.innovation[inside], weights=precision))
        known = np.interp(points.place[inside], np.arange(13), prior)
        assert sums.known[w] == pytest.approx(np.average(known, weights=precision))
        assert sums.independent[w] == pytest.approx(points.share[inside].sum())
    assert np.isnan(sums.mean[2:]).all()
    assert np.isinf(sums.own[2:]).all()


def test_a_correction_leaves_its_covariance_across_the_thread_and_the_information_of_the_points() -> None:
    rng, segments = np.random.default_rng(4), 12
    points, work = points_along(rng, 40, segments), CorrectionBuffers.of(segments + 1)
    angles, root = rng.uniform(-3.0, 3.0, 13), rng.normal(size=(13, 2, 2))
    work.normals[:] = np.column_stack([np.cos(angles), np.sin(angles)])
    work.covariance[:], work.moved[:] = root @ root.transpose(0, 2, 1), rng.normal(size=(13, 2))
    before = rng.uniform(1e-4, 1e-3, 13)
    density, variance, bank, unit = before.copy(), np.empty(13), NoiseBank.of(4), 2e-3
    hidden = take_correction(points, np.ones(40), work, unit, bank, density, variance)
    np.testing.assert_allclose(variance, np.einsum("ia,iab,ib->i", work.normals, work.covariance, work.normals))
    precision, gained = points.share / points.variance, np.zeros(13)
    for place, value in zip(points.place, precision, strict=True):
        gained += value * np.clip(1.0 - np.abs(np.arange(13) - place), 0.0, None)
    np.testing.assert_allclose(1.0 / density[1:] - 1.0 / before[1:], gained[1:], rtol=1e-9, atol=1e-6)
    assert density[0] == 0.0
    across = np.interp(points.place, np.arange(13), np.einsum("ia,ia->i", work.normals, work.moved))
    for w in range(2):
        inside = (points.place >= 3.0 * w) & (points.place < 3.0 * (w + 1))
        np.testing.assert_allclose(bank.error[w], -unit * np.average(across[inside], weights=precision[inside]))
    np.testing.assert_array_equal(bank.error[2:], 0.0)
    assert hidden == pytest.approx(1.0 - len(set(points.place.astype(int))) / segments)


def test_the_noise_of_a_node_is_that_of_its_window_and_between_two_their_geometric_mean() -> None:
    noise = np.empty(9)
    interpolate_to_nodes(np.array([1e-14, 1e-10, 1e-12, 1e-12]), 9, noise)
    np.testing.assert_allclose(noise, [1e-14, 1e-14, 1e-12, 1e-10, 1e-11, 1e-12, 1e-12, 1e-12, 1e-12])


def test_a_prior_grows_by_noise_that_was_larger_and_never_shrinks() -> None:
    before, after = np.full(4, 1e-12), np.array([5e-12, 5e-12, 1e-13, 1e-13])
    variance, density = np.full(9, 1e-3), np.full(9, 2e-3)
    grow(before, after, 1e9, 3.0, variance, density)
    grown = np.array([0.0, 4e-3, 4e-3, 4e-3])  # the needle's place is known
    np.testing.assert_allclose(variance[:4] - 1e-3, grown, atol=1e-12)
    np.testing.assert_allclose(density[:4] - 2e-3, 3.0 * grown, atol=1e-12)
    np.testing.assert_allclose(variance[5:], 1e-3)


def test_over_a_step_errors_go_with_the_thread_and_grow_by_its_noise() -> None:
    """The thread slides by 0.3 segments along itself; in a second its noise is 4e-6 m^2/s over D^2."""
    unit, nodes = 2e-3, np.column_stack([-np.arange(9.0), np.zeros(9)])
    before, after, interval = unit * nodes, unit * (nodes + np.array([0.3, 0.1])), 0.5
    variance, density = np.linspace(0.0, 0.8, 9) ** 2, np.linspace(0.0, 1.6, 9) ** 2
    places, added = np.maximum(np.arange(9) - 0.3, 0.0), np.array([0.0, *[0.5] * 8])
    expected = [np.interp(places, np.arange(9), each) for each in (variance, density)]
    propagate_errors(after, before, unit, np.full(16, 4e-6), interval, 3.0, variance, density)
    np.testing.assert_allclose(variance, expected[0] + added)
    np.testing.assert_allclose(density, expected[1] + 3.0 * added)


def test_of_the_first_frame_no_noise_is_known_and_later_ones_count_by_the_time_before() -> None:
    """Innovations that change sides from frame to frame are those of points ten times worse than the camera says."""
    model, unit, count, camera = NoiseModel(0.4), 1e-3, 48, 1e-4
    place, weights, sums, scale = np.linspace(0.1, 11.9, count), np.empty(count), WindowSums.of(WINDOWS), 1.0
    for k in range(5):
        innovation = np.full(count, (-1.0) ** k * np.sqrt(10.0 * camera / 2.0 / 3.0))  # 3 points in a window
        points = MeasuredPoints(place, innovation, np.full(count, camera * model.scale), np.ones(count))
        variance, density = np.full(13, 1e-9), np.full(13, 1e-9)
        found, _ = model.learn(points, weights, sums, unit, 0.03, 1.0, variance, density)
        if k == 0:
            assert model.ratio == 1.0
            np.testing.assert_allclose(found.variance, (sums.own + sums.known) * unit**2)
        else:
            scale += 0.03 / (0.03 * k + LEARNING_PRIOR) * (10.0 - scale)
            assert model.ratio != 1.0
        assert model.scale == pytest.approx(scale, rel=1e-6)
