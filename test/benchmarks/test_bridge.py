"""The bridge with simulated boards, and all that fails around it, as processes. Nothing here is timed closely."""

from __future__ import annotations

import pytest

from benchmarks.bridge.command import ZeroDelays, bridge_table, measure_bridge

pytestmark = pytest.mark.slow


@pytest.mark.whole_graph
def test_whatever_falls_silent_or_is_killed_the_boards_go_to_zero_and_work_again():
    nothing = {"log": lambda text: None, "progress": lambda share: None}
    figures = measure_bridge(trials=2, kills=1, hostile=3000, busy=False, **nothing)
    assert [each["count"] > 0 for each in figures["delays"]] == [True] * 4
    assert max(each["greatest"] for each in figures["delays"]) < 5.0
    assert 0.0 < figures["greatest_current"] <= figures["max_current"]
    assert bridge_table(figures).row_count == 7


def test_delays_beyond_their_bound_are_counted():
    delays = ZeroDelays.of("a kill", [0.1, 0.2, 0.3], 0.25)
    assert (delays.count, delays.beyond) == (3, 1)
    assert delays.greatest == pytest.approx(0.3)
