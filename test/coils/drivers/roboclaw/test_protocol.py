"""Rules of the RoboClaw driver; more in the doctests."""

from __future__ import annotations

import pytest

from magnetosuture_thread.coils.drivers import roboclaw as protocol


@pytest.mark.parametrize(
    ("written", "has", "current", "expected"),
    [
        (1000, 1000, 0.0, True),
        (1000, 1100, 0.0, True),  # rounded
        (1000, 1200, 0.0, False),
        (1000, -1000, 0.0, False),
        (0, 1, 0.0, False),  # zero is zero
        (20000, 9000, 9.0, True),  # taken back at the limit
        (20000, 9000, 7.0, False),
        (20000, -9000, 9.0, False),
    ],
)
def test_a_board_must_have_what_was_written(written: int, has: int, current: float, expected: bool):
    assert protocol.duties_match((written, 0), (has, 0), (current, 0.0), 10.0) is expected
    assert protocol.duties_match((0, written), (0, has), (0.0, current), 10.0) is expected
