"""The bridge with simulated boards, and all that fails around it, as processes. Nothing here is timed closely."""

from __future__ import annotations

import pytest

from benchmarks.bridge.measurements import measure_bridge
from benchmarks.bridge.report import BridgeReport, ZeroDelays, bridge_table


@pytest.mark.whole_graph
def test_whatever_falls_silent_or_is_killed_the_boards_go_to_zero_and_work_again():
    report = measure_bridge(trials=2, kills=1, hostile=3000, busy=False)
    assert [each.count > 0 for each in report.delays] == [True] * 4
    assert max(each.greatest for each in report.delays) < 5.0
    assert 0.0 < report.greatest_current <= report.max_current
    assert set(report.to_json()) >= {"delays", "loop", "scheduling"}


def test_the_table_says_what_is_beyond_its_bound():
    delays = ZeroDelays.of("a kill", [0.1, 0.2, 0.3], 0.25)
    assert (delays.count, delays.beyond) == (3, 1)
    assert delays.greatest == pytest.approx(0.3)
    report = BridgeReport((delays,), (0.01, 0.5, 7.0), "ordinary", 200.0, 10, 9.9, 10.0, 0)
    table = bridge_table(report)
    assert next(iter(table.columns[5].cells)) == "1/3"
    assert "0/0" in list(table.columns[5].cells)
