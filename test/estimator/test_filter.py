"""The filter's parts against closed forms and dense algebra: association, correction, noise, disturbances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from magnetosuture_thread.estimator import Disturbance
from magnetosuture_thread.estimator.association import MeasuredPoints, measured_points, place_pieces, project
from magnetosuture_thread.estimator.correction import Corrector, Prior, normals_of, prior_information, robust_weights
from magnetosuture_thread.estimator.disturbance import BendingRelaxation, DisturbanceTest
from magnetosuture_thread.estimator.noise import (
    GRID,
    NOISE_TIME,
    SWITCHING,
    NoiseModel,
    learn_intensity,
)
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.program import StepBuffers, program_of
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import as_quadratic_program
from test.estimator.threads import LENGTH, RATE, estimator_of, piece_of, poses, predictor_of, thread_of

NODES = 13


@pytest.mark.parametrize("turn", [0.1, -0.1])
def test_points_on_the_arc_that_the_thread_bends_in_have_no_innovation(turn: float) -> None:
    """Nodes on a circle, one unit of its arc apart; between two of them it is up to 0.0125 beside their chord."""
    centre = np.array([0.0, 1.0 / turn])

    def on_arc(arcs: np.ndarray, outwards: float = 0.0) -> np.ndarray:
        return centre + (1.0 / turn - outwards) * np.column_stack([np.sin(turn * arcs), -np.cos(turn * arcs)])

    nodes, arcs = on_arc(np.arange(20.0)), np.arange(0.0, 12.0, 0.23)
    for left in (0.0, 0.02, -0.02):
        place, innovation = project(nodes, on_arc(3.1 + arcs, left), arcs, 3.1, 0.1)
        np.testing.assert_allclose(place, 3.1 + arcs, atol=0.01)
        np.testing.assert_allclose(innovation, left, atol=1e-4)


@pytest.mark.parametrize("beyond", [0.4, -0.3])
def test_a_piece_is_placed_from_either_end_and_its_free_end_is_measured_along_the_thread(beyond: float) -> None:
    turn = 0.1 * np.arange(25.0)
    nodes = np.vstack([np.zeros(2), np.cumsum(np.column_stack([np.cos(turn), np.sin(turn)]), axis=0)])
    along = nodes[-1] - nodes[-2]
    points = np.vstack([nodes[8:], nodes[-1] + beyond * along]) * 1e-3
    found = []
    for turned in (False, True):
        ends = (PieceEnd.UNKNOWN, PieceEnd.FREE)
        ends, given = (ends[::-1], points[::-1]) if turned else (ends, points)
        piece = ThreadPiece(given, np.full(len(points), 1e-5), *ends, (np.nan, np.nan), direction_known=False)
        placed, problems = place_pieces(ThreadObservation((piece,)), nodes, np.ones(26), 1e-3)
        assert not problems
        measured, _ = measured_points(placed, nodes, 0.01, 1.0, 1e-3, (Workspace((), 5e-3), 0.0))
        assert measured is not None
        assert measured.end[0] == pytest.approx(beyond)
        found.append(placed[0])
    for name in ("points", "variance", "share", "arcs", "start"):
        np.testing.assert_allclose(getattr(found[0], name), getattr(found[1], name), atol=1e-6, err_msg=name)


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


def test_correction_agrees_with_a_dense_kalman_filter() -> None:
    """A straight thread has no constraint across it, so that across it the update is the plain one."""
    rng, straight = np.random.default_rng(4), np.column_stack([-np.arange(float(NODES)), np.zeros(NODES)])
    points = measured(rng, 40)
    points = points._replace(innovation=1e-3 * points.innovation, variance=np.full(40, 1e-4), share=np.ones(40))
    predictor = predictor_of(thread_of(NODES - 1))
    assert isinstance(predictor.formulation, RodFormulation)
    corrector = Corrector(predictor, predictor.formulation)
    prior = Prior(straight, np.array([1.0, 0.0]), np.full(NODES, 3e-4), np.ones(NODES), 2.0, 0.5)
    correction = corrector.solve(prior, points)
    assert not correction.problem
    assert correction.residual < 1e-6
    check = StepBuffers.of(NODES, 2, 1)
    prior_information(prior, 1.0, False, check)
    information = dense_of(check, np.zeros(NODES, dtype=np.bool_), 0)[2:, 2:][1::2, 1::2]
    rows = dense_rows(points, straight)[:, 3::2]
    covariance = np.linalg.inv(information)
    spread = rows @ covariance @ rows.T + np.diag(points.variance)
    gain = covariance @ rows.T @ np.linalg.inv(spread)
    np.testing.assert_allclose(correction.moved[1:, 1], gain @ points.innovation, rtol=1e-3, atol=1e-8)
    left = covariance - gain @ rows @ covariance
    np.testing.assert_allclose(correction.covariance[1:, 1, 1], np.diag(left), rtol=1e-3)
    assert np.abs(correction.moved[:, 0]).max() < 1e-6  # the chords hold it along the thread


def test_a_point_that_errs_alone_counts_little_and_one_that_errs_with_its_neighbours_counts_fully() -> None:
    residual, variance, weights = np.zeros(20), np.full(20, 1e-4), np.full(20, 0.5)
    residual[4], residual[10:17] = 0.1, -0.1
    change = robust_weights(residual, variance, weights)
    assert weights[4] == pytest.approx(5.0 / (4.0 + 0.1**2 / 1e-4))
    np.testing.assert_allclose(np.delete(weights, 4), 1.0)
    assert change == pytest.approx(0.5)


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


@pytest.mark.parametrize("clamped", [False, True])
def test_relaxation_solves_its_equation(clamped: bool) -> None:
    rng, amount = np.random.default_rng(2), 3.7
    displacement, slope = rng.normal(size=(12, 2)), rng.normal(size=2)
    curvature = np.zeros((12, 12))
    for node in range(1, 11):
        curvature[node, node - 1 : node + 2] = 1.0, -2.0, 1.0
    curvature[0, :2] = (-np.sqrt(2.0), np.sqrt(2.0)) if clamped else 0.0
    relaxed = BendingRelaxation(11, clamped).relaxed(amount, displacement, slope)
    moment = curvature @ relaxed
    moment[0] -= np.sqrt(2.0) * slope if clamped else 0.0
    residual = relaxed - displacement + amount * curvature.T @ moment
    assert np.abs(residual[1:]).max() < 1e-12
    assert np.array_equal(relaxed[0], displacement[0])


def pushed(thread: Thread, node: int, size: float) -> np.ndarray:
    """Return by how much a force at a node displaces a straight thread across it in a frame, at most by a size [m]."""
    aside = np.zeros((thread.segments + 1, 2))
    aside[node, 1] = 1.0
    stiffness = thread.bending_stiffness / (thread.medium.drag_across * thread.segment_length**4)
    aside = BendingRelaxation(thread.segments, False).relaxed(stiffness / RATE, aside)
    return np.asarray(size / np.abs(aside).max() * aside)


def forces_found(contact: int | None, held: int) -> list[tuple[Disturbance, ...]]:
    """Return what is found of a thread held at a node, where the model knows of a contact of the node `contact`."""
    thread = Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=25, attachment=Attachment.PINNED)
    positions = np.column_stack([-thread.segment_length * np.arange(26.0), np.zeros(26)])
    normals = np.tile([0.0, -1.0], (26, 1))
    touched = np.zeros(26, dtype=np.bool_)
    touched[[] if contact is None else contact] = True
    test, found = DisturbanceTest(thread), []
    for k in range(15):
        test.decay(1.0 / RATE, touched)
        stamp, moved = k / RATE, pushed(thread, held, 4e-5)
        test.add(moved, normals, np.full(16, 1e-11), stamp, np.array([1e-5, 1e-3]))
        found.append(test.found(stamp, positions))
    return found


def test_what_a_known_contact_could_push_with_is_no_disturbance_and_a_force_elsewhere_is_found_where_it_is() -> None:
    assert any(forces_found(None, 25))
    assert not any(forces_found(25, 25))
    (found,) = forces_found(25, 12)[-1]
    assert found.arc_length == pytest.approx(12 / 25 * 0.019, abs=2e-3)
