"""The procedure of a planner without a graph: what is known, for how long, and what that lets a procedure do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.planning.executor import ProcedureState
from magnetosuture_thread.planning.procedure import parse_procedure
from magnetosuture_thread.planning.session import LoopState, NeedlePlannerSettings, ProcedureSession
from magnetosuture_thread.settings.errors import InvalidInputError


def thread() -> np.ndarray:
    return np.zeros((3, 2))


def known(**changes: Any) -> LoopState:
    """Return a state in which all is known."""
    state = LoopState(NeedlePlannerSettings(**changes))
    state.scene_version = "1"
    state.on_pose(0.0, 0.006, 0.0175)
    state.on_estimate(0.0, 0.0, {}, thread)
    state.on_margins(0.0, "", 3, 0.7, "1")
    return state


@pytest.mark.parametrize("unmeasured", [1.01, math.inf, math.nan])
def test_an_estimate_that_was_not_measured_is_unsure(unmeasured: float):
    state = known()
    state.on_estimate(0.0, unmeasured, {}, thread)
    assert "not been measured" in state.condition(0.1).problem


def test_all_has_to_be_known_again_for_a_while():
    state = known()
    state.on_tracker("two needles")
    assert not state.condition(0.5).problem  # one frame or two without a needle are none
    lost = state.condition(0.51)
    assert "two needles" in lost.problem
    assert not lost.may_hold
    state.on_tracker("")
    state.on_pose(0.7, 0.006, 0.0175)
    state.on_margins(0.7, "", 0, 1.0, "1")
    settling = state.condition(0.7)
    assert "two needles" in settling.problem
    assert settling.may_hold
    assert not state.condition(1.02).problem


def test_the_needle_may_be_held_while_the_thread_alone_is_not_known():
    state = known(settle=0.0)
    state.on_margins(0.0, "the residual is too large", 0, 1.0, "1")
    assert state.condition(0.1).may_hold
    state.hold_to_run = True
    assert not state.condition(0.1).may_hold  # whoever lets go of the page wants no more commands
    state.on_hold(0.1)
    assert state.condition(0.1).may_hold
    state.on_graph("2 nodes publish needle/servo_cv")
    assert not state.condition(0.1).may_hold


def test_a_force_that_is_new_is_a_problem_and_one_that_a_person_goes_on_with_is_none():
    state = known(settle=0.0)
    state.on_estimate(0.0, 0.0, {3.5: "held at 10 mm"}, thread)
    assert state.condition(0.1).problem == "an unmodelled contact: the thread is held at 10 mm"
    state.accept_disturbances()
    assert not state.condition(0.1).problem
    state.on_estimate(0.0, 0.0, {3.5: "held at 12 mm", 4.0: "held at 30 mm"}, thread)
    assert state.condition(0.1).problem == "an unmodelled contact: the thread is held at 30 mm"
    state.on_estimate(0.0, 0.0, {}, thread)
    assert not state.condition(0.1).problem
    state.on_estimate(0.0, 0.0, {3.5: "held at 10 mm"}, thread)  # it was gone
    assert "held at 10 mm" in state.condition(0.1).problem


EAST = np.array([1.0, 0.0])


def running(settings: NeedlePlannerSettings) -> ProcedureSession:
    """Return a session whose procedure runs at time 0."""
    run = ProcedureSession(settings, Scene(Dish(0.035)))
    show(run, 0.0)
    run.plan(parse_procedure({"goals": [{"go_to": {"position": [-0.012, 0.0]}}]}, "far"), 0.0)
    run.resume(0.0)
    show(run, 0.0)
    assert run.is_running
    return run


def show(run: ProcedureSession, now: float) -> None:
    """Show the needle, with a thread that is known."""
    run.known.on_estimate(now, 0.0, {}, thread)
    run.known.on_margins(now, "", 0, 1.0, run.known.scene_version)
    run.on_pose(now, np.array([-0.006, 0.0]), EAST, now)


@pytest.mark.parametrize("looked", [True, False])
def test_after_a_long_absence_of_the_needle_a_person_begins_again(looked: bool):
    """Whether or not somebody looks at the clock meanwhile: the process may have been stopped as well."""
    run = running(NeedlePlannerSettings(needle_length=0.0025, pose_timeout=0.5, settle=0.0))
    for now in (0.6, 1.49) if looked else ():
        run.check(now)
        assert run.status.resumes
    show(run, 1.49)
    assert run.is_running  # a short absence ends by itself
    for now in (2.0, 3.0) if looked else ():
        run.check(now)
    show(run, 3.1)
    show(run, 3.2)
    status = run.status
    assert (status.state, status.resumes) == (ProcedureState.PAUSED, False)
    assert status.reason == "the needle was not seen for more than 1.5 s: look, then resume"
    assert not run.is_commanding
    run.resume(3.2)
    show(run, 3.3)
    assert run.is_running


def test_a_person_cannot_go_on_while_the_needle_is_away():
    run = running(NeedlePlannerSettings(needle_length=0.0025, pose_timeout=0.5, settle=0.0))
    run.check(2.0)
    with pytest.raises(InvalidInputError, match="expected a needle that is tracked"):
        run.resume(2.0)
    show(run, 2.2)
    assert not run.is_running


def test_another_scene_ends_what_was_only_planned():
    run = ProcedureSession(NeedlePlannerSettings(needle_length=0.0025), Scene(Dish(0.035)))
    run.on_pose(0.0, np.array([-0.006, 0.0]), np.array([1.0, 0.0]), 0.0)
    run.plan(parse_procedure({"goals": [{"go_to": {"position": [-0.012, 0.0]}}]}, "far"), 0.0)
    run.set_scene(Scene(Dish(0.05)))
    assert (run.status.state, run.status.reason) == (
        ProcedureState.FAILED,
        "the scene has changed since it was planned",
    )
