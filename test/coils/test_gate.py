"""The gate that every velocity command passes."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.gate import CommandGate
from magnetosuture_thread.errors import InvalidInputError

TIMEOUT = 0.1
EAST = np.array([0.01, 0.0])


def gate() -> CommandGate:
    """Return a gate with the timeout above."""
    return CommandGate(TIMEOUT)


def test_before_any_command_it_is_closed():
    assert gate().closed(15.0, 5.0) == "no command yet"


def test_a_good_command_is_followed_until_it_times_out():
    held = gate()
    held.accept(EAST, stamp=10.0, number=1, now=10.0, arrival=0.0)
    assert held.velocity.tolist() == EAST.tolist()
    assert held.closed(10.0 + 0.0999, 0.0999) == ""
    assert held.closed(10.0 + 0.1001, 0.1001) == "no command for 0.1 s"


def test_it_opens_with_the_next_good_command():
    held = gate()
    held.accept(EAST, stamp=10.0, number=1, now=10.0, arrival=0.0)
    assert held.closed(10.0 + 3.0, 3.0)
    held.accept(EAST, stamp=13.0, number=2, now=13.0, arrival=3.0)
    assert held.closed(10.0 + 3.0, 3.0) == ""


def test_what_a_command_took_to_get_here_counts():
    held = gate()
    held.accept(EAST, stamp=9.94, number=1, now=10.0, arrival=0.0)
    assert held.closed(10.03, 0.03) == ""
    assert held.closed(10.05, 0.05) == "no command for 0.1 s"


def test_it_closes_although_the_stamps_clock_stands_still():
    held = gate()
    held.accept(EAST, stamp=10.0, number=1, now=10.0, arrival=0.0)
    assert held.closed(10.0, 0.09) == ""
    assert held.closed(10.0, 0.11) == "no command for 0.1 s"


def test_what_it_forgot_does_not_count_and_what_comes_then_does():
    held = gate()
    held.accept(EAST, stamp=10.0, number=1, now=10.0, arrival=0.0)
    held.forget()
    assert held.closed(10.0 + 0.01, 0.01) == "no command yet"
    held.accept(EAST, stamp=10.01, number=2, now=10.01, arrival=0.01)
    assert held.closed(10.0 + 0.01, 0.01) == ""


def test_a_command_is_kept_as_it_came_for_the_filter_to_limit():
    held = gate()
    held.accept(np.array([-1e308, 1e308]), stamp=1.0, number=2, now=1.0, arrival=0.0)
    assert held.velocity.tolist() == [-1e308, 1e308]


@pytest.mark.parametrize(
    ("velocity", "stamp", "words"),
    [
        ((np.nan, 0.0), 10.0, "finite numbers"),
        ((0.0, np.inf), 10.0, "finite numbers"),
        ((0.01, 0.0), 9.8, "at most 0.1 s"),
        ((0.01, 0.0), 0.0, "0 is none in ROS"),
        ((0.01, 0.0), 10.2, "at most 0.05 s"),
        ((0.01, 0.0), 9.96, "no earlier than the last one's"),
    ],
)
def test_a_bad_command_is_refused_and_does_not_keep_the_needle_moving(
    velocity: tuple[float, float], stamp: float, words: str
):
    held = gate()
    held.accept(EAST, stamp=9.98, number=1, now=9.98, arrival=0.0)
    with pytest.raises(InvalidInputError, match=words):
        held.accept(np.array(velocity), stamp=stamp, number=2, now=10.0, arrival=0.02)
    assert held.velocity.tolist() == EAST.tolist()
    assert held.closed(9.98 + 0.05, 0.05) == ""
    assert held.closed(9.98 + 0.11, 0.11) == "no command for 0.1 s"


def test_time_set_back_does_not_lock_the_gate():
    """A bag that is played again starts with earlier stamps; so does a simulation."""
    held = gate()
    held.accept(EAST, stamp=100.0, number=1, now=100.0, arrival=0.0)
    held.accept(EAST, stamp=5.0, number=1, now=5.0, arrival=1.0)
    assert held.closed(5.0, 1.0) == ""


def test_before_the_clock_runs_nothing_is_good():
    with pytest.raises(InvalidInputError, match="0 is none in ROS"):
        gate().accept(EAST, stamp=0.0, number=1, now=0.0, arrival=0.0)


def test_two_that_command_at_once_close_it_until_one_is_silent():
    held = gate()
    for k in range(10):
        at = 0.02 * (k + 1)
        held.accept(EAST, stamp=at, number=500 + k, now=at, arrival=at)
    with pytest.raises(InvalidInputError, match="2 publishers at once"):
        held.accept(-EAST, stamp=0.205, number=1, now=0.205, arrival=0.205)
    assert held.velocity.tolist() == EAST.tolist()
    assert held.closed(0.206, 0.206) == "several publishers of needle/servo_cv at once"
    with pytest.raises(InvalidInputError, match="2 publishers at once"):
        held.accept(EAST, stamp=0.22, number=510, now=0.22, arrival=0.22)
    for k in range(11, 40):
        at = 0.02 * (k + 1)
        if at < 0.7:
            with pytest.raises(InvalidInputError, match="publishers"):
                held.accept(EAST, stamp=at, number=500 + k, now=at, arrival=at)
        elif at > 0.72:
            held.accept(EAST, stamp=at, number=500 + k, now=at, arrival=at)
            assert held.closed(at, at) == ""
