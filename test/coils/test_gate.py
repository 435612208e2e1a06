"""The gate that every velocity command passes."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.gate import CommandGate
from magnetosuture_thread.errors import InvalidInputError

TIMEOUT, SPEED, HOLD = 0.1, 0.02, 1.0
EAST = np.array([0.01, 0.0])


def gate() -> CommandGate:
    """Return a gate with the limits above."""
    return CommandGate(TIMEOUT, SPEED, HOLD)


def test_before_any_command_it_stops():
    setpoint = gate().setpoint(5.0)
    assert setpoint.stop == "no command yet"
    assert setpoint.velocity.tolist() == [0.0, 0.0]


def test_a_good_command_is_followed_until_it_times_out():
    held = gate()
    held.accept(EAST, stamp=10.0, now=10.0, arrival=0.0)
    assert held.setpoint(0.0).velocity.tolist() == EAST.tolist()
    assert held.setpoint(0.0999).stop == ""
    late = held.setpoint(0.1001)
    assert late.stop.startswith("no command for 0.100")
    assert late.velocity.tolist() == [0.0, 0.0]


def test_after_a_stop_zeros_are_sent_for_a_while_and_then_no_more():
    held = gate()
    held.accept(EAST, stamp=10.0, now=10.0, arrival=0.0)
    assert held.setpoint(0.2).send
    assert held.setpoint(1.1).send
    assert not held.setpoint(1.3).send


def test_it_resumes_with_the_next_good_command():
    held = gate()
    held.accept(EAST, stamp=10.0, now=10.0, arrival=0.0)
    assert held.setpoint(3.0).stop
    held.accept(EAST, stamp=13.0, now=13.0, arrival=3.0)
    resumed = held.setpoint(3.0)
    assert resumed.stop == ""
    assert resumed.send
    assert held.setpoint(3.2).send  # and its zeros are sent anew


def test_speed_is_limited_and_direction_kept():
    held = gate()
    held.accept(np.array([3.0, 4.0]), stamp=0.0, now=0.0, arrival=0.0)
    np.testing.assert_allclose(held.setpoint(0.0).velocity, [0.012, 0.016])


@pytest.mark.parametrize(
    ("velocity", "stamp", "words"),
    [
        ((np.nan, 0.0), 10.0, "finite numbers"),
        ((0.0, np.inf), 10.0, "finite numbers"),
        ((0.01, 0.0), 9.8, "at most 0.1 s"),
        ((0.01, 0.0), 0.0, "at most 0.1 s"),
        ((0.01, 0.0), 10.2, "at most 0.05 s"),
        ((0.01, 0.0), 9.96, "no earlier than the last one's"),
    ],
)
def test_a_bad_command_is_refused_and_does_not_keep_the_needle_moving(
    velocity: tuple[float, float], stamp: float, words: str
):
    held = gate()
    held.accept(EAST, stamp=9.98, now=9.98, arrival=0.0)
    with pytest.raises(InvalidInputError, match=words):
        held.accept(np.array(velocity), stamp=stamp, now=10.0, arrival=0.02)
    assert held.setpoint(0.05).velocity.tolist() == EAST.tolist()
    assert held.setpoint(0.11).stop


def test_time_set_back_does_not_lock_the_gate():
    """A bag that is played again starts with earlier stamps; so does a simulation."""
    held = gate()
    held.accept(EAST, stamp=100.0, now=100.0, arrival=0.0)
    held.accept(EAST, stamp=5.0, now=5.0, arrival=1.0)
    assert held.setpoint(1.0).stop == ""
