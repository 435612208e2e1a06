"""Goals of the thread: what they ask, how far a thread misses them, and ways of the needle that a forecast finds."""

from __future__ import annotations

import math
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest
import shapely

from magnetosuture_thread.coils.needle_motion import NeedleTwist
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.planning.executor import ProcedureExecutor, ThreadCondition
from magnetosuture_thread.planning.planner import NeedlePlanner, PlanningError
from magnetosuture_thread.planning.verdict import GoalJudge
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.thread.prediction import NeedlePose
from test.planning.test_planner import procedure

POST = Scene(Dish(0.05), (SceneShape("post", "instrument", Disc((0.0, 0.0), 0.002)),))


def around(degrees: float, radius: float = 0.003) -> np.ndarray:
    """Return a thread that winds about the post, counterclockwise from its free end to its tail."""
    angles = np.radians(np.linspace(degrees, 0.0, 200))
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def between(first: tuple[float, float], last: tuple[float, float]) -> np.ndarray:
    """Return a straight thread, the tail first."""
    return np.linspace(first, last, 41)


def past(side: str) -> dict[str, Any]:
    """Return a goal above the post, with the thread on a side of it."""
    return {"keep_side": {"around": "post", "side": side, "to": [0.0, 0.012]}}


def laid(along: list[list[float]], **fields: Any) -> dict[str, Any]:
    """Return a goal of a thread along a line."""
    return {"lay": {"along": along, **fields}}


@pytest.fixture(scope="module")
def dish() -> Setup:
    """Return the setup of the dish of 50 mm."""
    return read_setup("dish_50mm").with_scene(POST)


@pytest.fixture(scope="module")
def planner(dish: Setup) -> NeedlePlanner:
    """Return a planner with a post, and forecasts by the setup's thread model."""
    return dish.planner.planner(dish.scene, dish.coils, dish.model)


def start_of(planner: NeedlePlanner) -> tuple[np.ndarray, float]:
    """Return middle and angle of a needle to the right of the post, headed up."""
    return planner.pose(np.array([0.012, -0.012]), np.array([0.0, 1.0]))


@pytest.mark.parametrize(
    ("goal", "thread", "is_met"),
    [
        ({"wind": {"around": "post", "angle": 5.0}}, around(300.0), True),
        ({"wind": {"around": "post", "angle": 5.0}}, around(340.0), False),  # a wrap would be met
        ({"unwind": {"around": "post"}}, around(170.0), True),
        ({"unwind": {"around": "post", "angle": 3.5}}, around(-190.0), True),
        ({"take_off": {"around": "post"}}, around(90.0, 0.0031), True),
        ({"take_off": {"around": "post"}}, around(90.0, 0.0029), False),
        ({"take_off": {"around": "post"}}, around(190.0, 0.005), False),
        (past("left"), between((0.01, -0.005), (-0.01, -0.005)), False),
        (past("right"), between((0.01, -0.005), (-0.01, -0.005)), True),
        (laid([[0.0, 0.005], [0.01, 0.005]]), between((0.012, 0.0052), (-0.02, 0.0052)), True),
        (laid([[0.0, 0.005], [0.01, 0.005]]), between((0.012, 0.0062), (-0.02, 0.0062)), False),
        (laid([[0.0, 0.005], [0.01, 0.005]]), between((0.005, 0.005), (-0.02, 0.005)), False),
        (laid([[0.0, 0.005], [0.01, 0.005]], stretch=[0.005, 0.015]), between((0.012, 0.005), (-0.02, 0.005)), False),
        ({"bring_end": {"position": [-0.02, 0.006]}}, between((0.012, 0.005), (-0.02, 0.005)), True),
    ],
)  # fmt: skip
def test_a_goal_is_met_by_how_the_thread_lies(goal: dict[str, Any], thread: np.ndarray, is_met: bool):
    judge = GoalJudge(procedure(goal), POST)
    judge.update(np.zeros(2), thread)
    assert judge.is_met is is_met
    assert is_met or "mm" in judge.missing(0) or "degrees" in judge.missing(0)


