"""The needle goes on only while somebody keeps saying so."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.console.dead_man import REST, DeadManSwitch
from magnetosuture_thread.console.lateness import Lateness

EAST = (0.003, 0.0)
NORTH = (0.0, 0.003)


def test_what_is_held_goes_out_at_once_and_then_in_each_period_while_it_is_young():
    switch = DeadManSwitch(0.15)
    assert switch.hold(EAST, 0.0) == EAST
    assert [switch.due(t) for t in (0.02, 0.1, 0.149)] == [EAST] * 3


def test_a_word_that_says_the_same_prolongs_and_adds_no_command():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    assert switch.hold(EAST, 0.1) is None
    assert switch.due(0.24) == EAST


def test_another_direction_goes_out_at_once():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    assert switch.hold(NORTH, 0.01) == NORTH


def test_silence_ends_in_one_zero_and_then_nothing():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    assert [switch.due(t) for t in (0.15, 0.17, 5.0)] == [REST, None, None]
    assert not switch.moving


def test_a_release_ends_in_one_zero():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    assert switch.release() == REST
    assert switch.release() is None
    assert switch.due(0.01) is None


def test_holding_nothing_is_a_release():
    switch = DeadManSwitch(0.15)
    assert switch.hold(REST, 0.0) is None
    switch.hold(EAST, 0.0)
    assert switch.hold((0.0, -0.0), 0.01) == REST


def test_after_a_stop_a_key_has_to_be_let_go_first():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    assert switch.stop() == REST
    assert switch.hold(EAST, 0.01) is None
    assert switch.due(0.02) is None
    assert switch.release() is None
    assert switch.hold(EAST, 0.03) == EAST


def test_after_a_stop_of_nothing_the_next_key_counts():
    switch = DeadManSwitch(0.15)
    assert switch.stop() is None
    assert switch.hold(EAST, 0.0) == EAST


def test_a_stop_counts_though_what_is_held_was_not_heard_in_time():
    """The network held the words up, and the key is still down as they come again."""
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    assert switch.due(0.2) == REST
    assert switch.stop() is None
    assert switch.hold(EAST, 0.3) is None
    switch.release()
    assert switch.hold(EAST, 0.4) == EAST


def test_a_stop_after_a_release_asks_for_no_other():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    switch.release()
    assert switch.stop() is None
    assert switch.hold(EAST, 0.1) == EAST


def test_an_interruption_ends_the_movement_and_lifts_no_stop():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    assert switch.interrupt() == REST
    assert switch.hold(EAST, 0.01) == EAST
    switch.stop()
    assert switch.interrupt() is None
    assert switch.hold(EAST, 0.02) is None


def test_a_second_stop_does_not_undo_the_first():
    switch = DeadManSwitch(0.15)
    switch.hold(EAST, 0.0)
    switch.stop()
    assert switch.stop() is None
    assert switch.hold(EAST, 0.01) is None


words = st.lists(
    st.tuples(st.sampled_from(["hold", "release", "interrupt", "stop", "due"]), st.floats(0.0, 0.2)), max_size=60
)


@given(words)
def test_whatever_is_said_every_movement_is_ended_by_one_zero(said):
    switch = DeadManSwitch(0.15)
    now, heard, sent = 0.0, -1.0, []
    for word, after in said:
        now += after
        if word == "hold":
            heard = now
            out = switch.hold(EAST, now)
        else:
            out = switch.due(now) if word == "due" else getattr(switch, word)()
        if out == EAST:
            assert now - heard < 0.15
        sent.append(out)
    sent.append(switch.due(now + 1.0))
    said_out = [out for out in sent if out is not None]
    assert not said_out or said_out[-1] == REST
    assert all(not (a == b == REST) for a, b in pairwise(said_out))


def test_words_that_the_network_held_up_are_late():
    lateness = Lateness()
    assert lateness.of(100.0, 5.0) == 0.0
    assert abs(lateness.of(100.1, 5.6) - 0.5) < 1e-3
    assert lateness.of(101.0, 6.01) < 0.02


def test_the_quickest_word_is_the_measure_and_clocks_may_drift():
    lateness = Lateness()
    lateness.of(0.0, 10.0)
    assert lateness.of(1.0, 10.9) == 0.0
    assert lateness.of(3601.0, 3611.0) == 0.0  # 28 ppm apart
