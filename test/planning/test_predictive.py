"""Predictive control of an ideal needle beside a post, with a straight thread behind it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.forecast import Forecast, ThreadForecaster
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model.margins import FrictionLaw
from magnetosuture_thread.model.prediction import NeedlePose
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Thread
from magnetosuture_thread.planning import predictive
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import NeedlePlanner
from magnetosuture_thread.planning.predictive import DISTURBANCE_TIME, FORECAST_STEP, PredictiveController
from magnetosuture_thread.planning.procedure import ProcedureLimits
from magnetosuture_thread.planning.tracking import PathTracker, TrackingCommand
from magnetosuture_thread.safety import NeedleSafetyFilter
from magnetosuture_thread.safety.kinematics import NeedleKinematics
from magnetosuture_thread.scene import Dish, Scene, SceneShape

NEEDLE = NeedleKinematics(0.0025)
KEEP_OUT, BESIDE = 2.5e-4, 3e-4  # m; the path passes the post at the latter
POST = SceneShape("post", "instrument", Disc((0.0, -0.0015 - BESIDE), 0.0015))
SCENE = Scene(Dish(0.05), (POST,))
SPEED, RATE = 0.002, 20.0
BEGIN, LENGTH = -0.008, 0.015  # m; of the path along the x axis


@pytest.fixture(scope="module")
def forecaster() -> ThreadForecaster:
    """Return a forecaster of a coarse thread."""
    thread = Thread.of(MATERIALS["silk_6_0"], length=0.012, segments=10, attachment=Attachment.PINNED)
    safety = NeedleSafetyFilter(SCENE, keep_out=KEEP_OUT, needle_length=NEEDLE.length, max_speed=0.01)
    return ThreadForecaster(thread, SCENE, safety, step=FORECAST_STEP, max_step=FORECAST_STEP, workers=1)


def controller(forecaster: ThreadForecaster, seed: int = 0) -> PredictiveController:
    """Return a controller of the needle."""
    return PredictiveController(NeedlePlanner(forecaster.scene, NEEDLE, KEEP_OUT, 0.012), forecaster, seed=seed)


class Run:
    """An ideal needle behind its safety filter that follows a straight path past the post.

    Args:
        forecaster: of needle and thread.
        control: the controller; None for the path tracker alone.
        begin: of the path along the x axis [m].
        limits: of the goal.
    """

    def __init__(
        self, forecaster: ThreadForecaster, control: PredictiveController | None, begin: float = BEGIN, **limits: Any
    ) -> None:
        x = np.linspace(begin, BEGIN + LENGTH, 151)
        middles, nothing = np.column_stack([x, np.zeros_like(x)]), np.zeros_like(x)
        path = BodyPath(middles, nothing, 0.5 * NEEDLE.chord, nothing + 6e-4, np.array([x[-1] - x[0]]))
        self.tracker, self.control, self.forecaster = PathTracker(path), control, forecaster
        self.limits = ProcedureLimits(speed=SPEED, **limits)
        self.tail, self.heading, self.time = np.array([begin - 0.5 * NEEDLE.chord, 0.0]), np.array([1.0, 0.0]), 1.0
        self.commands: list[np.ndarray] = []
        self.clearance = math.inf
        self.thread = self.straight

    def straight(self) -> ThreadCondition:
        """Return a thread that lies straight behind the needle."""
        start = self.forecaster.straight(NeedlePose(self.time, self.tail, self.heading))
        return ThreadCondition(start.vertices)

    def follow(self, seconds: float) -> Run:
        """Follow the path for some time."""
        for _ in range(round(seconds * RATE)):
            middle = self.tail + 0.5 * NEEDLE.chord * self.heading
            at = self.time, middle, math.atan2(self.heading[1], self.heading[0]), SPEED
            if self.control is None:
                command = self.tracker.compute_command(*at)
            else:
                command = self.control.compute_command(self.tracker, *at, self.thread(), self.limits)
            velocity = self.forecaster.safety.filter(command.velocity, self.tail, self.heading).filtered
            moved = NEEDLE.body_velocity(self.heading, velocity)
            self.tail, self.heading = NEEDLE.moved(self.tail, self.heading, *moved, 1.0 / RATE)
            self.time += 1.0 / RATE
            self.commands.append(command.velocity)
            clear = self.forecaster.safety.clearance(self.tail, self.heading)
            self.clearance = min(self.clearance, clear)
        return self

    @property
    def speeds(self) -> np.ndarray:
        """Commanded speeds, shape (k,) [m/s]."""
        return np.hypot(*np.array(self.commands).T)


def test_where_nothing_is_near_a_limit_the_command_is_the_trackers(forecaster: ThreadForecaster):
    tracked = Run(forecaster, None).follow(1.5)
    assert np.array_equal(Run(forecaster, controller(forecaster)).follow(1.5).commands, tracked.commands)


def test_it_keeps_farther_from_a_post_than_the_path_where_a_limit_asks_for_that(forecaster: ThreadForecaster):
    limit = 4e-4
    tracked = Run(forecaster, None, begin=-0.0045, clearance=limit).follow(3.0)
    kept = Run(forecaster, controller(forecaster), begin=-0.0045, clearance=limit).follow(3.0)
    assert tracked.clearance == pytest.approx(BESIDE, abs=2e-5)
    assert kept.clearance > BESIDE + 0.3 * (limit - BESIDE)
    assert kept.tracker.travel > 0.003  # it goes on all the same


def test_a_thread_near_its_tension_limit_slows_the_needle(forecaster: ThreadForecaster):
    tracked = Run(forecaster, None).follow(1.0)
    start = forecaster.straight(NeedlePose(1.0, tracked.tail, tracked.heading))
    tension = forecaster.forecast(start, tracked.commands[-1], 10 * FORECAST_STEP).peak_tension
    free = Run(forecaster, controller(forecaster), tension=3.0 * tension).follow(2.0)
    slowed = Run(forecaster, controller(forecaster), tension=1.05 * tension).follow(2.0)
    assert free.speeds[-20:].mean() > 0.98 * SPEED
    assert slowed.speeds[-20:].mean() < 0.85 * SPEED
    # The setpoint has waited for the needle.
    assert slowed.tracker.travel - slowed.tail[0] - 0.5 * NEEDLE.chord + BEGIN < 2e-4


def test_a_limit_of_nodes_under_friction_slows_the_needle(forecaster: ThreadForecaster):
    other = SceneShape("other", "instrument", Disc((0.0, 0.0015 + BESIDE), 0.0015))  # a thread between two is rubbed
    scene = Scene(Dish(0.05), (POST, other))
    safety = NeedleSafetyFilter(scene, keep_out=KEEP_OUT, needle_length=NEEDLE.length, max_speed=0.01)
    rubbed = ThreadForecaster(
        forecaster.thread,
        scene,
        safety,
        law=FrictionLaw(threshold=6e-4, beta=0.9, stuck_speed=1e-5),
        step=FORECAST_STEP,
        max_step=FORECAST_STEP,
        workers=1,
    )
    free, limited = (Run(rubbed, controller(rubbed), friction_nodes=nodes).follow(5.0) for nodes in (9_999, 1))
    assert limited.tracker.travel < free.tracker.travel - 5e-4


@pytest.mark.parametrize("limits", [{"clearance": 6e-4}, {"tension": 1e-6}, {"friction_nodes": 0}])
@pytest.mark.parametrize("seed", range(3))
def test_it_commands_nothing_faster_than_the_limit_or_the_tracker(
    forecaster: ThreadForecaster, seed: int, limits: dict[str, float], monkeypatch: pytest.MonkeyPatch
):
    run = Run(forecaster, controller(forecaster, seed), begin=-0.003, **limits)
    bounds: list[float] = []
    compute_command = PathTracker.compute_command

    def recorded(tracker: PathTracker, *arguments: Any, **options: Any) -> TrackingCommand:
        command = compute_command(tracker, *arguments, **options)
        if tracker is run.tracker:  # not a copy of it that is imagined ahead
            bounds.append(max(SPEED, math.hypot(*command.velocity)))
        return command

    monkeypatch.setattr(PathTracker, "compute_command", recorded)
    run.follow(1.5)
    assert len(bounds) == len(run.speeds)
    assert (run.speeds <= np.array(bounds) * (1.0 + 1e-9)).all()


def test_the_same_seed_gives_the_same_commands_and_another_seed_others(forecaster: ThreadForecaster):
    first, again, other = (
        np.array(Run(forecaster, controller(forecaster, seed), begin=-0.003, clearance=4e-4).follow(0.8).commands)
        for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def _without_thread(run: Run) -> ThreadCondition:
    return ThreadCondition()


def _of_other_segments(run: Run) -> ThreadCondition:
    vertices = run.straight().vertices
    assert vertices is not None
    return ThreadCondition(vertices[:-1])


def _detached(run: Run) -> ThreadCondition:
    vertices = run.straight().vertices
    assert vertices is not None
    return ThreadCondition(vertices + 0.01)


@pytest.mark.parametrize("thread", [_without_thread, _of_other_segments, _detached])
def test_a_thread_that_cannot_be_forecast_leaves_the_trackers_command(forecaster: ThreadForecaster, thread: Any):
    run = Run(forecaster, controller(forecaster), tension=1e-6)
    run.thread = lambda: thread(run)
    tracked = Run(forecaster, None).follow(1.0)
    assert np.array_equal(run.follow(1.0).commands, tracked.commands)


def test_forecasts_without_a_solution_leave_the_trackers_command(
    forecaster: ThreadForecaster, monkeypatch: pytest.MonkeyPatch
):
    forecasts = forecaster.forecasts

    def unsolved(*arguments: Any, **options: Any) -> list[Forecast]:
        return [replace(each, problem="no solution") for each in forecasts(*arguments, **options)]

    monkeypatch.setattr(forecaster, "forecasts", unsolved)
    tracked = Run(forecaster, None).follow(1.0)
    assert np.array_equal(Run(forecaster, controller(forecaster), tension=1e-6).follow(1.0).commands, tracked.commands)


def test_a_pull_that_is_not_compensated_is_learnt_from_the_poses(
    forecaster: ThreadForecaster, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(predictive, "PREFERENCE", 0.02)  # the less it takes, the more a wrong forecast does
    found = []
    for time in (1e9, DISTURBANCE_TIME):  # never, and as it is
        monkeypatch.setattr(predictive, "DISTURBANCE_TIME", time)
        run = Run(forecaster, controller(forecaster), begin=-0.0045)
        for _ in range(round(3.0 * RATE)):
            run.follow(1.0 / RATE)
            run.tail = run.tail + np.array([0.0, -3e-4]) / RATE  # towards the post
        found.append(run.clearance)
    assert found[1] > max(KEEP_OUT, found[0] + 5e-5)