def test_a_needle_whose_measured_middle_trembles_on_the_line_has_not_passed_the_gap():
    posts = [SceneShape(name, "instrument", Disc((x, 0.0), 0.002)) for name, x in (("left", -0.005), ("right", 0.005))]
    goal = {"pass_through": {"between": ["left", "right"], "direction": [0.0, 1.0]}}
    judge = GoalJudge(procedure(goal), Scene(Dish(0.05), tuple(posts)))
    for y, is_met in ((-1e-3, False), (3e-5, False), (-3e-5, False), (2e-5, False), (6e-5, True)):
        judge.update(np.array([0.0, y]), None)
        assert judge.is_met is is_met


def test_repeat_is_its_goals_as_often_and_counts_against_the_limit():
    goals = [{"wait": {"time": 2.0}}, {"wrap": {"around": "post", "angle": 3.0}}]
    found = procedure(
        {"repeat": {"times": 3, "goals": goals}, "limits": {"speed": 0.001}}, {"unwind": {"around": "post"}}
    )
    assert [goal.GROUP for goal in found.goals] == ["wait", "wrap"] * 3 + ["unwind"]
    assert [limits.speed for limits in found.limits] == [0.001] * 6 + [0.002]
    assert found.windings[5] == (9.0, math.inf)
    for broken, where in (
        ({"times": 51, "goals": goals}, "procedure.goals"),
        ({"times": 0, "goals": goals}, r"goals\[0\].repeat"),
        ({"times": 2, "goals": []}, r"goals\[0\].repeat.goals"),
        ({"times": 2, "goals": [{"repeat": {"times": 2, "goals": goals}}]}, r"goals\[0\].repeat.goals\[0\]"),
        ({"times": 2, "goals": [{"wait": {"time": -1.0}}]}, r"goals\[0\].repeat.goals\[0\].wait.time"),
    ):
        with pytest.raises(ConfigurationError, match=where):
            procedure({"repeat": broken})


