"""When boards were driven, and how hard."""

from __future__ import annotations

from pathlib import Path

from benchmarks.bridge.drive_watch import DriveWatch
from magnetosuture_thread.rig.power import PowerStage


def test_coils_are_driven_while_any_board_is(tmp_path: Path):
    stage = PowerStage([str(tmp_path / "a"), str(tmp_path / "b")], 24.0, 1.0, 0.005)
    first, second = stage.boards
    watch = DriveWatch(stage)
    assert watch.turns == []
    first.timeline.extend([(1.0, (5, 0)), (2.0, (0, 0))])
    second.timeline.extend([(1.5, (0, -9)), (2.5, (0, 0))])
    watch.look()
    assert watch.turns == [(1.0, True), (2.5, False)]
    first.timeline.append((3.0, (7, 7)))
    watch.look()
    watch.look()
    assert watch.turns[2:] == [(3.0, True)]
    assert watch.driven
    assert watch.largest == 9
    watch.forget()
    first.timeline.append((4.0, (0, 3)))
    watch.look()
    assert watch.largest == 3


def test_a_delay_counts_from_a_time_that_finds_the_coils_driven(tmp_path: Path):
    stage = PowerStage([str(tmp_path / "a")], 24.0, 1.0, 0.005)
    stage.boards[0].timeline.extend(
        [(1.0, (1, 0)), (2.0, (0, 0)), (3.0, (1, 0)), (3.5, (2, 0)), (4.25, (0, 0)), (6.0, (1, 1))]
    )
    watch = DriveWatch(stage)
    watch.look()
    assert watch.to_zero([0.5, 1.5, 2.5, 3.25, 4.0, 5.0, 7.0]) == [0.5, 1.0, 0.25]
