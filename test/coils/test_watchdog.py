"""Validation and timeout of velocity commands."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.inputs import AGE_WINDOW, CommandWatchdog, StampAges
from magnetosuture_thread.settings.errors import InvalidInputError

TIMEOUT = 0.1
EAST = np.array([0.01, 0.0])


def make_watchdog() -> CommandWatchdog:
    """Return a watchdog with the timeout above."""
    return CommandWatchdog(TIMEOUT)


def test_command_is_valid_until_it_times_out():
    watchdog = make_watchdog()
    watchdog.update(EAST, stamp=10.0, number=1, now=10.0, arrival=0.0)
    assert watchdog.velocity.tolist() == EAST.tolist()
    assert watchdog.stale_reason(10.0 + 0.0999, 0.0999) == ""
    assert watchdog.stale_reason(10.0 + 0.1001, 0.1001) == "no command for 0.1 s"


def test_command_times_out_while_the_stamps_clock_stands_still():
    watchdog = make_watchdog()
    watchdog.update(EAST, stamp=10.0, number=1, now=10.0, arrival=0.0)
    assert watchdog.stale_reason(10.0, 0.09) == ""
    assert watchdog.stale_reason(10.0, 0.11) == "no command for 0.1 s"


def test_only_commands_after_clear_are_valid():
    watchdog = make_watchdog()
    watchdog.update(EAST, stamp=10.0, number=1, now=10.0, arrival=0.0)
    watchdog.clear()
    assert watchdog.stale_reason(10.0 + 0.01, 0.01) == "no command yet"
    watchdog.update(EAST, stamp=10.01, number=2, now=10.01, arrival=0.01)
    assert watchdog.stale_reason(10.0 + 0.01, 0.01) == ""


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
def test_invalid_command_is_rejected_and_does_not_extend_the_timeout(
    velocity: tuple[float, float], stamp: float, words: str
):
    watchdog = make_watchdog()
    watchdog.update(EAST, stamp=9.98, number=1, now=9.98, arrival=0.0)
    with pytest.raises(InvalidInputError, match=words):
        watchdog.update(np.array(velocity), stamp=stamp, number=2, now=10.0, arrival=0.02)
    assert watchdog.velocity.tolist() == EAST.tolist()
    assert watchdog.stale_reason(9.98 + 0.05, 0.05) == ""
    assert watchdog.stale_reason(9.98 + 0.11, 0.11) == "no command for 0.1 s"


def test_time_set_back_does_not_make_every_command_stale():
    """A bag that is played again starts with earlier stamps; so does a simulation."""
    watchdog = make_watchdog()
    watchdog.update(EAST, stamp=100.0, number=1, now=100.0, arrival=0.0)
    watchdog.update(EAST, stamp=5.0, number=1, now=5.0, arrival=1.0)
    assert watchdog.stale_reason(5.0, 1.0) == ""


def test_the_minimum_age_of_the_last_seconds_is_kept_for_each_topic():
    ages = StampAges()
    for arrival, age in ((0.0, 0.004), (1.0, 0.050), (2.0, 0.020), (3.0, 0.030)):
        ages.add("needle/servo_cv", age, arrival)
    ages.add("needle/measured_cp", -0.012, 3.0)
    assert ages.minimum(3.0) == {"needle/servo_cv": 0.004, "needle/measured_cp": -0.012}
    assert ages.minimum(0.5 + AGE_WINDOW)["needle/servo_cv"] == 0.020
    assert ages.minimum(2.5 + AGE_WINDOW)["needle/servo_cv"] == 0.030
    assert ages.minimum(3.5 + AGE_WINDOW) == {}