@pytest.mark.parametrize(
    ("goals", "words"),
    [
        ([laid([[-0.01, 0.0], [0.01, 0.0]])], "clear of post"),
        ([laid([[-0.015, 0.005], [0.015, 0.005], [0.015, 0.01], [-0.015, 0.01]])], "length of the thread, 50 mm"),
        ([laid([[0.0, 0.005], [0.01, 0.005]], stretch=[0.0, 0.02])], "as long as the line, 10 mm"),
        ([laid([[0.0, 0.005]])], "longer than its tolerance"),
        ([laid([[0.0], [0.005, 0.01, 0.005]])], "along"),
        ([{"keep_side": {"around": "post", "to": [0.001, 0.0]}}], "around the needle"),
        ([{"keep_side": {"around": "posts", "to": [0.01, 0.0]}}], "a shape of the scene: post"),
        ([{"wind": {"around": "post", "angle": 30.0}}], "degrees"),
        ([{"wrap": {"around": "post", "angle": 6.0}}, {"take_off": {"around": "post"}},
          {"tighten": {"tension": 1e-5, "toward": [0.01, 0.01]}}], "no wrap before it"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_before_anything_moves(
    planner: NeedlePlanner, goals: list[dict[str, Any]], words: str
):
    with pytest.raises(ConfigurationError, match=words):
        planner.check(procedure(*goals))


def test_a_wrap_that_was_taken_off_may_be_made_the_other_way(planner: NeedlePlanner):
    first, then = (
        {"wrap": {"around": "post", "angle": 6.0, "sense": sense}} for sense in ("clockwise", "counterclockwise")
    )
    with pytest.raises(ConfigurationError, match="as post is wrapped before"):
        planner.check(procedure(first, then))
    planner.check(procedure(first, {"unwind": {"around": "post"}}, then))
    little = {"wind": {"around": "post", "angle": 0.9, "sense": "clockwise"}}
    planner.check(procedure(little, first))
    with pytest.raises(ConfigurationError, match="as post is wrapped before"):
        planner.check(procedure(little, then))


AROUND_THE_POST = [[0.002, -0.008], [0.0023, 0.0], [0.0016, 0.0017], [0.0, 0.0023], [-0.006, 0.0025]]


@pytest.mark.parametrize(
    "goal",
    [
        past("left"),
        past("right"),
        {"wind": {"around": "post", "angle": 4.7}},
        pytest.param({"bring_end": {"position": [0.008, 0.008], "tolerance": 0.003}}, marks=pytest.mark.slow),
        pytest.param(laid(AROUND_THE_POST, tolerance=0.0015), marks=pytest.mark.slow),
    ],
)
def test_the_thread_of_a_predictor_comes_to_lie_as_the_goal_asks(
    planner: NeedlePlanner, dish: Setup, goal: dict[str, Any]
):
    wanted = procedure(goal)
    path = planner.plan(wanted, 0, *start_of(planner), np.zeros(2))
    # The needle is moved along the path by hand, and the thread by the predictor, step by step.
    predictor, kinematics = dish.model.predictor(dish.scene), planner.needle
    ways = np.arange(0.0, path.length + 5e-5, 5e-5)
    bend = math.atan2(*kinematics.chord_direction(np.array([1.0, 0.0]))[::-1])
    for k, way in enumerate(ways):
        middle, angle = path.at(way)
        tail = middle - path.lever * np.array([math.cos(angle), math.sin(angle)])
        heading = np.array([math.cos(angle - bend), math.sin(angle - bend)])
        pose = NeedlePose(0.025 * k, tail, heading)
        lies = (predictor.step(pose) if k else predictor.start(pose)).positions
    judge = GoalJudge(wanted, dish.scene)
    judge.update(path.at(path.length)[0], lies)
    assert judge.is_met, judge.missing(0)
    axis = shapely.LineString(path.middles)
    assert axis.distance(shapely.Point(0.0, 0.0)) > 0.002 + planner.keep_out


@pytest.mark.slow
def test_what_a_forecast_does_not_reach_is_refused_with_the_nearest(planner: NeedlePlanner):
    # The dish is as wide as the thread is long: a line of 40 mm along a chord cannot be straightened by pulling.
    line = {"lay": {"along": [[-0.02, 0.012], [0.0, 0.0135], [0.02, 0.012]], "tolerance": 1e-4}}
    with pytest.raises(
        PlanningError, match=r"no way for the needle to lay .* at best, the thread is off its line by [\d.]+ mm"
    ):
        planner.plan(procedure(line), 0, *start_of(planner), np.zeros(2))


def test_a_wait_begins_anew_after_a_pause_by_a_person(planner: NeedlePlanner):
    executor = ProcedureExecutor(procedure({"wait": {"time": 1.0}}, {"go_to": {"position": [0.012, 0.0]}}), planner)
    tail, heading = np.array([0.012, -0.012]), np.array([0.0, 1.0])
    thread = ThreadCondition(between((0.012, -0.012), (0.012, -0.02)))
    executor.start()
    commands = [executor.update(0.05 * k, tail, heading, thread) for k in range(10)]
    assert max(np.linalg.norm(command) for command in commands) <= 1e-5  # it is held, and not driven
    executor.pause("by hand")
    executor.update(3.0, tail, heading, thread)
    executor.start()
    for k in range(18):
        executor.update(3.1 + 0.05 * k, tail, heading, thread)
    assert executor.goal == 0
    for k in range(18, 24):
        executor.update(3.1 + 0.05 * k, tail, heading, thread)
    assert executor.goal == 1


@pytest.mark.slow
def test_a_path_that_does_not_lead_to_the_goal_any_more_is_planned_anew(planner: NeedlePlanner):
    wanted = procedure({"bring_end": {"position": [0.008, 0.008], "tolerance": 0.003}})
    asked: list[Any] = []

    def submit(task: Any) -> Any:
        asked.append(task.func.__name__)
        future: Future[Any] = Future()
        future.set_result(False if task.func.__name__ == "leads_to" else task())
        return future

    executor = ProcedureExecutor(wanted, planner, submit)
    executor.start()
    tail, heading, kinematics = np.array([0.012, -0.012]), np.array([0.0, 1.0]), planner.needle
    thread = ThreadCondition(between((0.012, -0.012), (0.012, -0.02)))
    for k in range(200):
        twist = NeedleTwist(*executor.update(0.05 * k, tail, heading, thread))
        across = twist.across + kinematics.lever * twist.turn_rate
        tail, heading = kinematics.moved(tail, heading, twist.along, across, 0.05, twist.across)
        if asked.count("plan") > 1:
            break
    assert asked[:2] == ["plan", "leads_to"]
    assert asked.count("plan") > 1
