"""The correction is the measurement update of a Kalman filter, on the thread's constraints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread import Disc
from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.estimator.correction import (
    Corrector,
    Prior,
    normals_of,
    prior_information,
    robust_weights,
)
from magnetosuture_thread.estimator.estimator import clearance_bound
from magnetosuture_thread.thread.program import StepBuffers, program_of
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import as_quadratic_program
from magnetosuture_thread.thread_observation import ThreadObservation
from test.estimator.threads import (
    LENGTH,
    RATE,
    error_percent,
    estimator_of,
    piece_of,
    poses,
    predictor_of,
    thread_of,
    true_shapes,
    whole,
)

NODES = 13


def bent_chain(rng: np.random.Generator) -> np.ndarray:
    turns = np.concatenate([[0.3], rng.normal(0.0, 0.15, NODES - 2)]).cumsum()
    return np.vstack([np.zeros(2), np.column_stack([np.cos(turns), np.sin(turns)]).cumsum(axis=0)])


def measured(rng: np.random.Generator, count: int) -> MeasuredPoints:
    return MeasuredPoints(
        np.sort(rng.uniform(0.2, NODES - 1.0, count)),
        rng.normal(0.0, 0.05, count),
        rng.uniform(1e-4, 1e-3, count),
        rng.uniform(0.3, 1.0, count),
        np.ones(count),
    )


def dense_rows(points: MeasuredPoints, nodes: np.ndarray) -> np.ndarray:
    rows = np.zeros((len(points.place), 2 * NODES))
    for p, place in enumerate(points.place):
        i = min(int(place), NODES - 2)
        t = place - i
        along = nodes[i + 1] - nodes[i]
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        rows[p, 2 * i : 2 * i + 2], rows[p, 2 * i + 2 : 2 * i + 4] = (1.0 - t) * normal, t * normal
    return rows


def dense_of(buffers: StepBuffers, known: np.ndarray, rows: int) -> np.ndarray:
    """Return P of a program, dense."""
    program = as_quadratic_program(program_of(buffers, known, rows))
    upper = program.P.toarray()[: 2 * NODES, : 2 * NODES]
    return upper + upper.T - np.diag(np.diag(upper))


@pytest.mark.parametrize("clamped", [False, True])
def test_prior_information_is_the_one_that_is_documented(clamped: bool) -> None:
    rng = np.random.default_rng(1)
    nodes, known = bent_chain(rng), np.zeros(NODES, dtype=np.bool_)
    density, noise = rng.uniform(0.5, 2.0, NODES), rng.uniform(0.5, 2.0, NODES)
    normals, buffers = normals_of(nodes), StepBuffers.of(NODES, 2, 1)
    length, stiffness, scale = 2.0, 0.7, 3.0
    prior = Prior(nodes, np.array([1.0, 0.0]), density, noise, length, stiffness)
    prior_information(prior, scale, clamped, buffers)
    found = dense_of(buffers, known, 0)
    for _ in range(5):
        d = rng.normal(0.0, 1.0, (NODES, 2))
        across = np.einsum("ia,ia->i", normals, d)
        value = (across**2 / density).sum() + 1e-6 * (np.einsum("ia,ia->i", d, d) / density).sum()
        middle = 0.5 * (density[1:] + density[:-1])
        value += (length**2 / middle * ((d[1:] - d[:-1]) ** 2).sum(axis=1)).sum()
        bend = d[2:] - 2.0 * d[1:-1] + d[:-2]
        value += (2.0 * stiffness / noise[1:-1] * (bend**2).sum(axis=1)).sum()
        if clamped:
            value += stiffness / noise[0] * float(((2.0 * (d[1] - d[0])) ** 2).sum())
        assert d.ravel() @ found @ d.ravel() == pytest.approx(value / scale, rel=1e-10)


STRAIGHT = np.column_stack([-np.arange(float(NODES)), np.zeros(NODES)])


def test_correction_agrees_with_a_dense_kalman_filter() -> None:
    """A straight thread has no constraint across it, so that across it the update is the plain one."""
    rng = np.random.default_rng(4)
    points = measured(rng, 40)
    points = points._replace(innovation=1e-3 * points.innovation, variance=np.full(40, 1e-4), share=np.ones(40))
    predictor = predictor_of(thread_of(NODES - 1))
    assert isinstance(predictor.formulation, RodFormulation)
    corrector = Corrector(predictor, predictor.formulation)
    prior = Prior(STRAIGHT, np.array([1.0, 0.0]), np.full(NODES, 3e-4), np.ones(NODES), 2.0, 0.5)
    assert not corrector.solve(prior, points)
    assert corrector.residual < 1e-6
    check = StepBuffers.of(NODES, 2, 1)
    prior_information(prior, 1.0, False, check)
    information = dense_of(check, np.zeros(NODES, dtype=np.bool_), 0)[2:, 2:][1::2, 1::2]
    rows = dense_rows(points, STRAIGHT)[:, 3::2]
    covariance = np.linalg.inv(information)
    spread = rows @ covariance @ rows.T + np.diag(points.variance)
    gain = covariance @ rows.T @ np.linalg.inv(spread)
    np.testing.assert_allclose(corrector.work.moved[1:, 1], gain @ points.innovation, rtol=1e-3, atol=1e-8)
    left = covariance - gain @ rows @ covariance
    np.testing.assert_allclose(corrector.work.covariance[1:, 1, 1], np.diag(left), rtol=1e-3)
    assert np.abs(corrector.work.moved[:, 0]).max() < 1e-6  # the chords hold it along the thread


def test_a_point_that_errs_alone_counts_little_and_one_that_errs_with_its_neighbours_counts_fully() -> None:
    residual, variance, weights = np.zeros(20), np.full(20, 1e-4), np.full(20, 0.5)
    residual[4], residual[10:17] = 0.1, -0.1
    change = robust_weights(residual, variance, weights)
    assert weights[4] == pytest.approx(5.0 / (4.0 + 0.1**2 / 1e-4))
    np.testing.assert_allclose(np.delete(weights, 4), 1.0)
    assert change == pytest.approx(0.5)


@pytest.mark.parametrize("end", [(0.0, np.inf), (2e-5, 3e-4)])
def test_sensitivity_information_and_score_are_those_of_a_dense_filter(end: tuple[float, float]) -> None:
    thread, rng = thread_of(NODES - 1), np.random.default_rng(7)
    predictor = predictor_of(thread)
    formulation = predictor.formulation
    assert isinstance(formulation, RodFormulation)
    start, points = bent_chain(rng), measured(rng, 40)
    points = points._replace(innovation=2e-4 * points.innovation, end=end)
    density, noise = rng.uniform(0.5e-3, 2e-3, NODES), rng.uniform(0.5e-3, 2e-3, NODES)
    stiffness = thread.bending_stiffness / (thread.medium.drag_across * thread.segment_length**4)
    prior = Prior(start, np.array([-1.0, 0.0]), density, noise, 1.3, stiffness)
    corrector = Corrector(predictor, formulation)
    assert not corrector.solve(prior, points)
    derivative = rng.normal(0.0, 1.0, (NODES, 2))
    derivative[0] = 0.0
    found = corrector.sensitivity(derivative)
    # The chain's chords are not quite those of its arcs, which moves it without innovations too.
    turned = points._replace(innovation=-points.innovation, weight=np.ones(40), end=(-end[0], end[1]))
    corrector.solve(prior, turned)
    other = corrector.sensitivity(derivative)
    score, square = 0.5 * (found.score - other.score), 0.5 * (found.square + other.square)

    buffers = StepBuffers.of(NODES, 2, 1)
    scale = max((1.0 / density[1:]).max(), (points.share / points.variance).max())
    prior_information(prior, scale, False, buffers)
    information = scale * dense_of(buffers, np.zeros(NODES, dtype=np.bool_), 0)
    along = np.diff(start, axis=0)
    for i in range(NODES - 1):  # chords that do not change
        row = np.zeros(2 * NODES)
        row[2 * i : 2 * i + 2], row[2 * i + 2 : 2 * i + 4] = -along[i], along[i]
        information += 1e9 * np.outer(row, row)
    rows, innovation, variance = dense_rows(points, start), points.innovation, points.variance / points.share
    if np.isfinite(end[1]):
        last = np.append(np.zeros(2 * NODES - 2), along[-1])
        rows, innovation, variance = np.vstack([rows, last]), np.append(innovation, end[0]), np.append(variance, end[1])
    covariance = np.zeros((2 * NODES, 2 * NODES))
    covariance[2:, 2:] = np.linalg.inv(information[2:, 2:])
    of_innovations = rows @ covariance @ rows.T + np.diag(variance)
    by = rows @ derivative.ravel()
    gained = np.linalg.solve(of_innovations, by)
    assert found.information == pytest.approx(by @ gained, rel=2e-3)
    assert score == pytest.approx(gained @ innovation, rel=2e-3)
    assert square == pytest.approx(innovation @ np.linalg.solve(of_innovations, innovation), rel=2e-3)
    assert found.independent == pytest.approx(points.share.sum() + np.isfinite(end[1]))
    corrected = derivative.ravel() - covariance @ rows.T @ gained
    np.testing.assert_allclose(found.corrected.ravel(), corrected, atol=2e-3)


def test_deviation_matches_the_spread_of_estimates() -> None:
    """Of a thread at rest whose shape is known to nobody at first, estimates spread as the covariance says."""
    thread = thread_of()
    rest = poses(2, speed=0.0, turn=0.0)
    truth = np.column_stack([-np.linspace(0.0, LENGTH, 26), np.zeros(26)])
    found, told = [], []
    for seed in range(40):
        estimator = estimator_of(thread)
        estimator.start(rest[0], truth)
        estimate = estimator.step(rest[1], ThreadObservation((piece_of(truth, seed),), True))
        found.append(estimate.positions[5:, 1])
        told.append(estimate.deviation[5:])
    ratio = np.sqrt(np.square(found).mean() / np.square(told).mean())
    assert 0.5 < ratio < 1.5


def test_constraints_hold_after_a_correction() -> None:
    """A measured thread that lies in an obstacle, and is too long, leaves the estimate outside and as long as it is."""
    disc = Disc((-0.008, 0.0015), 1.2e-3)
    thread = thread_of()
    estimator = estimator_of(thread, (disc,))
    way = poses(30, turn=0.0)
    first = np.column_stack([-np.linspace(0.0, LENGTH, 26), np.zeros(26)])
    estimator.start(way[0], first)
    for k, pose in enumerate(way[1:]):
        seen = first + pose.tail
        seen[:, 1] += 1.5e-3 * np.sin(np.linspace(0.0, np.pi, 26))  # through the disc
        estimate = estimator.step(pose, ThreadObservation((piece_of(1.02 * seen, k),), True))
        assert estimate.converged
        gap = np.linalg.norm(estimate.positions - np.array(disc.centre), axis=1) - disc.radius - 0.5 * thread.diameter
        assert gap.min() > -1.5e-7
        assert (
            np.abs(
                estimator.predictor.formulation.rest_lengths(estimate.positions, pose.heading)
                / np.linalg.norm(np.diff(estimate.positions, axis=0), axis=1)
                - 1.0
            ).max()
            < 1.5e-3
        )


def test_a_wrong_model_is_corrected() -> None:
    way = poses(150)
    truth = true_shapes(thread_of(material="polyamide_7_0"), way)
    estimator, alone = estimator_of(thread_of()), estimator_of(thread_of()).predictor
    estimator.start(way[0])
    alone.start(way[0])
    for k, pose in enumerate(way[1:], 1):
        estimate, prediction = estimator.step(pose, whole(truth[k], k)), alone.step(pose)
    assert estimate.corrected
    assert RATE * estimate.unmeasured_for < 0.5
    assert error_percent(estimate.positions, truth[-1]) < 0.15 < 1.0 < error_percent(prediction.positions, truth[-1])


def test_bound_of_clearance_is_below_the_clearance_by_the_deviation() -> None:
    disc, way = Disc((-0.008, 0.003), 1.2e-3), poses(5, turn=0.0)
    estimator = estimator_of(thread_of(), (disc,))
    estimator.start(way[0])
    estimate = estimator.step(way[1], whole(true_shapes(thread_of(), way)[1], 1))
    formulation = estimator.predictor.formulation
    rows = {each.name: each for each in formulation.margins(estimate.positions, way[1].heading)}["obstacle"]
    bound = estimate.margins["obstacle"].bound
    node, last = rows.nodes[:, -1], len(estimate.positions) - 1
    beside = [np.clip(node + apart, 0, last) for apart in (-1, 0, 1)]  # the half segments' clearance is of these too
    deviations = [
        np.sqrt(np.einsum("ra,rab,rb->r", rows.gradient[:, 0], estimate.covariance[at], rows.gradient[:, 0]))
        for at in beside
    ]
    expected = rows.clearance - 2.3263 * np.max(deviations, axis=0)
    np.testing.assert_allclose(bound, expected, rtol=1e-4)
    assert (bound < rows.clearance)[node > 0].all()
    flat = replace(rows, gradient=np.zeros_like(rows.gradient))  # which no motion of a node changes
    np.testing.assert_array_equal(clearance_bound(flat, estimate.covariance), rows.clearance)
