"""The figures of the operator's page."""

from __future__ import annotations

import pytest

from benchmarks.page import key_delays, page_table


def test_each_key_is_answered_by_the_first_velocity_after_it():
    keys = [1.0, 2.0, 3.0, 5.0]
    moving = [1.010, 1.030, 1.050, 2.020, 2.040, 4.5, 5.9]  # nothing came of the third but late
    found = key_delays("the bridge", keys, moving)
    assert (found["count"], found["lost"]) == (3, 1)
    assert (found["median"], found["greatest"]) == pytest.approx((0.02, 0.9))
    assert page_table([found]).row_count == 1
