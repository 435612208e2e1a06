"""Intervals and verdicts on made-up Jacobians, where the answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.calibration.fit import CHAIN, FitSolution, assess_identifiability, estimate_uncertainty
from magnetosuture_thread.calibration.parameters import DRAG_ANISOTROPY, REST_CURVATURE, STIFFNESS_OVER_DRAG
from magnetosuture_thread.calibration.recorded_run import RecordedRun
from test.calibration.runs import SETTINGS, rig_passage

PARAMETERS = (STIFFNESS_OVER_DRAG, DRAG_ANISOTROPY, REST_CURVATURE)
X = np.array([STIFFNESS_OVER_DRAG.to_fit(1.3e-9), DRAG_ANISOTROPY.to_fit(0.5), 0.0])
Array = NDArray[np.float64]
Shape = tuple[int, ...]


@pytest.fixture(scope="module")
def passage() -> RecordedRun:
    """Return a run of the rig."""
    return rig_passage(1.3e-9)


@pytest.fixture
def shape(passage: RecordedRun) -> Shape:
    """Return the shape of its residuals."""
    return passage.known.shape


def solved(jacobian: Array, residuals: Array, x: Array = X) -> FitSolution:
    """Return a solution as a fit gives it."""
    return FitSolution(SETTINGS, PARAMETERS, x, [residuals], [jacobian], math.inf, 0.0)


def random(seed: int, *shape: int) -> Array:
    """Return numbers of size 1."""
    return np.random.default_rng(seed).standard_normal(shape)


def names(solution: FitSolution, passages: list[RecordedRun]) -> list[str]:
    """Return why each number cannot be identified."""
    return [verdict.reason for verdict in assess_identifiability(solution, passages)]


def test_of_white_noise_the_interval_is_that_of_least_squares(passage: RecordedRun, shape: Shape):
    jacobian, noise = 0.02 * random(1, *shape, 3), 1e-2
    gram = np.linalg.inv(jacobian.reshape(-1, 3).T @ jacobian.reshape(-1, 3))
    halves = []
    for seed in range(100, 140):
        spread = estimate_uncertainty(solved(jacobian, noise * random(seed, *shape)), [passage], range(3))
        halves.append(spread.half - CHAIN / spread.effect)
    student = 2.262  # of nine degrees of freedom
    assert np.mean(halves, axis=0) == pytest.approx(student * noise * np.sqrt(np.diag(gram)), rel=0.2)


def test_residuals_that_stay_for_long_widen_the_interval(passage: RecordedRun, shape: Shape):
    jacobian = 0.02 * random(1, *shape, 3) + 0.02
    halves = []
    for index in range(20):
        white = random(100 + index, *shape)
        slow = math.sqrt(2.0) * np.sin(2.0 * math.pi * passage.times / 3.0 + index)[:, None] * np.ones(shape)
        spreads = [
            estimate_uncertainty(solved(jacobian, 1e-3 * residuals), [passage], range(3)) for residuals in (white, slow)
        ]
        halves.append([(spread.half - CHAIN / spread.effect).mean() for spread in spreads])
    narrow, wide = np.mean(halves, axis=0)
    assert wide > 1.5 * narrow


def test_bags_that_disagree_widen_the_interval(passage: RecordedRun, shape: Shape):
    jacobian = 0.02 * np.ones((*shape, 1)) + 0.002 * random(1, *shape, 1)
    passages, signs = [passage] * 4, (1.0, -1.0, 1.0, -1.0)
    bags = FitSolution(
        SETTINGS, PARAMETERS[:1], X[:1], [s * 1e-3 * np.ones(shape) for s in signs], [jacobian] * 4, math.inf, 0.0
    )
    alone = estimate_uncertainty(solved(np.repeat(jacobian, 3, axis=2), 1e-6 * np.ones(shape)), [passage], [0])
    assert estimate_uncertainty(bags, passages, [0]).half[0] > 2.0 * alone.half[0]


def test_two_that_do_the_same_are_named_and_one_is_kept(passage: RecordedRun, shape: Shape):
    jacobian = 0.1 * random(1, *shape, 3)
    jacobian[..., 1] = 0.5 * jacobian[..., 0] + 0.005 * random(3, *shape)
    first, second, third = names(solved(jacobian, 1e-4 * random(2, *shape)), [passage])
    assert (first, third) == ("", "")
    assert "cannot be told apart from stiffness over drag: correlation -1.00" in second


def test_what_moves_nothing_is_not_known(passage: RecordedRun, shape: Shape):
    jacobian = 0.1 * random(1, *shape, 3)
    jacobian[..., 1] *= 0.02
    reasons = names(solved(jacobian, 1e-4 * random(2, *shape)), [passage])
    assert "a factor of two moves the prediction by 0.11 % of the length only" in reasons[1]


def test_of_a_thread_that_bends_on_a_small_part_only_the_stiffness_is_not_known(passage: RecordedRun, shape: Shape):
    x = np.array([STIFFNESS_OVER_DRAG.to_fit(2e-12), X[1], X[2]])
    reasons = names(solved(0.1 * random(1, *shape, 3), 1e-3 * random(2, *shape), x), [passage])
    assert reasons[0].startswith("bending acts within 0.7 mm, 3.")
    assert reasons[1:] == ["", ""]
