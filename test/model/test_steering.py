"""What an operator asks of the needle, filtered by the session."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.configuration import from_mapping
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError, SolverError
from magnetosuture_thread.model.friction import FrictionState
from magnetosuture_thread.model.needle import NeedleFilter
from magnetosuture_thread.model.predictor import NeedlePose
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings

SECOND = 1_000_000_000
PERIOD = SECOND // 30
# A gate of two discs, 0.8 mm from the thread on either side, 6 mm behind the needle.
GATE = [-0.006, 0.0018, 0.001, -0.006, -0.0018, 0.001]
ASKED = np.array([3e-3, 1e-3])


def session(**values: Any) -> ThreadSession:
    """Return a session whose thread begins straight behind a needle that points east."""
    return ThreadSession(from_mapping(ThreadModelSettings, {"initial_shape": "straight", **values}))


def drive(session: ThreadSession, first: int, last: int, speed: float = 3e-3, x: float = 0.0) -> float:
    """Show poses of a needle that goes east [m/s]; return where it is [m]."""
    for k in range(first, last):
        at = x + speed * (k - first) / 30.0
        outcome = session.on_pose(SECOND + k * PERIOD, NeedlePose(1.0 + k * PERIOD * 1e-9, np.array([at, 0.0]), EAST))
        assert outcome.problem is None
    return at


EAST = np.array([1.0, 0.0])


def test_a_free_thread_lets_the_needle_go_as_asked():
    model = session()
    drive(model, 0, 5)
    found = model.on_asked(SECOND + 5 * PERIOD, ASKED)
    np.testing.assert_array_equal(found.passed, ASKED)
    assert (found.slowdown, found.held_off, found.reason) == (1.0, False, "")


def test_friction_slows_a_needle_that_pulls_and_no_other():
    model = session(disc_obstacles=GATE, friction_threshold=1.2e-3, friction_averaging=0.0)
    x = drive(model, 0, 5)
    pulled = model.on_asked(SECOND + 5 * PERIOD, ASKED)
    assert 0.5 < pulled.slowdown < 1.0
    np.testing.assert_allclose(pulled.passed, pulled.slowdown * ASKED, rtol=1e-9)
    drive(model, 5, 10, speed=0.0, x=x)
    resting = model.on_asked(SECOND + 10 * PERIOD, ASKED)
    np.testing.assert_array_equal(resting.passed, ASKED)


def test_the_margins_tell_friction():
    model = session(disc_obstacles=GATE, friction_threshold=1.2e-3, friction_averaging=0.0)
    x = drive(model, 0, 5)
    states = []
    for k, at in ((5, x + 1e-4), (6, x + 1e-4)):
        pose = NeedlePose(1.0 + k * PERIOD * 1e-9, np.array([at, 0.0]), EAST)
        margins = model.on_pose(SECOND + k * PERIOD, pose).margins
        assert margins is not None
        states.append(margins.friction)
    assert [friction.state for friction in states] == [FrictionState.PULLED, FrictionState.RESTING]
    assert states[0].nodes == states[1].nodes
    assert len(states[0].nodes) >= 2


@pytest.mark.parametrize("length", [0.0, 0.004])
def test_an_obstacle_holds_the_needle_off(length: float):
    """A disc 1 mm ahead of the point that is steered."""
    model = session(disc_obstacles=[length + 0.003, 0.0, 0.002], needle_length=length, needle_clearance=5e-4)
    drive(model, 0, 3, speed=0.0)
    now = SECOND + 3 * PERIOD
    ahead = model.on_asked(now, np.array([20e-3, 0.0]))
    np.testing.assert_allclose(ahead.passed, [5e-3, 0.0], atol=1e-8)  # alpha h = 10 / s times 0.5 mm
    assert ahead.held_off
    np.testing.assert_array_equal(model.on_asked(now, np.array([-20e-3, 0.0])).passed, [-20e-3, 0.0])


def test_a_needle_that_is_a_point_is_where_the_thread_begins():
    """Its thread is fixed 3 mm ahead of its tail, 1 mm before a disc."""
    model = session(disc_obstacles=[0.006, 0.0, 0.002], attachment_offset=[0.003, 0.0], needle_clearance=5e-4)
    drive(model, 0, 3, speed=0.0)
    ahead = model.on_asked(SECOND + 3 * PERIOD, np.array([20e-3, 0.0]))
    np.testing.assert_allclose(ahead.passed, [5e-3, 0.0], atol=1e-8)


@pytest.mark.parametrize("x", [0.0, 0.001, 0.0025])
def test_who_asks_for_rest_gets_exactly_that(x: float):
    """Free, close to a disc, and within it."""
    model = session(disc_obstacles=[0.003, 0.0, 0.002], needle_length=0.004)
    drive(model, 0, 3, speed=0.0, x=x)
    for zero in (np.zeros(2), np.array([-0.0, 0.0])):
        found = model.on_asked(SECOND + 3 * PERIOD, zero)
        np.testing.assert_array_equal(found.passed, [0.0, 0.0])
        assert not found.held_off


def test_rest_needs_no_filter(monkeypatch: pytest.MonkeyPatch):
    model = session(disc_obstacles=[0.003, 0.0, 0.002])
    drive(model, 0, 3, speed=0.0)

    def fail(*_: object) -> None:
        raise SolverError("banded", "iteration limit", 1.0, 1e-6)

    monkeypatch.setattr(NeedleFilter, "safe_velocity", fail)
    np.testing.assert_array_equal(model.on_asked(SECOND + 3 * PERIOD, np.zeros(2)).passed, [0.0, 0.0])
    with pytest.raises(SolverError):
        model.on_asked(SECOND + 3 * PERIOD, ASKED)


def test_a_curved_needle_is_held_off_by_where_its_tip_is():
    """It bends to the left by a third of a turn; what is ahead of its tail does not hold it off."""
    bend = 2.0 * np.pi / 3.0 / 0.004
    tip = 0.004 * np.sinc(1.0 / 3.0) * np.array([np.cos(np.pi / 3.0), np.sin(np.pi / 3.0)])
    disc = [float(tip[0]), float(tip[1]) + 3e-3, 2e-3]  # 1 mm to the left of the tip
    for curvature, held_off in ((bend, True), (-bend, False)):
        model = session(disc_obstacles=disc, needle_length=0.004, needle_curvature=curvature)
        drive(model, 0, 3, speed=0.0)
        assert model.on_asked(SECOND + 3 * PERIOD, np.array([0.0, 20e-3])).held_off is held_off


def test_a_change_of_settings_does_not_bring_the_thread_to_rest():
    values = {"disc_obstacles": GATE, "friction_threshold": 1.2e-3, "initial_shape": "straight"}
    model = session(**values)
    x = drive(model, 0, 9)
    before = model.on_asked(SECOND + 9 * PERIOD, ASKED).slowdown
    assert before < 1.0
    model.change(from_mapping(ThreadModelSettings, {**values, "contact_tolerance": 2e-5}))
    drive(model, 9, 10, speed=0.0, x=x)  # averaged, it still moves
    assert model.on_asked(SECOND + 10 * PERIOD, ASKED).slowdown == pytest.approx(before, rel=0.2)


def test_a_step_that_did_not_converge_proves_nothing(monkeypatch: pytest.MonkeyPatch):
    model = session()
    drive(model, 0, 3)
    step = model._predictor.step
    monkeypatch.setattr(model._predictor, "step", lambda pose: replace(step(pose), converged=False))
    drive(model, 3, 12)
    assert "old" in model.on_asked(SECOND + 11 * PERIOD, ASKED).reason
    assert not model.on_asked(SECOND + 4 * PERIOD, ASKED).reason


def test_only_obstacles_that_are_in_force_hold_it_off():
    model = session()
    drive(model, 0, 3, speed=0.0)
    now, asked = SECOND + 3 * PERIOD, np.array([20e-3, 0.0])
    assert not model.on_asked(now, asked).held_off
    told = from_mapping(ThreadModelSettings, {"initial_shape": "straight", "disc_obstacles": [0.003, 0.0, 0.002]})
    model.change(told)
    assert model.on_asked(now, asked).held_off


def test_without_a_predicted_thread_the_needle_rests():
    model = session(steering_timeout=0.2)
    found = model.on_asked(SECOND, ASKED)
    np.testing.assert_array_equal(found.passed, [0.0, 0.0])
    assert found.reason == "no predicted thread yet"
    drive(model, 0, 4)
    last = SECOND + 3 * PERIOD
    assert not model.on_asked(last + SECOND // 5, ASKED).reason
    late = model.on_asked(last + SECOND // 4, ASKED)
    assert late.reason == "the last predicted thread is 0.25 s old"
    np.testing.assert_array_equal(late.passed, [0.0, 0.0])
    assert model.on_asked(last - SECOND // 2, ASKED).reason  # of a time before


def test_while_the_thread_is_waited_for_anew_the_one_before_does_not_count():
    """Time was set back, and the camera has not seen the thread yet."""
    model = session(initial_shape="seen")
    list(model.on_seen(5 * SECOND, np.column_stack([-np.linspace(0.0, 0.019, 60), np.zeros(60)])))
    assert model.on_pose(5 * SECOND, NeedlePose(5.0, np.zeros(2), EAST)).prediction is not None
    assert not model.on_asked(5 * SECOND, ASKED).reason
    assert model.on_pose(SECOND, NeedlePose(1.0, np.zeros(2), EAST)).waiting
    assert model.on_asked(5 * SECOND, ASKED).reason == "no predicted thread yet"


def test_a_predicted_thread_of_a_time_that_was_set_back_does_not_count():
    model = session()
    drive(model, 120, 124)
    model.on_pose(SECOND, NeedlePose(1.0, np.zeros(2), EAST))
    assert model.on_asked(SECOND + 123 * PERIOD, ASKED).reason
    assert not model.on_asked(SECOND, ASKED).reason


@pytest.mark.parametrize("asked", [[np.nan, 0.0], [np.inf, 0.0], [1.1, 0.0], [1e300, -1e300]])
@pytest.mark.parametrize("poses", [0, 4])
def test_what_is_no_velocity_is_refused(asked: list[float], poses: int):
    model = session()
    if poses:
        drive(model, 0, poses)
    with pytest.raises(InvalidInputError, match="needle velocity"):
        model.on_asked(SECOND + poses * PERIOD, np.array(asked))


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"friction_threshold": 6e-3}, "friction_threshold"),
        ({"needle_clearance": 6e-3}, "needle_clearance"),
        ({"needle_length": 0.01, "needle_curvature": 500.0}, "needle_curvature"),
    ],
)
def test_settings_that_do_not_fit_are_refused(values: dict[str, float], name: str):
    with pytest.raises(ConfigurationError, match=f"thread_model.{name}"):
        from_mapping(ThreadModelSettings, values)
