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
    at_nodes,
    learn,
    propagate_errors,
    raised_intensity,
    take_correction,
    weigh,
)


def raised_by(errors: np.ndarray, *, settled: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return intensities of windows whose filters expect an error, in standard deviations of 10 um, and before."""
    model, shape = NoiseModel(), (WINDOWS, len(GRID))
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


def test_an_error_of_one_window_that_is_sure_raises_the_noise_there_and_expected_ones_nowhere() -> None:
    errors = np.zeros(WINDOWS)
    errors[4] = 4.0
    raised, before = raised_by(errors)
    assert raised[4] == pytest.approx(before[4] + 1e-10 * (16.0 - 9.0) / 0.1)
    np.testing.assert_array_equal(np.delete(raised, 4), np.delete(before, 4))
    np.testing.assert_array_equal(*raised_by(np.random.default_rng(1).normal(0.0, 1.0, WINDOWS)))


def test_each_intensity_has_a_kalman_filter_and_the_likelihood_of_its_innovation() -> None:
    rng, interval, model = np.random.default_rng(2), 0.03, NoiseModel()
    error, variance = 1e-5 * rng.normal(size=(2, 12)), 1e-10 * rng.uniform(0.5, 2.0, (2, 12))
    before = error, variance, model.likelihood[:2], model.intensity[:2]
    innovation, own = np.array([3e-5, np.nan]), np.array([2e-10, np.inf])
    after = learn(*before, innovation, own, interval)
    prior = variance + GRID * interval
    np.testing.assert_allclose(1.0 / after[1][0], 1.0 / prior[0] + 1.0 / own[0])
    np.testing.assert_allclose(after[0][0] / after[1][0], error[0] / prior[0] + innovation[0] / own[0])
    likely = norm.pdf(innovation[0], error[0], np.sqrt(prior[0] + own[0]))
    weight = before[2][0] ** np.exp(-interval / NOISE_TIME) * likely
    switched = SWITCHING * interval
    weight = (1.0 - switched) * weight / weight.sum() + switched / 12
    np.testing.assert_allclose(after[2][0], weight)
    assert after[3][0] == pytest.approx(np.prod(GRID**weight))
    # Where nothing is measured only the doubt grows.
    np.testing.assert_allclose(after[1][1], prior[1])
    for k in (0, 2, 3):
        np.testing.assert_array_equal(after[k][1], before[k][1])


def points_along(rng: np.random.Generator, count: int, segments: int) -> MeasuredPoints:
    """Return points in the first half of a thread, with innovations that none of the robust weights takes for wrong."""
    place = np.sort(rng.uniform(0.0, 0.5 * segments, count))
    variance = rng.uniform(1e-4, 2e-4, count)
    share = rng.uniform(0.2, 1.0, count)
    return MeasuredPoints(place, 1e-3 * rng.normal(size=count), variance, share, np.ones(count))


def test_sums_of_the_windows_are_those_of_their_points() -> None:
    rng, segments = np.random.default_rng(3), 32
    points, prior = points_along(rng, 80, segments), rng.uniform(1e-5, 1e-4, segments + 1)
    sums = weigh(points, prior)
    np.testing.assert_array_equal(points.weight, 1.0)
    for w in range(WINDOWS // 2):
        inside = (points.place >= 2.0 * w) & (points.place < 2.0 * (w + 1))
        precision = (points.share / points.variance)[inside]
        assert sums.own[w] == pytest.approx(1.0 / precision.sum())
        assert sums.mean[w] == pytest.approx(np.average(points.innovation[inside], weights=precision))
        known = np.interp(points.place[inside], np.arange(segments + 1), prior)
        assert sums.known[w] == pytest.approx(np.average(known, weights=precision))
        assert sums.independent[w] == pytest.approx(points.share[inside].sum())
    assert np.isnan(sums.mean[WINDOWS // 2 :]).all()
    assert np.isinf(sums.own[WINDOWS // 2 :]).all()


def test_a_correction_leaves_its_covariance_across_the_thread_and_the_information_of_the_points() -> None:
    rng, segments = np.random.default_rng(4), 32
    points, nodes = points_along(rng, 80, segments), segments + 1
    angles, root = rng.uniform(-3.0, 3.0, nodes), rng.normal(size=(nodes, 2, 2))
    normals, covariance = np.column_stack([np.cos(angles), np.sin(angles)]), root @ root.transpose(0, 2, 1)
    moved, density = rng.normal(size=(nodes, 2)), rng.uniform(1e-4, 1e-3, nodes)
    left, applied, hidden = take_correction(points, normals, moved, covariance, density)
    np.testing.assert_allclose(left[0], np.einsum("ia,iab,ib->i", normals, covariance, normals))
    precision, gained = points.share / points.variance, np.zeros(nodes)
    for place, value in zip(points.place, precision, strict=True):
        gained += value * np.clip(1.0 - np.abs(np.arange(nodes) - place), 0.0, None)
    np.testing.assert_allclose(1.0 / left[1, 1:] - 1.0 / density[1:], gained[1:], rtol=1e-9, atol=1e-6)
    across = np.interp(points.place, np.arange(nodes), np.einsum("ia,ia->i", normals, moved))
    for w in range(WINDOWS // 2):
        inside = (points.place >= 2.0 * w) & (points.place < 2.0 * (w + 1))
        assert applied[w] == pytest.approx(np.average(across[inside], weights=precision[inside]))
    np.testing.assert_array_equal(applied[WINDOWS // 2 :], 0.0)
    assert hidden == pytest.approx(1.0 - len(set(points.place.astype(int))) / segments)


def test_the_noise_of_a_node_is_that_of_its_window_and_between_two_their_geometric_mean() -> None:
    noise = at_nodes(np.array([1e-14, 1e-10, 1e-12, 1e-12]), 9)
    np.testing.assert_allclose(noise, [1e-14, 1e-14, 1e-12, 1e-10, 1e-11, 1e-12, 1e-12, 1e-12, 1e-12])


def test_over_a_step_errors_go_with_the_thread_and_grow_by_its_noise() -> None:
    """The thread slides by 0.3 segments along itself, and moves aside by 0.1."""
    unit, nodes = 2e-3, np.column_stack([-np.arange(9.0), np.zeros(9)])
    before, after = unit * nodes, unit * (nodes + np.array([0.3, 0.1]))
    errors, added = np.array([np.linspace(0.0, 0.8, 9), np.linspace(0.0, 1.6, 9)]) ** 2, np.full((2, 9), 0.5)
    places = np.maximum(np.arange(9) - 0.3, 0.0)
    expected = [np.interp(places, np.arange(9), each) + 0.5 for each in errors]
    np.testing.assert_allclose(propagate_errors(after, before, unit, added, errors), expected)


def test_of_the_first_frame_no_noise_is_known_and_later_ones_count_by_the_time_before() -> None:
    """Innovations that change sides from frame to frame are those of points ten times worse than the camera says."""
    model, unit, count, camera, scale = NoiseModel(), 1e-3, 48, 1e-4, 1.0
    place = np.linspace(0.1, 11.9, count)
    for k in range(5):
        innovation = np.full(count, (-1.0) ** k * np.sqrt(10.0 * camera / 2.0 / 3.0))  # 3 points in a window
        variance = np.full(count, camera * model.scale)
        points = MeasuredPoints(place, innovation, variance, np.ones(count), np.ones(count))
        found, _ = model.learn(points, np.full((2, 13), 1e-9), unit, 0.03, 1.0)
        if k == 0:
            assert model.ratio == 1.0
            np.testing.assert_allclose(found.variance, (model.sums.own + model.sums.known) * unit**2)
        else:
            scale += 0.03 / (0.03 * k + LEARNING_PRIOR) * (10.0 - scale)
            assert model.ratio != 1.0
        assert model.scale == pytest.approx(scale, rel=1e-6)
