"""The estimator and its session: right and wrong models, bad input, late frames, disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread import Disc
from magnetosuture_thread.estimator import EstimatorOptions, EstimatorSession, ThreadEstimator
from magnetosuture_thread.estimator.estimator import clearance_bound
from magnetosuture_thread.estimator.session import observation_of
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import points_at
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from test.estimator.threads import (
    DEVIATION,
    LENGTH,
    RATE,
    error_percent,
    estimator_of,
    piece_of,
    poses,
    thread_of,
    true_shapes,
    whole,
)

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


def test_points_beyond_an_obstacle_are_refused() -> None:
    disc, way = Disc((-0.01, 0.0021), 2e-3), poses(3, turn=0.0)
    estimator = estimator_of(thread_of(), (disc,))
    estimator.start(way[0])
    nodes = np.column_stack([-np.linspace(0.0, LENGTH, 26), np.zeros(26)]) + way[1].tail
    piece = piece_of(nodes, 1)
    beyond = (piece.points[:, 0] < -0.0094) & (piece.points[:, 0] > -0.0106)
    piece.points[beyond, 1] = 0.0045
    estimate = estimator.step(way[1], ThreadObservation((piece,)))
    assert np.abs(estimate.positions[:, 1]).max() < 1e-4


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


def test_a_thread_that_lies_elsewhere_is_believed_when_a_second_frame_shows_it() -> None:
    way = poses(14)
    truth = true_shapes(thread_of(), way)
    estimator = estimator_of(thread_of())
    estimator.start_observed(way[0], whole(truth[0], 0))
    for k in range(1, 12):
        estimator.step(way[k], whole(truth[k], k))
    turn = np.array([[math.cos(1.2), math.sin(1.2)], [-math.sin(1.2), math.cos(1.2)]])
    elsewhere = [way[k].tail + (truth[k] - way[k].tail) @ turn for k in (12, 13)]
    first, second = (estimator.step(way[k], whole(elsewhere[k - 12], k)) for k in (12, 13))
    assert error_percent(first.positions, elsewhere[0]) > 1.0
    assert error_percent(second.positions, elsewhere[1]) < 0.1


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
    rows = {each.barrier: each for each in formulation.margins(estimate.positions, way[1].heading)}["obstacle"]
    bound = estimate.margins["obstacle"].bound
    node, last = rows.node.astype(int), len(estimate.positions) - 1
    beside = [np.clip(node + apart, 0, last) for apart in (-1, 0, 1)]  # the half segments' clearance is of these too
    deviations = [
        np.sqrt(np.einsum("ra,rab,rb->r", rows.normal, estimate.covariance[at], rows.normal)) for at in beside
    ]
    expected = rows.clearance - 2.3263 * np.max(deviations, axis=0)
    np.testing.assert_allclose(bound, expected, rtol=1e-4)
    assert (bound < rows.clearance)[node > 0].all()
    flat = np.zeros_like(rows.normal)[:, None]  # which no motion of a node changes
    bound = clearance_bound(node[:, None], flat, rows.clearance, estimate.covariance)
    np.testing.assert_array_equal(bound, rows.clearance)


def session_of(history: float = 1.0) -> EstimatorSession:
    return EstimatorSession(estimator_of(thread_of(), options=EstimatorOptions(history)))


def test_late_observations_give_the_estimate_of_those_in_time() -> None:
    way = poses(60)
    truth = true_shapes(thread_of(viscosity=2.0), way)
    in_time, late = session_of(), session_of()
    for k, pose in enumerate(way):
        in_time.on_observation(pose.stamp, whole(truth[k], k))
        expected = in_time.on_pose(pose).estimate
    found = expected
    rng = np.random.default_rng(1)
    arrivals = sorted((k + rng.integers(0, 8), rng.random(), k) for k in range(60))
    for now in range(70):
        if now < 60:
            late.on_pose(way[now])
        for arrival, _, k in arrivals:
            if arrival == now:
                result = late.on_observation(way[k].stamp, whole(truth[k], k))
                assert result.problem is None
                if result.measured is not None:
                    assert result.measured.corrected
                found = result.estimate or found
    assert expected is not None
    assert found is not None
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    np.testing.assert_array_equal(found.noise, expected.noise)


def test_observations_that_cannot_be_used_are_refused() -> None:
    session, way = session_of(history=0.5), poses(60)
    truth = true_shapes(thread_of(), way)
    for pose in way:
        session.on_pose(pose)
    for stamp, words in (
        (math.nan, "finite"),
        (way[0].stamp, "kept"),
        (way[-1].stamp + 5.0, "after the last pose"),
        (way[-3].stamp + 1e-3, "kept"),
    ):
        assert words in str(session.on_observation(stamp, whole(truth[-1], 1)).problem)
    first, second = (session.on_observation(way[-1].stamp, whole(truth[-1], 1)).problem for _ in range(2))
    assert first is None
    assert "second" in str(second)


def bad_pieces(nodes: np.ndarray) -> list[tuple[str, tuple[ThreadPiece, ...]]]:
    good = piece_of(nodes, 1)
    nan = np.full((5, 2), np.nan)
    ends = (PieceEnd.UNKNOWN, PieceEnd.UNKNOWN)
    many = points_at(nodes, np.linspace(0.0, LENGTH, 10_000))
    return [
        ("two finite points", (ThreadPiece(nan, np.full(5, 1e-5), *ends, (0.0, 0.0)), good)),
        ("shapes", (ThreadPiece(np.zeros((4, 2)), np.zeros(3), *ends, (0.0, 0.0)), good)),
        ("no length", (ThreadPiece(np.zeros((4, 2)), np.zeros(4), *ends, (0.0, 0.0)), good)),
        ("another one", (good, good)),
        ("another one", (replace(good, first_end=PieceEnd.UNKNOWN, arc_length=(0.0, 1e9)), good)),
        ("longer than", (ThreadPiece(np.array([[0.0, 0.0], [0.05, 0.0]]), np.full(2, 1e-5), *ends, (0.0, 0.0)), good)),
        ("finite points", (ThreadPiece(np.full((3, 2), 1e9), np.full(3, 1e-5), *ends, (0.0, 0.0)), good)),
        ("", (ThreadPiece(many, np.full(10_000, DEVIATION), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0)),)),
        ("pieces, more than", (good,) * 100),
        ("", ()),
    ]


@pytest.mark.parametrize("index", range(10))
def test_bad_pieces_are_survived_with_the_reason(index: int) -> None:
    way = poses(40)
    truth = true_shapes(thread_of(), way)
    session = session_of()
    for k, pose in enumerate(way):
        session.on_pose(pose)
        words, pieces = bad_pieces(truth[k])[index]
        result = session.on_observation(pose.stamp, ThreadObservation(pieces))
        assert result.problem is None
        assert result.estimate is not None
        assert np.isfinite(result.estimate.positions).all()
        assert any(words in problem for problem in result.estimate.problems) or not words
    assert result.estimate is not None
    assert error_percent(result.estimate.positions, truth[-1]) < 0.2


def test_a_centreline_that_ends_early_is_taken() -> None:
    way = poses(60)
    truth = true_shapes(thread_of(viscosity=1.5), way)
    session = session_of()
    for k, pose in enumerate(way):
        session.on_pose(pose)
        result = session.on_observation(
            pose.stamp, observation_of(piece_of(truth[k], k, 0.0, 0.6 * LENGTH).points, LENGTH, DEVIATION)
        )
    assert result.estimate is not None
    assert result.estimate.hidden == pytest.approx(0.4, abs=0.06)
    assert error_percent(result.estimate.positions[:15], truth[-1][:15]) < 0.2


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


def test_a_bent_thread_that_is_held_is_estimated_where_it_is_and_the_hold_is_reported() -> None:
    """As in `hernia_ring` before the first current: left alone the thread would straighten, and the model's does."""
    thread = replace(thread_of(40, viscosity=0.3), length=0.05)
    turn = np.cumsum(np.full(40, 60.0 * thread.segment_length))
    along = -thread.segment_length * np.column_stack([np.cos(turn), np.sin(turn)])
    held = np.vstack([np.zeros(2), np.cumsum(along, axis=0)])
    estimator, alone = ThreadEstimator(ThreadPredictor(thread)), ThreadPredictor(thread)
    way = [NeedlePose(k / RATE, np.zeros(2), np.array([1.0, 0.0])) for k in range(round(4.0 * RATE))]
    alone.start_at(way[0], held)
    shown = [ThreadObservation((piece_of(held, k, end=thread.length),), complete=True) for k in range(len(way))]
    estimator.start_observed(way[0], shown[0])
    reported = []
    for k, pose in enumerate(way[1:], 1):
        estimate, predicted = estimator.step(pose, shown[k]), alone.step(pose).positions
        off = np.linalg.norm(estimate.positions - held, axis=1) / thread.length
        assert off.mean() < 1e-3
        assert off.max() < 3e-3
        reported.append(bool(estimate.disturbances))
    assert np.linalg.norm(predicted - held, axis=1).max() > 0.05 * thread.length
    assert any(reported[: round(0.5 * RATE)])
    assert all(reported[round(RATE) :])


def test_another_thread_goes_on_from_the_estimate_and_older_frames_are_refused() -> None:
    way = poses(40)
    truth = true_shapes(thread_of(viscosity=1.5), way)
    session, finer = session_of(), EstimatorSession(estimator_of(thread_of(40)))
    for k in range(30):
        session.on_observation(way[k].stamp, whole(truth[k], k))
        session.on_pose(way[k])
    session.on_observation(way[30].stamp, whole(truth[30], 30))  # which waits for its pose
    finer.follow_on(session)
    assert finer.on_observation(way[29].stamp, whole(truth[29], 29)).problem is not None
    estimate = finer.on_pose(way[30]).estimate
    assert estimate is not None
    assert estimate.corrected
    assert len(estimate.positions) == 41
    assert np.linalg.norm(estimate.positions[-1] - truth[30, -1]) < 1e-4
    assert finer.on_pose(replace(way[0], stamp=-5.0)).problem is None  # time was set back


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
