"""Dead man's switch and delay of jog messages."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.console.jog_controller import ZERO_VELOCITY, DeadManSwitch, DelayEstimator

EAST = (0.003, 0.0)


REST = ZERO_VELOCITY
JOG = ("press", EAST, 0.0, EAST)
SEQUENCES: dict[str, list[tuple[Any, ...]]] = {  # call, its arguments, and what is sent then
    "a jog is sent at once and repeated while fresh": [JOG, *(("due", now, EAST) for now in (0.02, 0.1, 0.149))],
    "a timeout sends one zero": [JOG, ("due", 0.15, REST), ("due", 0.17, None), ("due", 5.0, None)],
    "a release sends one zero": [JOG, ("release", REST), ("release", None), ("due", 0.01, None)],
    "a stop requires a release": [
        *(JOG, ("stop", REST), ("press", EAST, 0.01, None), ("due", 0.02, None)),
        *(("release", None), ("press", EAST, 0.03, EAST)),
    ],
    # The network held the words up, and the key is still down as they come again.
    "a stop after a timeout requires a release": [
        *(JOG, ("due", 0.2, REST), ("stop", None), ("press", EAST, 0.3, None)),
        *(("release", None), ("press", EAST, 0.4, EAST)),
    ],
    "an interruption ends the motion and clears no stop": [
        *(JOG, ("interrupt", REST), ("press", EAST, 0.01, EAST)),
        *(("stop", REST), ("interrupt", None), ("press", EAST, 0.02, None)),
    ],
}


@pytest.mark.parametrize("sequence", SEQUENCES.values(), ids=SEQUENCES)
def test_what_is_sent(sequence: list[tuple[Any, ...]]):
    switch = DeadManSwitch(0.15)
    for call, *arguments, expected in sequence:
        assert getattr(switch, call)(*arguments) == expected


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
