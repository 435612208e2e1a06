"""What a published forecast goes by: the plan at the measured speed, or the command that is held; and its judgement."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread import Forecast, NeedlePose, NeedleSafetyFilter, Scene, Thread, ThreadForecaster
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.estimator import ThreadEstimate, ThreadEstimator
from magnetosuture_thread.forecast.published import NeedlePlan, PublishedForecasts
from magnetosuture_thread.interface import PROCEDURE_PLAN
from magnetosuture_thread.messages.packing import packed_path
from magnetosuture_thread.messages.reading import path_poses
from magnetosuture_thread.safety.motion import NeedleKinematics
from magnetosuture_thread.thread.material import MATERIALS, Attachment
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

NEEDLE, SPEED, HORIZON, PERIOD = NeedleKinematics(0.007), 0.002, 2.0, 0.05
LEVER, RADIUS = 0.5 * NEEDLE.chord, 0.012
SCENE = Scene.create(dish_diameter=0.05)
THREAD = Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=25, attachment=Attachment.PINNED)
TURNS = np.linspace(0.0, 2.5, 400)
CIRCLE = np.column_stack([RADIUS * np.sin(TURNS), RADIUS * (1.0 - np.cos(TURNS)) - RADIUS, TURNS])
"""Poses of a chord whose middle is on a circle."""
SPEED_ON_PLAN = SPEED / (1.0 + LEVER / RADIUS)  # of the middle, where the tip has `SPEED` on a way that counts the turn


def pose_at(time: float) -> NeedlePose:
    """Return the needle on the circle."""
    turn = SPEED_ON_PLAN * time / RADIUS
    heading = np.array([math.cos(turn), math.sin(turn)])
    return NeedlePose(time, np.array([RADIUS * math.sin(turn), -RADIUS * math.cos(turn)]) - LEVER * heading, heading)


def estimate_at(time: float, estimator: ThreadEstimator) -> ThreadEstimate:
    """Return the estimate of a thread behind the needle on the circle."""
    return estimator.step(pose_at(time)) if time > 0.0 else estimator.start(pose_at(0.0))


@pytest.fixture
def forecaster() -> ThreadForecaster:
    return ThreadForecaster(THREAD, SCENE, NeedleSafetyFilter(SCENE, needle_length=0.007), step=0.02, max_step=0.021)


def driven(choice: PublishedForecasts, forecaster: ThreadForecaster, until: float, source: str) -> list[Forecast]:
    """Return a forecast a frame of a needle that is driven on the circle."""
    estimator, made = ThreadEstimator(ThreadPredictor(THREAD, SCENE)), list[Forecast]()
    for time in np.arange(0.0, until, PERIOD).tolist():
        pose, estimate = pose_at(time), estimate_at(time, estimator)
        choice.on_command(time, SPEED_ON_PLAN * pose.heading, SPEED_ON_PLAN * pose.heading, source)
        assert not choice.judge(estimate)
        made.append(choice.prepare(forecaster, estimate, pose, HORIZON, slowed=True)())
        choice.keep(made[-1])
    return made


def off_by(forecast: Forecast) -> float:
    """Return how far the needle ends from where it then is [m]."""
    return float(np.linalg.norm(forecast.tails[-1] - pose_at(forecast.stamp + forecast.horizon).tail))


def test_a_needle_on_its_plan_is_taken_along_it_at_its_own_speed(forecaster: ThreadForecaster):
    choice = PublishedForecasts(NEEDLE)
    choice.on_plan(CIRCLE)
    assert off_by(driven(choice, forecaster, 1.0, "needle")[-1]) < 5e-5
    by_hand = driven(PublishedForecasts(NEEDLE), forecaster, 1.0, "needle")[-1]
    assert off_by(by_hand) > 2e-4, "without a plan the command is held"
    choice.reset()
    np.testing.assert_array_equal(
        driven(choice, forecaster, 0.3, "operator")[-1].tails,
        driven(PublishedForecasts(NEEDLE), forecaster, 0.3, "operator")[-1].tails,
    )


def test_a_plan_far_from_the_needle_is_not_followed(forecaster: ThreadForecaster):
    choice = PublishedForecasts(NEEDLE)
    choice.on_plan(CIRCLE + np.array([0.0, 0.01, 0.0]))
    held = driven(choice, forecaster, 0.3, "needle")[-1]
    np.testing.assert_array_equal(held.commanded, np.tile(held.commanded[0], (len(held.commanded), 1)))


def test_forecasts_that_are_worse_than_nothing_moves_are_withheld_with_the_reason(forecaster: ThreadForecaster):
    choice, estimator = PublishedForecasts(NEEDLE), ThreadEstimator(ThreadPredictor(THREAD, SCENE))
    still, reasons = pose_at(0.0), []
    points = still.tail - np.outer(np.linspace(0.0, THREAD.length, 60), still.heading)
    piece = ThreadPiece(points, np.full(60, 1e-5), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0))
    seen = ThreadObservation((piece,), complete=True)
    for k in range(40):  # the needle is commanded, and stays where it is
        stamp = PERIOD * k
        pose = NeedlePose(stamp, still.tail, still.heading)
        estimate = estimator.step(pose, seen) if k else estimator.start_observed(pose, seen)
        choice.on_command(stamp, SPEED * pose.heading, SPEED * pose.heading, "needle")
        reasons.append(choice.judge(estimate))
        choice.keep(choice.prepare(forecaster, estimate, pose, HORIZON, slowed=False)())
    assert not reasons[0]
    assert reasons[-1] == "the last forecasts are farther off than a thread that does not move"


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_needle_off_its_plan_comes_back_to_it(sense: float):
    way = np.linspace(0.0, 0.02, 200)
    plan = NeedlePlan(np.column_stack([sense * way, np.zeros(200), np.zeros(200)]), LEVER, (SPEED, 1.0))
    pose: NDArray[np.float64] = np.array([0.0, 5e-4, 0.05])
    plan.update(0.0, pose, HORIZON)
    x, y, angle = pose.tolist()
    for v_x, v_y in plan.commands(pose, 0.01, 900):
        u, omega = (
            v_x * math.cos(angle) + v_y * math.sin(angle),
            (v_y * math.cos(angle) - v_x * math.sin(angle)) / LEVER,
        )
        x, y, angle = x + 0.01 * u * math.cos(angle), y + 0.01 * u * math.sin(angle), angle + 0.01 * omega
    assert abs(y) < 5e-5
    assert x == pytest.approx(sense * 0.018, abs=2e-4)


def test_a_plan_arrives_with_its_angles():
    message = typestore().deserialize_cdr(packed_path(7, CIRCLE), PROCEDURE_PLAN.type_name)
    np.testing.assert_allclose(path_poses(message, "plan"), CIRCLE, atol=1e-12)
