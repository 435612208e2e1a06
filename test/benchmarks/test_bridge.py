"""The bridge with simulated boards, and all that fails around it, as processes. Nothing here is timed closely."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.bridge.command import DriveWatch, bridge_table, measure_bridge, zero_delays
from magnetosuture_thread.rig.power import PowerStage


@pytest.mark.slow
@pytest.mark.whole_graph
def test_whatever_falls_silent_or_is_killed_the_boards_go_to_zero_and_work_again():
    figures = measure_bridge(trials=2, kills=1, hostile=3000, busy=False, log=lambda text: None)
    assert [each["count"] > 0 for each in figures["delays"]] == [True] * 4
    assert max(each["greatest"] for each in figures["delays"]) < 5.0
    assert 0.0 < figures["greatest_current"] <= figures["max_current"]
    assert bridge_table(figures).row_count == 6


def test_delays_beyond_their_bound_are_counted():
    delays = zero_delays("a kill", [0.1, 0.2, 0.3], 0.25)
    assert (delays["count"], delays["beyond"]) == (3, 1)
    assert delays["greatest"] == pytest.approx(0.3)


def test_a_delay_counts_from_a_time_that_finds_any_board_driven(tmp_path: Path):
    stage = PowerStage([str(tmp_path / "a"), str(tmp_path / "b")], 24.0, 1.0, 0.005)
    first, second = stage.boards
    watch = DriveWatch(stage)
    first.timeline.extend([(1.0, (5, 0)), (2.0, (0, 0))])
    second.timeline.extend([(1.5, (0, -9)), (2.5, (0, 0))])
    watch.look()
    assert watch.turns == [(1.0, True), (2.5, False)]
    first.timeline.append((3.0, (7, 7)))
    watch.look()
    assert watch.driven
    assert watch.to_zero([0.5, 1.5, 2.75, 3.5]) == [1.0]
