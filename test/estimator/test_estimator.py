"""The estimator: right and wrong models, bad input, disturbances; and its parts against dense algebra."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread import Disc
from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.estimator.correction import Corrector, Prior, prior_information
from magnetosuture_thread.estimator.disturbance import BendingRelaxation, Disturbance, DisturbanceTest
from magnetosuture_thread.estimator.estimator import EstimatorOptions, EstimatorSession, ThreadEstimator
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import points_at
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.program import StepBuffers, first_rows
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import as_quadratic_program
from test.estimator.threads import (
    DEVIATION,
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
from test.shared import known

UNKNOWN = (PieceEnd.UNKNOWN, PieceEnd.UNKNOWN, (math.nan, math.nan))  # ends and arc length of a piece


def unknown_place(nodes: np.ndarray, k: int) -> tuple[ThreadPiece, ...]:
    """Return a part of the thread of which neither place nor direction is known."""
    piece = piece_of(nodes, k, 0.4 * LENGTH, 0.8 * LENGTH)
    return (ThreadPiece(piece.points[:: -1 if k % 2 else 1], piece.deviation, *UNKNOWN, direction_known=False),)


def beside_another(nodes: np.ndarray, k: int) -> tuple[ThreadPiece, ...]:
    """Return the thread and another one."""
    other = np.column_stack([np.linspace(-0.012, 0.004, 60), np.full(60, 0.002)])
    return ThreadPiece(other, np.full(60, DEVIATION), *UNKNOWN, False), piece_of(nodes, k)


def with_outliers(nodes: np.ndarray, k: int) -> tuple[ThreadPiece, ...]:
    """Return the thread with a tenth of its points 5 mm away."""
    rng, piece = np.random.default_rng(k), piece_of(nodes, k)
    wrong = rng.random(len(piece.points)) < 0.1
    angle = rng.uniform(0.0, 2.0 * np.pi, wrong.sum())
    piece.points[wrong] += 5e-3 * np.column_stack([np.cos(angle), np.sin(angle)])
    return (piece,)


@pytest.mark.parametrize(
    ("seen", "hidden", "words"),
    [(unknown_place, 0.6, ""), (beside_another, 0.0, "of another one"), (with_outliers, 0.0, "")],
)
def test_pieces_of_the_thread_are_taken_and_others_refused(
    seen: Callable[[np.ndarray, int], tuple[ThreadPiece, ...]], hidden: float, words: str
) -> None:
    way, thread = poses(60), thread_of()
    truth, estimator = true_shapes(thread, way), estimator_of(thread_of(viscosity=1.3))
    estimator.start(way[0])
    for k, pose in enumerate(way[1:], 1):
        estimate = estimator.step(pose, ThreadObservation(seen(truth[k], k)))
        assert estimate.corrected
        assert (words in "".join(estimate.problems)) if words else not estimate.problems
        assert error_percent(estimate.positions, truth[k]) < 0.5
    assert estimate.hidden == pytest.approx(hidden, abs=0.1)
    assert error_percent(estimate.positions, truth[-1]) < 0.2


@pytest.mark.parametrize("start", ["straight", "wrong"])
def test_unknown_start_is_found_at_once(start: str) -> None:
    way = poses(90)
    truth = true_shapes(thread_of(), way)
    estimator = estimator_of(thread_of())
    bent = truth[40] + np.linspace(0.0, 1.0, 26)[:, None] * np.array([0.0, 0.2 * LENGTH])
    estimator.start(way[40], bent if start == "wrong" else None)
    for k in range(41, 71):
        estimate = estimator.step(way[k], whole(truth[k], k))
    assert error_percent(estimate.positions, truth[70]) < 0.3


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
        assert np.abs(estimator.predictor.formulation.strain(estimate.positions, pose.heading)).max() < 1.5e-3


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
    rows = {margins.barrier: margins for margins in formulation.margins(estimate.positions, way[1].heading)}["obstacle"]
    bound = estimate.margins["obstacle"].bound
    node, last = rows.node.astype(int), len(estimate.positions) - 1
    beside = [np.clip(node + apart, 0, last) for apart in (-1, 0, 1)]  # the half segments' clearance is of these too
    deviations = [
        np.sqrt(np.einsum("ra,rab,rb->r", rows.normal, estimate.covariance[at], rows.normal)) for at in beside
    ]
    expected = rows.clearance - 2.3263 * np.max(deviations, axis=0)
    np.testing.assert_allclose(bound, expected, rtol=1e-4)
    assert (bound < rows.clearance)[node > 0].all()


def bad_pieces(nodes: np.ndarray) -> list[tuple[str, tuple[ThreadPiece, ...]]]:
    good = piece_of(nodes, 1)
    ends = (PieceEnd.UNKNOWN, PieceEnd.UNKNOWN)
    many = points_at(nodes, np.linspace(0.0, LENGTH, 10_000))
    return [
        ("two finite points", (ThreadPiece(np.full((5, 2), np.nan), np.full(5, 1e-5), *ends, (0.0, 0.0)), good)),
        ("no length", (ThreadPiece(np.zeros((4, 2)), np.zeros(4), *ends, (0.0, 0.0)), good)),
        ("another one", (replace(good, first_end=PieceEnd.UNKNOWN, arc_length=(0.0, 1e9)), good)),
        ("longer than", (ThreadPiece(np.array([[0.0, 0.0], [0.05, 0.0]]), np.full(2, 1e-5), *ends, (0.0, 0.0)), good)),
        ("", (ThreadPiece(many, np.full(10_000, DEVIATION), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0)),)),
        ("pieces, more than", (good,) * 100),
        ("", ()),
    ]


@pytest.mark.parametrize("index", range(7))
def test_bad_pieces_are_survived_with_the_reason(index: int) -> None:
    way = poses(40)
    truth = true_shapes(thread_of(), way)
    session = EstimatorSession(estimator_of(thread_of()))
    for k, pose in enumerate(way):
        session.on_pose(pose)
        words, pieces = bad_pieces(truth[k])[index]
        result = session.on_observation(pose.stamp, ThreadObservation(pieces))
        assert result.problem is None
        estimate = known(result.estimate)
        assert np.isfinite(estimate.positions).all()
        assert any(words in problem for problem in estimate.problems) or not words
    assert error_percent(estimate.positions, truth[-1]) < 0.2


def test_an_obstacle_nobody_told_of_is_found() -> None:
    disc, way = Disc((0.0, -2.2e-3), 1.7e-3), poses(150, turn=-0.9)
    truth = true_shapes(thread_of(), way, (disc,))
    gap = np.linalg.norm(truth - np.array(disc.centre), axis=2).min(axis=1) - disc.radius
    contact = int(np.flatnonzero(gap < 5e-5)[0])
    estimator = estimator_of(thread_of())
    estimator.start(way[0])
    found = {}
    for k, pose in enumerate(way[1:], 1):
        estimate = estimator.step(pose, whole(truth[k], k))
        if estimate.disturbances:
            found[k] = estimate.disturbances[0]
    assert contact > 5
    assert contact <= min(found) <= contact + 0.5 * RATE
    later = found[min(found) + 10]
    assert np.linalg.norm(later.position - np.array(disc.centre)) < disc.radius + 1e-3
    away = later.position - np.array(disc.centre)
    assert later.direction @ away / np.linalg.norm(away) > 0.7  # the obstacle pushes the thread away from itself
    assert later.force > 0.0


@pytest.mark.parametrize(("material", "attachment"), [("silk_6_0", "pinned"), ("polyamide_7_0", "clamped")])
def test_a_pose_that_is_a_little_off_is_no_disturbance(material: str, attachment: str) -> None:
    thread, place, angle = thread_of(material=material, attachment=attachment), 3e-5, 5e-3
    way, estimator = poses(120, turn=0.3), estimator_of(thread)
    truth = true_shapes(thread, way)
    for k, pose in enumerate(way):
        left = np.array([-pose.heading[1], pose.heading[0]])
        heading = math.cos(angle) * pose.heading + math.sin(angle) * left
        off = NeedlePose(pose.stamp, pose.tail + place * left, heading, (place, angle))
        seen = ThreadObservation((piece_of(truth[k], k, deviation=5e-6),), complete=True)
        estimate = estimator.start(off, truth[0]) if k == 0 else estimator.step(off, seen)
        assert not estimate.disturbances


def test_what_cannot_be_estimated_is_refused() -> None:
    paper = ThreadPredictor(thread_of(), formulation="paper")
    space = ThreadPredictor(thread_of(), Workspace((), 5e-3, dimension=3))
    for words, refused in (
        ("rod", lambda: ThreadEstimator(paper)),
        ("plane", lambda: ThreadEstimator(space)),
        ("history", lambda: EstimatorOptions(history=0.0)),
    ):
        with pytest.raises(ConfigurationError, match=words):
            refused()


NODES = 13


def dense_of(buffers: StepBuffers) -> np.ndarray:
    """Return P of a program, dense."""
    program = as_quadratic_program(first_rows(buffers, 0))
    upper = program.P.toarray()[: 2 * NODES, : 2 * NODES]
    return upper + upper.T - np.diag(np.diag(upper))


def test_correction_agrees_with_a_dense_kalman_filter() -> None:
    """A straight thread has no constraint across it, so that across it the update is the plain one."""
    rng, straight = np.random.default_rng(4), np.column_stack([-np.arange(float(NODES)), np.zeros(NODES)])
    place, ones = np.sort(rng.uniform(0.2, NODES - 1.0, 40)), np.ones(40)
    points = MeasuredPoints(place, rng.normal(0.0, 5e-5, 40), 1e-4 * ones, ones, ones, ones.copy())
    predictor = predictor_of(thread_of(NODES - 1))
    assert isinstance(predictor.formulation, RodFormulation)
    corrector = Corrector(predictor, predictor.formulation)
    prior = Prior(straight, np.array([1.0, 0.0]), np.full(NODES, 3e-4), np.ones(NODES), 2.0, 0.5)
    correction = corrector.solve(prior, points)
    assert not correction.problem
    assert correction.residual < 1e-6
    check = StepBuffers.of(NODES, 2, 1)
    prior_information(prior, 1.0, False, check)
    information = dense_of(check)[2:, 2:][1::2, 1::2]
    rows = -np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(1.0, NODES)))  # to the left of a thread to the west
    covariance = np.linalg.inv(information)
    spread = rows @ covariance @ rows.T + np.diag(points.variance)
    gain = covariance @ rows.T @ np.linalg.inv(spread)
    np.testing.assert_allclose(correction.moved[1:, 1], gain @ points.innovation, rtol=1e-3, atol=1e-8)
    left = covariance - gain @ rows @ covariance
    np.testing.assert_allclose(correction.covariance[1:, 1, 1], np.diag(left), rtol=1e-3)
    assert np.abs(correction.moved[:, 0]).max() < 1e-6  # the chords hold it along the thread


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
