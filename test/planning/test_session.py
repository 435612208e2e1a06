"""The procedure of a planner without a graph: what is known, for how long, and what that lets a procedure do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.planning.executor import ProcedureState
from magnetosuture_thread.planning.procedure import Procedure, parse_procedure
from magnetosuture_thread.planning.session import LoopState, NeedlePlannerSettings, ProcedureSession
from magnetosuture_thread.settings.errors import InvalidInputError

SCENE = Scene(Dish(0.035))
SETTINGS = NeedlePlannerSettings(needle_length=0.0025)
TAIL, EAST = np.array([-0.006, 0.0]), np.array([1.0, 0.0])


def thread() -> np.ndarray:
    return np.zeros((3, 2))


def known(now: float = 0.0, **changes: Any) -> LoopState:
    """Return a state in which all is known."""
    state = LoopState(NeedlePlannerSettings(**changes))
    state.scene_version = "1"
    state.on_pose(now, 0.006, 0.0175)
    state.on_estimate(0.0, 0.0, {}, thread)
    state.on_margins(now, "", 3, 0.7, "1")
    return state


@pytest.mark.parametrize("unmeasured", [1.01, math.inf, math.nan])
def test_an_estimate_that_was_not_measured_is_unsure(unmeasured: float):
    state = known()
    state.on_estimate(0.0, unmeasured, {}, thread)
    assert "not been measured" in state.condition(0.1).problem


def test_what_is_known_is_not_known_for_long_and_a_time_without_hearing_does_not_count():
    state = known(hold_timeout=0.3)
    assert not state.condition(0.5).problem
    assert "no needle pose for more than 0.5 s" in state.condition(0.51).problem
    state = known()
    state.shift(5.0)
    assert not state.condition(5.4).problem
    state.on_pose(6.0, 0.006, 0.0175)
    assert "no margins of the thread for more than 0.5 s" in state.condition(6.0).problem


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


def session(now: float = 0.0) -> ProcedureSession:
    """Return a session whose needle and thread are known."""
    made = ProcedureSession(SETTINGS, SCENE)
    made.on_pose(0.0, TAIL, EAST, now)
    made.known.on_estimate(0.0, 0.0, {}, thread)
    made.known.on_margins(now, "", 0, 1.0, SCENE.version)
    return made


def far() -> Procedure:
    goals = [{"go_to": {"position": [-0.012, 0.0]}}, {"withdraw": {}}]
    return parse_procedure({"goals": goals, "limits": {"speed": 0.002}}, "far")


def test_a_plan_moves_nothing_and_is_begun_by_an_act_of_its_own():
    run = session()
    paths = run.plan(far(), 0.0)
    assert run.planned_duration == pytest.approx(sum(path.length for path in paths) / 0.002)
    assert run.on_pose(0.05, TAIL, EAST, 0.05) is None
    plan = run.new_plan()
    assert plan is not None
    np.testing.assert_array_equal(plan[:, :2], np.vstack([path.middles for path in paths]))
    np.testing.assert_array_equal(plan[:, 2], np.concatenate([path.angles for path in paths]))
    assert run.new_plan() is None
    run.resume()
    velocities = [run.on_pose(0.1 + 0.05 * k, TAIL, EAST, 0.1 + 0.05 * k) for k in range(4)]
    assert velocities[-1] is not None
    assert velocities[-1].any()
    assert run.setpoint is not None
    assert 0.01 < run.status.clearance < 0.0175


def test_a_force_that_is_found_before_the_needle_is_moved_was_there_when_a_person_began():
    run = session()
    run.plan(far(), 0.0)
    run.resume()
    run.known.on_estimate(0.0, 0.0, {0.06: "held at 10 mm"}, thread)
    velocities = [run.on_pose(0.1 + 0.05 * k, TAIL, EAST, 0.1 + 0.05 * k) for k in range(4)]
    assert velocities[-1] is not None
    assert velocities[-1].any()
    run.known.on_estimate(0.0, 0.0, {0.06: "held at 10 mm", 0.3: "held at 30 mm"}, thread)
    run.on_pose(0.3, TAIL, EAST, 0.3)
    assert run.status.reason == "an unmodelled contact: the thread is held at 30 mm"


def test_who_paused_decides_whether_it_goes_on_by_itself():
    run = session()
    run.plan(far(), 0.0)
    run.resume()
    run.known.on_tracker("lost")
    run.check(0.6)
    assert (run.status.state, run.status.resumes) == (ProcedureState.PAUSED, True)
    assert run.pause("an operator commands the needle")
    run.known.on_tracker("")
    for k in range(20):
        now = 0.6 + 0.1 * k
        run.known.on_margins(now, "", 0, 1.0, SCENE.version)
        assert run.on_pose(now, TAIL, EAST, now) is None
    assert (run.status.state, run.status.resumes) == (ProcedureState.PAUSED, False)
    run.on_bridge(False, 0.0)
    with pytest.raises(InvalidInputError, match="not armed"):
        run.resume()
    assert run.status.reason == "an operator commands the needle"


def test_only_one_procedure_at_a_time_and_none_of_an_unknown_needle():
    run = session()
    with pytest.raises(InvalidInputError, match="a needle that is tracked"):
        run.plan(far(), 10.0)
    run.plan(far(), 0.0)
    run.plan(far(), 0.0)  # what was only planned is planned anew
    run.resume()
    with pytest.raises(InvalidInputError, match="none while another is executed: far, at goal 1 of 2"):
        run.plan(far(), 0.0)
    assert run.abort("given up")
    assert not run.abort("given up")
    with pytest.raises(InvalidInputError, match="a procedure that is failed"):
        run.resume()


def test_another_scene_ends_what_was_only_planned():
    run = session()
    run.plan(far(), 0.0)
    run.set_scene(Scene(Dish(0.05)))
    assert (run.status.state, run.status.reason) == (
        ProcedureState.FAILED,
        "the scene has changed since it was planned",
    )
