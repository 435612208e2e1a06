"""What a published forecast goes by: the plan at the measured speed, or the command that is held; and its judgement."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from numpy.typing import NDArray

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
from magnetosuture_thread.estimator import ThreadEstimate, ThreadEstimator
from magnetosuture_thread.forecast.published import NeedlePlan, PublishedForecasts
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
        choice.prepare(forecaster, estimate, pose, HORIZON, slowed=False)()
    assert not reasons[0]
    assert reasons[-1] == "the last forecasts are farther off than a thread that does not move"


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_needle_off_its_plan_comes_back_to_it(sense: float):
    way = np.linspace(0.0, 0.02, 200)
    plan = NeedlePlan(np.column_stack([sense * way, np.zeros(200), np.zeros(200)]), LEVER, (SPEED, 1.0))
    pose: NDArray[np.float64] = np.array([0.0, 5e-4, 0.05])
    plan.update(0.0, pose, np.array([sense * SPEED, 0.0, 0.0]), HORIZON)
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


@pytest.mark.parametrize(
    "poses",
    [
        [[1e300, 0.0, 0.0], [-1e300, 0.0, 0.0]],
        [[0.0, math.nan, 0.0]] * 2,
        [[0.0, 0.0, math.nan]] * 2,
        [[0.0] * 3] * 20_001,
    ],
)
def test_a_plan_that_no_needle_can_follow_is_refused(poses: list[list[float]]):
    message = typestore().deserialize_cdr(packed_path(7, np.array(poses)), PROCEDURE_PLAN.type_name)
    with pytest.raises(InvalidInputError, match=r"^plan"):
        path_poses(message, "plan")


def made_at(choice: PublishedForecasts, forecaster: ThreadForecaster, time: float, where: float) -> Forecast:
    """Return the forecast at a time from where the needle was at another."""
    still = pose_at(where)
    pose = NeedlePose(time, still.tail, still.heading)
    estimate = ThreadEstimator(ThreadPredictor(THREAD, SCENE)).start(pose)
    return choice.prepare(forecaster, estimate, pose, HORIZON, slowed=False)()


@pytest.mark.parametrize(("source", "speed"), [("", 0.0), ("needle", 0.0), ("", SPEED)])
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


def test_a_needle_that_starts_or_goes_on_is_taken_along_at_its_commanded_speed(forecaster: ThreadForecaster):
    choice = PublishedForecasts(NEEDLE)
    choice.on_plan(CIRCLE)
    assert off_by(driven(choice, forecaster, 1.0, "needle")[0]) < 4e-4
    for time in np.arange(1.0, 5.0, PERIOD).tolist():
        choice.on_command(time, np.zeros(2), np.zeros(2), "")
        choice.update(NeedlePose(time, pose_at(1.0).tail, pose_at(1.0).heading), HORIZON)
    choice.on_plan(CIRCLE[20:])  # planned anew from where it rests
    command = SPEED_ON_PLAN * pose_at(1.0).heading
    choice.on_command(5.0, command, command, "needle")
    went = made_at(choice, forecaster, 5.0, 1.0).tails[-1]
    assert np.linalg.norm(went - pose_at(1.0 + HORIZON).tail) < 4e-4


STRAIGHT = np.column_stack([np.linspace(-0.02, 0.0, 400), np.zeros((400, 2))])


@pytest.mark.parametrize(("x", "sense"), [(0.0, 1.0), (-0.005, -1.0)])
def test_the_plan_of_another_program_is_not_followed(x: float, sense: float):
    choice = PublishedForecasts(NEEDLE)
    choice.on_plan(STRAIGHT)
    for k in range(10):
        pose = NeedlePose(0.1 * k, np.array([x - LEVER + sense * 2e-4 * k, 0.0]), np.array([1.0, 0.0]))
        choice.on_command(pose.stamp, sense * SPEED * pose.heading, sense * SPEED * pose.heading, "needle")
        assert not choice.update(pose, HORIZON)


def test_a_plan_is_joined_where_the_needle_is():
    plan = NeedlePlan(STRAIGHT, LEVER)
    for k in range(10):
        assert plan.update(0.1 * k, np.array([-0.005 + 1e-4 * k, 0.0, 0.0]), np.array([1e-3, 0.0, 0.0]), HORIZON)
        assert plan.at == pytest.approx(0.015 + 1e-4 * k, abs=1e-6)
    assert plan.speed[0] / plan.speed[1] == pytest.approx(1e-3, rel=1e-3)


def test_a_needle_does_not_lose_its_place_where_its_plan_goes_back_over_itself():
    plan = NeedlePlan(np.concatenate([STRAIGHT, STRAIGHT[-2::-1]]), LEVER)
    for way in np.arange(0.0, 0.0399, 1e-4):
        sense = 1.0 if way < 0.02 else -1.0
        plan.update(100.0 * way, np.array([-abs(way - 0.02), 0.0, 0.0]), np.array([sense * 0.01, 0.0, 0.0]), HORIZON)
        assert plan.at == pytest.approx(way, abs=2e-4)


def test_what_is_made_before_a_reset_is_not_compared_with_another_thread(forecaster: ThreadForecaster):
    choice, pose = PublishedForecasts(NEEDLE), pose_at(0.0)
    estimate = ThreadEstimator(ThreadPredictor(THREAD, SCENE)).start(pose)
    make = choice.prepare(forecaster, estimate, pose, HORIZON, slowed=False)
    choice.reset()
    make()
    other = Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=30, attachment=Attachment.PINNED)
    assert not choice.judge(ThreadEstimator(ThreadPredictor(other, SCENE)).start(pose_at(0.1)))


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


def test_another_needle_is_on_the_same_plan():
    choice, pose = PublishedForecasts(NEEDLE), NeedlePose(0.0, np.array([-0.015, 0.004]), np.array([1.0, 0.0]))
    choice.on_plan(STRAIGHT)
    choice.on_command(0.0, SPEED * pose.heading, SPEED * pose.heading, "needle")
    assert not choice.update(pose, HORIZON), "farther off than half its chord"
    choice.on_needle(NeedleKinematics(0.01))
    assert choice.update(pose, HORIZON)
