"""Dead man's switch and delay of jog messages."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.console.jog_controller import ZERO_VELOCITY, DeadManSwitch, DelayEstimator

EAST = (0.003, 0.0)
NORTH = (0.0, 0.003)


def test_jog_is_sent_at_once_and_repeated_while_fresh():
    switch = DeadManSwitch(0.15)
    assert switch.press(EAST, 0.0) == EAST
    assert [switch.due(t) for t in (0.02, 0.1, 0.149)] == [EAST] * 3


def test_timeout_sends_one_zero():
    switch = DeadManSwitch(0.15)
    switch.press(EAST, 0.0)
    assert [switch.due(t) for t in (0.15, 0.17, 5.0)] == [ZERO_VELOCITY, None, None]
    assert not switch.moving


def test_release_sends_one_zero():
    switch = DeadManSwitch(0.15)
    switch.press(EAST, 0.0)
    assert switch.release() == ZERO_VELOCITY
    assert switch.release() is None
    assert switch.due(0.01) is None


def test_stop_requires_a_release():
    switch = DeadManSwitch(0.15)
    switch.press(EAST, 0.0)
    assert switch.stop() == ZERO_VELOCITY
    assert switch.press(EAST, 0.01) is None
    assert switch.due(0.02) is None
    assert switch.release() is None
    assert switch.press(EAST, 0.03) == EAST


def test_stop_after_a_timeout_requires_a_release():
    """The network held the words up, and the key is still down as they come again."""
    switch = DeadManSwitch(0.15)
    switch.press(EAST, 0.0)
    assert switch.due(0.2) == ZERO_VELOCITY
    assert switch.stop() is None
    assert switch.press(EAST, 0.3) is None
    switch.release()
    assert switch.press(EAST, 0.4) == EAST


def test_interruption_ends_the_motion_and_clears_no_stop():
    switch = DeadManSwitch(0.15)
    switch.press(EAST, 0.0)
    assert switch.interrupt() == ZERO_VELOCITY
    assert switch.press(EAST, 0.01) == EAST
    switch.stop()
    assert switch.interrupt() is None
    assert switch.press(EAST, 0.02) is None


words = st.lists(
    st.tuples(st.sampled_from(["press", "release", "interrupt", "stop", "due"]), st.floats(0.0, 0.2)), max_size=60
)


@given(words)
def test_every_motion_ends_with_one_zero(said):
    switch = DeadManSwitch(0.15)
    now, heard, sent = 0.0, -1.0, []
    for word, after in said:
        now += after
        if word == "press":
            heard = now
            out = switch.press(EAST, now)
        else:
            out = switch.due(now) if word == "due" else getattr(switch, word)()
        if out == EAST:
            assert now - heard < 0.15
        sent.append(out)
    sent.append(switch.due(now + 1.0))
    said_out = [out for out in sent if out is not None]
    assert not said_out or said_out[-1] == ZERO_VELOCITY
    assert all(not (a == b == ZERO_VELOCITY) for a, b in pairwise(said_out))


def test_delayed_messages_are_late():
    estimator = DelayEstimator()
    assert estimator.update(100.0, 5.0) == 0.0
    assert abs(estimator.update(100.1, 5.6) - 0.5) < 1e-3
    assert estimator.update(101.0, 6.01) < 0.02


def test_delay_is_relative_to_the_fastest_message_despite_clock_drift():
    estimator = DelayEstimator()
    estimator.update(0.0, 10.0)
    assert estimator.update(1.0, 10.9) == 0.0
    assert estimator.update(3601.0, 3611.0) == 0.0  # 28 ppm apart
