"""Stiffness learned on line: found from a wrong start, with intervals that hold, frozen without excitation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.estimator import EstimatorOptions, ThreadEstimate, ThreadEstimator
from magnetosuture_thread.estimator.stiffness import (
    AUTOMATIC,
    DEVIATION,
    NORMAL_95,
    STIFFNESS_OVER_DRAG,
    STIFFNESS_RANGE,
)
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from test.estimator.threads import LENGTH, RATE, estimator_of, piece_of, poses, thread_of, true_shapes, whole


def learner(thread: Thread, *names: str) -> ThreadEstimator:
    return estimator_of(thread, options=EstimatorOptions(slow_parameters=names))


def stiff(thread: Thread, factor: float) -> Thread:
    return replace(thread, bending_stiffness=factor * thread.bending_stiffness)


def ratio_of(thread: Thread) -> float:
    return thread.bending_stiffness / thread.medium.drag_across


def play(estimator: ThreadEstimator, way: list[NeedlePose], shapes: np.ndarray) -> list[ThreadEstimate]:
    first = estimator.start_observed(way[0], whole(shapes[0], 0))
    return [first, *(estimator.step(way[k], whole(shapes[k], k)) for k in range(1, len(way)))]


@pytest.mark.parametrize("factor", [5.0, 0.2])
def test_a_wrong_stiffness_is_found_within_its_interval_without_a_jump(factor: float) -> None:
    told, way = thread_of(material="polyamide_7_0"), poses(200)
    real = stiff(told, factor)
    shapes = true_shapes(real, way)
    estimates = play(learner(told, STIFFNESS_OVER_DRAG), way, shapes)
    (found,) = estimates[-1].slow_parameters
    assert found.low <= ratio_of(real) <= found.high
    assert found.excited
    assert np.log(found.high / found.low) < 0.2 * (2.0 * NORMAL_95 * DEVIATION)
    assert ratio_of(estimates[-1].thread) == pytest.approx(found.value, rel=1e-9)  # forecasts start with it
    off = np.array([each.positions for each in estimates]) - shapes
    assert np.abs(off[60:]).max() < 3e-5


def test_without_excitation_value_and_interval_are_frozen_and_the_estimate_is_the_same() -> None:
    """A thread that lies straight behind a needle at rest says nothing about its stiffness."""
    thread = thread_of()
    way = [NeedlePose(k / RATE, np.zeros(2), np.array([1.0, 0.0])) for k in range(60)]
    shapes = true_shapes(thread, way)
    off, on = play(learner(thread), way, shapes), play(learner(thread, STIFFNESS_OVER_DRAG), way, shapes)
    for one, other in zip(off, on, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)
        np.testing.assert_array_equal(one.covariance, other.covariance)
        assert other.slow_parameters == on[0].slow_parameters
    assert not on[-1].slow_parameters[0].excited
    assert off[-1].slow_parameters == ()


def test_what_was_learned_stays_when_the_needle_rests() -> None:
    told, way = thread_of(material="polyamide_7_0"), poses(150)
    way += [replace(way[-1], stamp=way[-1].stamp + k / RATE) for k in range(1, 300)]
    estimates = play(learner(told, STIFFNESS_OVER_DRAG), way, true_shapes(stiff(told, 3.0), way))
    quiet = [each.slow_parameters for each in estimates[-60:]]
    assert all(each == quiet[0] for each in quiet)
    assert not quiet[0][0].excited
    assert quiet[0][0].value == pytest.approx(3.0 * ratio_of(told), rel=0.02)


def test_no_data_leads_beyond_the_bounds() -> None:
    """Pieces that no thread could make, in any order, at any distance."""
    thread, rng = thread_of(), np.random.default_rng(5)
    estimator, way = learner(thread, STIFFNESS_OVER_DRAG), poses(120, speed=5e-3)
    shapes, told = true_shapes(thread, way), ratio_of(thread)
    estimator.start(way[0])
    for k, pose in enumerate(way[1:], 1):
        scale = 10.0 ** rng.uniform(-5.0, -1.0)
        wild = shapes[k] + scale * rng.normal(0.0, 1.0, (1, 2)) + 0.3 * scale * rng.normal(0.0, 1.0, shapes[k].shape)
        wild[rng.random(len(wild)) < 0.05] = rng.choice([np.nan, np.inf, 1e9])
        piece = ThreadPiece(wild, np.full(len(wild), 1e-7), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0))
        (each,) = estimator.step(pose, ThreadObservation((piece,), True)).slow_parameters
        assert 0.999 * told / STIFFNESS_RANGE <= each.low <= each.value <= each.high <= 1.001 * told * STIFFNESS_RANGE


def test_unknown_parameters_and_threads_without_stiffness_are_refused() -> None:
    for names in (("drag_anisotropy",), (AUTOMATIC, STIFFNESS_OVER_DRAG)):
        with pytest.raises(ConfigurationError, match="auto alone, or nothing"):
            EstimatorOptions(slow_parameters=names)
    limp = replace(thread_of(), bending_stiffness=0.0)
    with pytest.raises(ConfigurationError, match="without stiffness or drag"):
        learner(limp, STIFFNESS_OVER_DRAG)
    assert learner(limp, AUTOMATIC).thread == limp


@pytest.mark.parametrize("factor", [5.0, 0.2])
def test_by_default_a_wrong_stiffness_is_learned_once_the_model_is_found_wrong(factor: float) -> None:
    """So that half of the thread, hidden afterwards, goes the way that a thread of that stiffness goes."""
    told, way, half = thread_of(material="polyamide_7_0"), poses(240), 0.5 * LENGTH
    shapes = true_shapes(stiff(told, factor), way)
    shown = [
        whole(nodes, k) if k < 150 else ThreadObservation((piece_of(nodes, k, end=half),), False)
        for k, nodes in enumerate(shapes)
    ]
    hidden = {}
    for names in (AUTOMATIC,), ():
        estimator = learner(told, *names)
        estimates = [estimator.start_observed(way[0], shown[0])]
        estimates += [estimator.step(*each) for each in zip(way[1:], shown[1:], strict=True)]
        off = np.array([each.positions for each in estimates]) - shapes
        hidden[names] = np.linalg.norm(off[150:, 13:], axis=2).max()
        if names:
            began = next(k for k, each in enumerate(estimates) if each.slow_parameters)
            assert any(each.disturbances for each in estimates[: began + 1])
            (learned,) = estimates[149].slow_parameters
            assert learned.value == pytest.approx(factor * ratio_of(told), rel=0.03)
            assert learned.low <= factor * ratio_of(told) <= learned.high
    assert hidden[(AUTOMATIC,)] < 0.2 * hidden[()]
