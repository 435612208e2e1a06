"""Intervals and verdicts on made-up Jacobians, where the answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.calibration.parameters import DRAG_ANISOTROPY, REST_CURVATURE, STIFFNESS_OVER_DRAG
from magnetosuture_thread.calibration.recorded_run import RecordedRun
from magnetosuture_thread.calibration.search import CHAIN, FitSolution, assess_identifiability, estimate_uncertainty
from test.calibration.runs import SETTINGS, rig_passage

PARAMETERS = (STIFFNESS_OVER_DRAG, DRAG_ANISOTROPY, REST_CURVATURE)
X = np.array([STIFFNESS_OVER_DRAG.to_fit(1.3e-9), DRAG_ANISOTROPY.to_fit(0.5), 0.0])
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def run() -> RecordedRun:
    """Return a run of the rig."""
    return rig_passage(1.3e-9)


def solved(jacobian: Array, *residuals: Array, x: Array = X) -> FitSolution:
    """Return a solution as a fit gives it, of a run for each of some residuals."""
    count = jacobian.shape[-1]
    many = [jacobian] * len(residuals)
    return FitSolution(SETTINGS, PARAMETERS[:count], x[:count], list(residuals), many, math.inf, 0.0)


def random(seed: int, run: RecordedRun, *more: int) -> Array:
    """Return numbers of size 1 for each residual of a run."""
    return np.random.default_rng(seed).standard_normal((*run.known.shape, *more))


def half_of(jacobian: Array, runs: list[RecordedRun], *residuals: Array) -> Array:
    """Return half of the intervals, without what camera, tracker and model may be wrong by all the time."""
    found = estimate_uncertainty(solved(jacobian, *residuals), runs, range(jacobian.shape[-1]))
    return found.half - CHAIN / found.effect


def test_of_white_noise_the_interval_is_that_of_least_squares(run: RecordedRun):
    jacobian, noise = 0.02 * random(1, run, 3), 1e-2
    gram = np.linalg.inv(jacobian.reshape(-1, 3).T @ jacobian.reshape(-1, 3))
    halves = [half_of(jacobian, [run], noise * random(seed, run)) for seed in range(100, 140)]
    student = 2.262  # of nine degrees of freedom
    assert np.mean(halves, axis=0) == pytest.approx(student * noise * np.sqrt(np.diag(gram)), rel=0.2)


def test_residuals_that_stay_for_long_or_differ_between_bags_widen_the_interval(run: RecordedRun):
    jacobian, halves = 0.02 * random(1, run, 3) + 0.02, []
    for seed in range(20):
        slow = math.sqrt(2.0) * np.sin(2.0 * math.pi * run.times / 3.0 + seed)[:, None] * np.ones(run.known.shape)
        halves.append([half_of(jacobian, [run], 1e-3 * r).mean() for r in (random(100 + seed, run), slow)])
    white, slow = np.mean(halves, axis=0)
    assert slow > 1.5 * white
    jacobian, offset = 0.02 + 0.002 * random(1, run, 1), 1e-3 * np.ones(run.known.shape)
    assert half_of(jacobian, [run] * 4, offset, -offset, offset, -offset) > 2.0 * half_of(
        jacobian, [run], 1e-3 * offset
    )


@pytest.mark.parametrize(
    ("change", "stiffness", "index", "reason"),
    [
        ("alike", 1.3e-9, 1, "cannot be told apart from stiffness over drag: correlation -1.00"),
        ("weak", 1.3e-9, 1, "a factor of two moves the prediction by 0.11 % of the length only"),
        ("", 2e-12, 0, "bending acts within 0.7 mm, 3."),
    ],
)
def test_what_cannot_be_identified_is_named_with_the_reason(
    run: RecordedRun, change: str, stiffness: float, index: int, reason: str
):
    jacobian = 0.1 * random(1, run, 3)
    if change == "alike":
        jacobian[..., 1] = 0.5 * jacobian[..., 0] + 0.005 * random(3, run)
    elif change == "weak":
        jacobian[..., 1] *= 0.02
    solution = solved(jacobian, 1e-4 * random(2, run), x=np.array([math.log(stiffness), *X[1:]]))
    reasons = [each.reason for each in assess_identifiability(solution, [run])]
    assert reason in reasons.pop(index)
    assert reasons == ["", ""]
