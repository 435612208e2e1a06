"""Procedures on an ideal needle, and on one that is dragged aside, stopped or not known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.coils.needle_motion import NeedleKinematics, NeedleTwist
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.planning.executor import (
    PathSubmitter,
    PendingPath,
    ProcedureExecutor,
    ProcedureState,
    ThreadCondition,
    plan_now,
)
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import NeedlePlanner
from magnetosuture_thread.planning.procedure import parse_procedure

NEEDLE = NeedleKinematics(0.0025)
RATE = 20.0
POST = SceneShape("post", "instrument", Disc((0.003, 0.0), 0.002))
KNOWN = ThreadCondition()
UNMEASURED = ThreadCondition(problem="the thread has not been measured for 1.0 s")
UNHELD = ThreadCondition(problem="nobody holds the page", may_hold=False)
AWAY: dict[str, Any] = {"go_to": {"position": [-0.012, 0.0]}}


def executor(
    *goals: dict[str, Any], submit: PathSubmitter = plan_now, max_wait: float = 30.0, **limits: Any
) -> ProcedureExecutor:
    """Return a procedure of some goals beside a post."""
    procedure = parse_procedure({"goals": list(goals), "limits": limits}, "test")
    return ProcedureExecutor(procedure, NeedlePlanner(Scene(Dish(), (POST,)), NEEDLE, 2.5e-4, 0.05), submit, max_wait)


class Needle:
    """An ideal needle: it moves as it is commanded, by a share of it, and is dragged aside while it moves."""

    def __init__(self, x: float = -0.006, y: float = 0.0, angle: float = 0.0) -> None:
        self.tail, self.heading = np.array([x, y]), np.array([math.cos(angle), math.sin(angle)])
        self.share, self.drift, self.time, self.way = 1.0, np.zeros(2), 1.0, 0.0
        self.pull = np.zeros(2)  # whatever is commanded
        self.trail = [self.tail - 0.03 * self.heading]  # where its tail has been: its thread, the free end first

    def run(
        self,
        run: ProcedureExecutor,
        seconds: float,
        condition: Callable[[], ThreadCondition] | None = None,
        until: Callable[[], bool] = lambda: False,
    ) -> None:
        """Follow the commands of a procedure for some time, or until it has ended."""
        end = self.time + seconds
        while self.time < end and run.state not in (ProcedureState.DONE, ProcedureState.FAILED) and not until():
            self.trail.append(self.tail)
            known = replace(KNOWN, vertices=self.thread) if condition is None else condition()
            command = run.update(self.time, self.tail, self.heading, known)
            twist = NeedleTwist(*(self.share * command))
            tip = NEEDLE.tip_velocity(self.heading, twist)
            self.way += math.hypot(*NEEDLE.tip_velocity(self.heading, NeedleTwist(*command))) / RATE
            moved = NEEDLE.body_velocity(self.heading, tip)
            self.tail, self.heading = NEEDLE.moved(self.tail, self.heading, *moved, 1.0 / RATE, twist.across)
            self.tail = self.tail + (self.drift * bool(command.any()) + self.pull) / RATE
            self.time += 1.0 / RATE

    @property
    def thread(self) -> np.ndarray:
        """The thread behind it, the tail first, shape (n + 1, 2) [m]."""
        return np.array(self.trail[::-1])

    @property
    def middle(self) -> np.ndarray:
        """The middle of its chord, shape (2,) [m]."""
        return self.tail + 0.5 * NEEDLE.chord * self.heading


def begun(*goals: dict[str, Any], **options: Any) -> tuple[ProcedureExecutor, Needle]:
    """Return a procedure that has been started, and its needle."""
    run = executor(*goals, **options)
    run.start()
    return run, Needle()


def give_up(run: ProcedureExecutor, needle: Needle, reason: str) -> None:
    """Follow a procedure until it fails for a reason."""
    needle.run(run, 60.0)
    assert run.state is ProcedureState.FAILED
    assert reason in run.reason


@pytest.mark.parametrize("drift", [(0.0, 0.0), (1e-4, 3e-4), (-3e-4, 0.0)])
def test_an_ideal_needle_reaches_every_goal(drift: tuple[float, float]):
    goals: list[dict[str, Any]] = [
        {"wrap": {"around": "post", "angle": 6.5, "sense": "counterclockwise"}},
        {"go_to": {"position": [-0.008, 0.004], "heading": [2.5]}},
        {"withdraw": {}},
    ]
    run, needle = begun(*goals)
    needle.drift = np.array(drift)
    needle.run(run, 200.0)
    assert (run.state, run.reason, run.goal) == (ProcedureState.DONE, "", 2)
    assert math.dist(needle.middle, (-0.006 + 0.5 * NEEDLE.chord, 0.0)) < 1e-3


def test_nothing_moves_before_the_start_nor_in_a_pause():
    run, needle = executor({"go_to": {"position": [-0.01, 0.0]}}), Needle()
    needle.run(run, 1.0)
    assert (needle.way, run.state) == (0.0, ProcedureState.READY)
    run.start()
    needle.run(run, 1.0)
    run.pause("the operator has taken over")
    way = needle.way
    assert way > 0.0
    needle.run(run, 2.0)
    assert (needle.way, run.state) == (way, ProcedureState.PAUSED)
    run.start()
    needle.run(run, 60.0)
    assert run.state is ProcedureState.DONE


@pytest.mark.parametrize(("x", "turn", "plans"), [(0.0, 0.0, 0), (5e-5, 0.03, 0), (5e-4, 0.0, 1), (0.0, 0.5, 1)])
def test_a_path_planned_before_the_start_is_taken_if_the_needle_is_where_it_begins(x: float, turn: float, plans: int):
    asked = []

    def submit(task: Callable[[], Any]) -> PendingPath:
        asked.append(task)
        return plan_now(task)

    run, needle = executor(AWAY, submit=submit), Needle()
    pose = run.planner.pose(needle.tail, needle.heading)
    (path,) = run.planner.plan_all(run.procedure, *pose)
    moved = Needle(-0.006 + x, 0.0, turn)
    run.start(path)
    moved.run(run, 60.0)
    assert (run.state, len(asked)) == (ProcedureState.DONE, plans)


def test_a_path_planned_before_the_start_is_not_taken_after_a_pause():
    run, needle = executor(AWAY), Needle()
    (path,) = run.planner.plan_all(run.procedure, *run.planner.pose(needle.tail, needle.heading))
    run.start(path)
    run.pause("before a pose has come")
    run.start()
    needle.run(run, 1.0)
    assert run.path is not path


def test_a_thread_that_is_not_known_pauses_and_goes_on_once_it_is():
    run, needle = begun(AWAY)
    needle.run(run, 1.0)
    way = needle.way
    needle.run(run, 2.0, lambda: UNMEASURED)
    assert (run.state, needle.way - way < 1e-5) == (ProcedureState.PAUSED, True)  # held, see `MIN_HOLD_SPEED`
    assert "not been measured" in run.reason
    needle.run(run, 60.0)
    assert run.state is ProcedureState.DONE


@pytest.mark.parametrize("along", [4e-4, -4e-4])
def test_a_needle_that_is_pulled_is_kept_in_place_while_the_thread_is_not_known(along: float):
    run, needle = begun(AWAY)
    needle.run(run, 1.0)
    needle.pull = along * needle.heading
    at = needle.tail
    needle.run(run, 4.0, lambda: UNMEASURED)
    assert (run.state, run.is_commanding) == (ProcedureState.PAUSED, True)
    assert math.dist(needle.tail, at) < 1e-4  # pulled by 1.6 mm
    needle.run(run, 1.0, lambda: UNHELD)
    assert (run.state, run.is_commanding) == (ProcedureState.PAUSED, False)
    assert math.dist(needle.tail, at) > 3e-4


def test_a_wait_for_the_thread_ends_after_the_longest_that_is_allowed_and_one_for_a_person_does_not():
    run, needle = begun(AWAY, max_wait=3.0)
    needle.run(run, 1.0)
    needle.run(run, 2.9, lambda: UNMEASURED)
    assert run.state is ProcedureState.PAUSED
    needle.run(run, 10.0, lambda: UNHELD)
    needle.run(run, 2.9, lambda: UNMEASURED)  # the wait begins anew
    assert run.state is ProcedureState.PAUSED
    needle.run(run, 0.3, lambda: UNMEASURED)
    way = needle.way
    needle.run(run, 5.0)
    assert (run.state, run.is_commanding, needle.way) == (ProcedureState.FAILED, False, way)
    assert run.reason == "given up after a wait of 3 s: the thread has not been measured for 1.0 s"


class Planning:
    """Plans when it is let: paths that are asked for are ready from then on."""

    def __init__(self) -> None:
        self.tasks: list[Callable[[], BodyPath]] = []
        self.is_ready = False

    def submit(self, task: Callable[[], BodyPath]) -> PendingPath:
        """Take a task."""
        self.tasks.append(task)
        return self

    def done(self) -> bool:
        """Return whether it may plan."""
        return self.is_ready

    def result(self) -> BodyPath:
        """Plan the last task."""
        return self.tasks[-1]()


def test_a_needle_is_kept_in_place_while_its_path_is_planned():
    planning = Planning()
    run, needle = begun(AWAY, submit=planning.submit)
    needle.pull, at = 4e-4 * needle.heading, needle.tail
    needle.run(run, 3.0)
    assert (run.state, run.path, len(planning.tasks)) == (ProcedureState.RUNNING, None, 1)
    assert math.dist(needle.tail, at) < 1e-4
    run.pause("by the operator")
    run.start()  # from where the needle is now
    planning.is_ready = True
    needle.run(run, 60.0)
    assert (run.state, len(planning.tasks)) == (ProcedureState.DONE, 2)


def test_a_needle_that_rests_backs_off_and_is_given_up_in_the_end():
    run, needle = begun(AWAY)
    needle.share = 0.0
    give_up(run, needle, "given up")
    assert needle.time < 30.0
    assert not run.update(needle.time, needle.tail, needle.heading, KNOWN).any()


def test_a_needle_that_is_held_at_the_wall_is_given_up_with_the_place_and_the_remedy():
    run, needle = begun(AWAY)[0], Needle(0.01472, 0.0)
    needle.share = 0.0
    give_up(run, needle, "the needle rests beside wall with motion_compensation of the coil bridge off, however")


def test_a_tightened_thread_ends_its_goal_and_one_that_stays_slack_fails():
    goal = {"tighten": {"tension": 1e-4, "toward": [-0.012, 0.0]}}
    run, needle = begun(goal)
    needle.run(run, 60.0, lambda: replace(KNOWN, tension=2e-4 if needle.time > 2.0 else 0.0))
    assert run.state is ProcedureState.DONE
    assert needle.time == pytest.approx(2.0, abs=0.2)
    give_up(*begun(goal), "not tight")


@pytest.mark.parametrize("left", [1e-3, 8e-3])
def test_a_thread_is_tight_wherever_that_is_on_the_path(left: float):
    goals: list[dict[str, Any]] = [
        {"wrap": {"around": "post", "angle": 2.0}},
        {"tighten": {"tension": 1e-4, "toward": [-0.010, 0.006]}},
    ]
    run, needle = begun(*goals)
    needle.run(run, 60.0, until=lambda: run.goal == 1 and run.is_tracking)

    def condition() -> ThreadCondition:
        tight = run.path is not None and run.path.length - run.travel < left
        return replace(KNOWN, vertices=needle.thread, tension=2e-4 if tight else 0.0)

    needle.run(run, 60.0, condition)
    assert (run.state, run.reason) == (ProcedureState.DONE, "")


def test_tension_near_its_limit_slows_the_needle_down():
    """A thread whose tension grows with the speed is pulled no harder than the limit."""
    run, needle = executor(AWAY, tension=1e-4), Needle(0.008, 0.008, math.pi)
    run.start()
    tensions: list[float] = []

    def condition() -> ThreadCondition:
        tensions.append(0.1 * (needle.way - before[0]) * RATE)  # 0.2 mN at the speed allowed
        before[0] = needle.way
        return replace(KNOWN, tension=tensions[-1])

    before = [0.0]
    needle.run(run, 120.0, condition)
    assert run.state is ProcedureState.DONE
    assert np.percentile(tensions, 95) < 1.1e-4


def test_a_shape_that_closes_the_way_fails_the_procedure_with_the_reason():
    run, needle = begun({"wrap": {"around": "post", "angle": 6.0}})
    needle.run(run, 1.0)
    run.set_planner(NeedlePlanner(Scene(Dish()), NEEDLE, 2.5e-4, 0.05))  # the post is gone
    assert run.state is ProcedureState.FAILED
    assert "a shape of the scene" in run.reason


GOAL_WITH_A_TURN = {"position": [-0.008, -0.004], "heading": [-math.pi / 2.0]}


def test_a_place_that_is_missed_however_it_is_planned_is_given_up_with_the_distance():
    run, needle = begun({"go_to": {**GOAL_WITH_A_TURN, "tolerance": 5e-5}})
    for _ in range(round(120.0 * RATE)):
        needle.pull = np.array([6e-4 if run.pursuit.misses % 2 else -6e-4, 0.0])  # that nobody compensates
        needle.run(run, 1.0 / RATE)
    assert run.state is ProcedureState.FAILED
    assert "the needle misses its place by" in run.reason
    assert "with a tolerance of 0.05 mm" in run.reason


@pytest.mark.parametrize("pauses", [False, True])
def test_a_wrap_that_is_unwound_by_hand_in_a_pause_does_not_count(pauses: bool):
    run, needle = executor({"wrap": {"around": "post", "angle": 6.2, "sense": "counterclockwise"}}), Needle()
    poses: list[tuple[np.ndarray, np.ndarray]] = []
    run.start()

    def wrapped() -> bool:
        poses.append((needle.tail, needle.heading))
        return run.judge.windings["post"] > 4.6

    needle.run(run, 300.0, until=wrapped)
    way = needle.way
    if pauses:
        run.pause("the operator has taken over")
        for tail, heading in reversed(poses):
            needle.tail, needle.heading, needle.time = tail, heading, needle.time + 1.0 / RATE
            needle.trail.pop()
            run.update(needle.time, tail, heading, replace(KNOWN, vertices=needle.thread))
        run.start()
    needle.run(run, 300.0)
    assert run.state is ProcedureState.DONE
    assert run.judge.windings["post"] > 6.1
    assert (needle.way > 1.9 * way) == pauses  # all of the way again, or what was left of it


@pytest.mark.slow
def test_a_thread_that_slips_off_is_wound_again_and_given_up_in_the_end():
    """The needle goes round, and the thread stays straight: what counts is the thread."""
    run, needle = begun({"wrap": {"around": "post", "angle": 6.2}})
    needle.run(run, 600.0, lambda: replace(KNOWN, vertices=np.array([needle.tail, [-0.012, 0.0]])))
    assert run.state is ProcedureState.FAILED
    assert "the thread slips on post: it winds" in run.reason
    assert "of 355 degrees" in run.reason


def test_a_wrap_that_has_slipped_off_at_the_end_fails_the_procedure():
    goals: list[dict[str, Any]] = [{"wrap": {"around": "post", "angle": 6.2}}, {"go_to": {"position": [-0.006, 0.004]}}]
    run, needle = begun(*goals)

    def condition() -> ThreadCondition:
        thread = needle.thread if run.goal == 0 else np.array([needle.tail, [-0.012, 0.0]])
        return replace(KNOWN, vertices=thread)

    needle.run(run, 300.0, condition)
    assert (run.state, run.goal) == (ProcedureState.FAILED, 1)
    assert "the thread slips on post" in run.reason


THROUGH: list[dict[str, Any]] = [
    {"pass_through": {"between": ["post", "wall"], "direction": [0.0, 1.0]}},
    {"go_to": {"position": [0.003, 0.008]}},
]


def test_a_needle_that_is_carried_past_a_gap_goes_back_and_passes_it():
    """It is where its path ends, but has not crossed the line across the gap."""
    run, needle = begun(*THROUGH)[0], Needle(0.010, -0.006, 1.5)
    needle.run(run, 60.0, until=lambda: needle.middle[1] > -0.002)
    assert (run.goal, run.judge.crossed) == (0, 0)
    for x in np.arange(needle.tail[0], -0.004, -0.004):  # carried around the post on its other side
        needle.tail = np.array([x, -0.006])
        needle.run(run, 1.0 / RATE)
    needle.tail, needle.heading = np.array([-0.004, 0.006]), np.array([1.0, 0.0])
    needle.run(run, 1.0 / RATE)
    needle.tail = np.array([0.010, 0.004])
    needle.run(run, 300.0)
    assert (run.state, run.reason) == (ProcedureState.DONE, "")


def test_a_shape_that_appears_in_a_gap_ahead_fails_the_procedure_and_one_in_a_gap_passed_does_not():
    plug = SceneShape("plug", "instrument", Disc((0.0112, 0.0), 0.004))
    for passed, y in ((False, -0.002), (True, 0.002)):
        run, needle = begun(*THROUGH)[0], Needle(0.010, -0.006, 1.5)
        needle.run(run, 60.0, until=partial(lambda needle, y: bool(needle.middle[1] > y), needle, y))
        run.set_planner(NeedlePlanner(Scene(Dish(), (POST, plug)), NEEDLE, 2.5e-4, 0.05))
        assert run.state is (ProcedureState.RUNNING if passed else ProcedureState.FAILED)
        assert passed or "a gap in which plug does not lie" in run.reason
        run.set_planner(NeedlePlanner(Scene(Dish()), NEEDLE, 2.5e-4, 0.05))  # the post is gone, and done with
        assert run.state is (ProcedureState.RUNNING if passed else ProcedureState.FAILED)
