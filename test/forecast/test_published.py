"""What a published forecast goes by: the plan at the measured speed, or the command that is held; and its judgement."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from magnetosuture_thread import (
    Forecast,
    InvalidInputError,
    NeedlePose,
    NeedleSafetyFilter,
    Scene,
    Thread,
    ThreadForecaster,
)
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.packing import packed_path
from magnetosuture_thread.bags.reading import path_poses
from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.estimator.estimator import ThreadEstimate, ThreadEstimator
from magnetosuture_thread.forecast.published import PublishedForecasts
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.interface import PROCEDURE_PLAN
from magnetosuture_thread.thread.material import MATERIALS, Attachment
from magnetosuture_thread.thread.predictor import ThreadPredictor

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
        choice.prepare(forecaster, estimate, pose, HORIZON, slowed=False)()
    assert not reasons[0]
    assert reasons[-1] == "the last forecasts are farther off than a thread that does not move"


@pytest.mark.parametrize(
    "poses", [[[1e300, 0.0, 0.0], [-1e300, 0.0, 0.0]], [[0.0, 0.0, math.nan]] * 2, [[0.0] * 3] * 20_001]
)
def test_a_plan_arrives_with_its_angles_and_one_that_no_needle_can_follow_is_refused(poses: list[list[float]]):
    sound, message = (
        typestore().deserialize_cdr(packed_path(7, np.array(plan)), PROCEDURE_PLAN.type_name)
        for plan in (CIRCLE, poses)
    )
    np.testing.assert_allclose(path_poses(sound, "plan"), CIRCLE, atol=1e-12)
    with pytest.raises(InvalidInputError, match=r"^plan"):
        path_poses(message, "plan")


def made_at(choice: PublishedForecasts, forecaster: ThreadForecaster, time: float, where: float) -> Forecast:
    """Return the forecast at a time from where the needle was at another."""
    still = pose_at(where)
    pose = NeedlePose(time, still.tail, still.heading)
    estimate = ThreadEstimator(ThreadPredictor(THREAD, SCENE)).start(pose)
    return choice.prepare(forecaster, estimate, pose, HORIZON, slowed=False)()


@pytest.mark.parametrize(("source", "speed"), [("needle", 0.0), ("", SPEED)])
def test_a_needle_that_its_plan_does_not_drive_is_not_taken_along_it(
    forecaster: ThreadForecaster, source: str, speed: float
):
    choice = PublishedForecasts(NEEDLE)
    choice.on_plan(CIRCLE)
    driven(choice, forecaster, 0.5, "needle")
    command = speed * pose_at(0.5).heading
    choice.on_command(0.6, command, command, source)
    held = made_at(choice, forecaster, 0.6, 0.5)
    np.testing.assert_array_equal(held.commanded, np.tile(command, (len(held.commanded), 1)))


STRAIGHT = np.column_stack([np.linspace(-0.02, 0.0, 400), np.zeros((400, 2))])


@pytest.mark.parametrize(("x", "y", "sense"), [(0.0, 0.0, 1.0), (-0.005, 0.0, -1.0), (-0.01, 0.01, 1.0)])
def test_the_plan_of_another_program_is_not_followed(x: float, y: float, sense: float):
    """It is at its end, goes the other way, or is far away."""
    choice = PublishedForecasts(NEEDLE)
    choice.on_plan(STRAIGHT)
    for k in range(10):
        pose = NeedlePose(0.1 * k, np.array([x - LEVER + sense * 2e-4 * k, y]), np.array([1.0, 0.0]))
        choice.on_command(pose.stamp, sense * SPEED * pose.heading, sense * SPEED * pose.heading, "needle")
        assert not choice.update(pose, HORIZON)


def test_no_more_is_remembered_than_thirty_threads_that_move(forecaster: ThreadForecaster):
    choice, pose = PublishedForecasts(NEEDLE), pose_at(0.0)
    estimate = ThreadEstimator(ThreadPredictor(THREAD, SCENE)).start(pose)
    size = choice.prepare(forecaster, estimate, pose, HORIZON, slowed=False)().vertices.nbytes
    tracemalloc.start()
    for k in range(1, 100):
        choice.prepare(forecaster, estimate, NeedlePose(0.02 * k, pose.tail, pose.heading), HORIZON, slowed=False)()
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 32 * size
