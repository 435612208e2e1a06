"""The session: late and doubled observations, bad input, determinism, disturbances."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread import Disc
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.estimator import EstimatorOptions, EstimatorSession, ThreadEstimator
from magnetosuture_thread.estimator.session import observation_of
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
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


def session_of(**options: Any) -> EstimatorSession:
    return EstimatorSession(estimator_of(thread_of(), options=EstimatorOptions(**options)))


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
        problem = session.on_observation(stamp, whole(truth[-1], 1)).problem
        assert problem is not None
        assert words in str(problem)
    assert session.on_observation(way[-1].stamp, whole(truth[-1], 1)).problem is None
    problem = session.on_observation(way[-1].stamp, whole(truth[-1], 1)).problem
    assert problem is not None
    assert "second" in str(problem)


def bad_pieces(nodes: np.ndarray) -> list[tuple[str, tuple[ThreadPiece, ...]]]:
    good = piece_of(nodes, 1)
    nan = np.full((5, 2), np.nan)
    ends = (PieceEnd.UNKNOWN, PieceEnd.UNKNOWN)
    many = np.column_stack(
        [np.interp(np.linspace(0, 1, 10_000), np.linspace(0, 1, len(nodes)), nodes[:, a]) for a in (0, 1)]
    )
    return [
        ("two finite points", (ThreadPiece(nan, np.full(5, 1e-5), *ends, (0.0, 0.0)), good)),
        ("shapes", (ThreadPiece(np.zeros((4, 2)), np.zeros(3), *ends, (0.0, 0.0)), good)),
        ("no length", (ThreadPiece(np.zeros((4, 2)), np.zeros(4), *ends, (0.0, 0.0)), good)),
        ("another one", (good, good)),
        ("longer than", (ThreadPiece(np.array([[0.0, 0.0], [0.05, 0.0]]), np.full(2, 1e-5), *ends, (0.0, 0.0)), good)),
        ("finite points", (ThreadPiece(np.full((3, 2), 1e9), np.full(3, 1e-5), *ends, (0.0, 0.0)), good)),
        ("", (ThreadPiece(many, np.full(10_000, DEVIATION), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0)),)),
        ("pieces, more than", (good,) * 100),
        ("", ()),
    ]


@pytest.mark.parametrize("index", range(9))
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


def test_what_the_estimator_cannot_correct_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="rod"):
        ThreadEstimator(ThreadPredictor(thread_of(), formulation="paper"))
    with pytest.raises(ConfigurationError, match="plane"):
        ThreadEstimator(ThreadPredictor(thread_of(), Workspace((), 5e-3, dimension=3)))
    with pytest.raises(ConfigurationError, match="history"):
        EstimatorOptions(history=0.0)


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
