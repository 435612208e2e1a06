"""Rules of the RoboClaw driver; more in the doctests."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.drivers.roboclaw import board as protocol


@pytest.mark.parametrize(
    ("current", "resistance", "voltage", "duty", "short"),
    [
        (0.0, 1.0, 24.0, 0, False),
        (24.0, 1.0, 24.0, 32767, False),
        (-24.1, 1.0, 24.0, -32767, True),
        (2.0, 3.0, 12.0, 16383, False),
    ],
)
def test_a_duty_is_the_share_of_the_supply(current: float, resistance: float, voltage: float, duty: int, short: bool):
    assert protocol.duties_for(np.array([current]), np.array([resistance]), voltage) == ((duty,), short)


@pytest.mark.parametrize(
    ("due", "measured", "expected"),
    [
        (4.0, 0.0, True),
        (-4.0, 1.99, True),
        (4.0, -1.99, True),
        (4.0, 2.01, False),
        (0.51, 0.0, True),
        (0.49, 0.0, False),
    ],
)
def test_a_current_falls_short_below_half_of_what_is_due(due: float, measured: float, expected: bool):
    assert protocol.is_short(due, measured) is expected


@pytest.mark.parametrize(
    ("written", "has", "current", "expected"),
    [
        (1000, 1000, 0.0, True),
        (1000, 1100, 0.0, True),  # rounded
        (1000, 1200, 0.0, False),
        (1000, 0, 0.0, False),
        (1000, -1000, 0.0, False),
        (0, 1, 0.0, False),  # zero is zero
        (20000, 9000, 9.0, True),  # taken back at the limit
        (-20000, -9000, -9.0, True),
        (20000, 9000, 7.0, False),
        (20000, 21000, 9.0, False),
        (20000, -9000, 9.0, False),
        (0, 9000, 9.0, False),
    ],
)
def test_a_board_must_have_what_was_written(written: int, has: int, current: float, expected: bool):
    assert protocol.duties_match((written, 0), (has, 0), (current, 0.0), 10.0) is expected
    assert protocol.duties_match((0, written), (0, has), (0.0, current), 10.0) is expected
