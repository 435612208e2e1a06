"""A needle that does not follow is a fault; one that is pulled, held or slack is none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.motion_observer import MAX_UNSEEN, FollowMonitor, MotionStep

INTERVAL, SPEED = 0.05, 2e-3  # s and m/s
EAST, STILL = np.array([SPEED * INTERVAL, 0.0]), np.zeros(2)
WEST = np.array([-1.0, 0.0])


def watch(monitor: FollowMonitor, moved: NDArray[np.float64], *, follows_turns: bool = False, count: int = 40) -> str:
    """Drive a needle along x, whose poses move by a vector in each interval; return the fault."""
    for k in range(count):
        turn = monitor.probe_rate * INTERVAL
        monitor.register_turn(turn)
        step = MotionStep(1.0 + k * INTERVAL, INTERVAL, EAST, turn, moved, turn if follows_turns else 0.0, STILL)
        if fault := monitor.update(step):
            return fault
    return ""


@pytest.mark.parametrize("share", [0.15, 0.5, 1.0, 2.0, 3.8])
def test_a_needle_that_a_taut_thread_slows_or_a_slack_one_lets_go_follows(share: float):
    assert watch(FollowMonitor(5e-4, slack_ratio=3.9), share * EAST) == ""


def test_poses_that_stand_still_and_do_not_turn_are_not_the_needles():
    fault = watch(FollowMonitor(5e-4), np.zeros(2))
    assert fault == "needle does not follow: 0.5 mm expected, 0 mm measured in 0.25 s"


def test_a_needle_that_a_thread_holds_turns_with_the_field_and_is_no_fault():
    monitor = FollowMonitor(5e-4)
    assert watch(monitor, np.zeros(2), follows_turns=True) == ""
    assert monitor.is_trusted(3.0)


@pytest.mark.parametrize("moved", [-EAST, np.array([0.0, SPEED * INTERVAL]), 15.0 * EAST])
def test_poses_that_move_elsewhere_are_not_the_needles(moved: NDArray[np.float64]):
    assert watch(FollowMonitor(5e-4, slack_ratio=3.9), moved, follows_turns=True).endswith("elsewhere")


@pytest.mark.parametrize(
    ("share", "turned", "is_fault"),
    [(1.0, 1.0, False), (0.5, 1.0, False), (2.5, 1.0, True), (-1.0, 1.0, True), (1.0, 0.0, True), (1.0, -1.0, True)],
)
def test_a_needle_may_turn_about_its_tail_and_not_move_farther(share: float, turned: float, is_fault: bool):
    """Half of its chord is 6 mm, and in 0.2 s its middle moves by 2.4 mm across what is expected."""
    monitor, turn, swing = FollowMonitor(5e-4), 0.1, np.array([0.0, 6e-4])
    steps = [
        MotionStep(0.05 * k, 0.05, EAST, turn, EAST + share * swing, turn * turned, turned * swing) for k in range(4)
    ]
    assert any(monitor.update(step).endswith("elsewhere") for step in steps) is is_fault


def test_a_heading_that_turns_farther_than_the_field_is_not_the_needles():
    monitor = FollowMonitor(5e-4)
    faults = [monitor.update(MotionStep(1.0 + 0.05 * k, 0.05, EAST, -0.1, EAST, 0.4, STILL)) for k in range(4)]
    assert "it turned 1.2 rad away from the field" in faults[-1]


@pytest.mark.parametrize(("interval", "judged"), [(0.05, True), (0.29, True), (0.31, False)])
def test_motion_is_judged_at_every_interval_at_which_a_pose_is_valid(interval: float, judged: bool):
    """In a longer one the coils were off, and a thread has moved the needle."""
    monitor = FollowMonitor(5e-4, max_interval=0.3)
    step = MotionStep(0.0, interval, interval / INTERVAL * EAST, 0.0, -interval / INTERVAL * EAST, 0.0, STILL)
    assert any(monitor.update(step._replace(stamp=interval * k)) for k in range(20)) == judged


@pytest.mark.parametrize("interval", [0.02, 0.22, 0.5])
def test_a_place_that_never_moves_is_not_the_needles_however_it_turns(interval: float):
    """It is driven at 4 mm/s against a pull of 1 mm/s that was known, and is latched within 1.5 mm."""
    monitor, driven, pull, count = (
        FollowMonitor(5e-4, max_interval=0.3),
        interval * np.array([4e-3, 0.0]),
        1e-3 * WEST,
        0,
    )
    step = MotionStep(0.0, interval, EAST, 0.3, EAST, 0.3, STILL, driven, pull)
    assert monitor.update(step) == ""
    step = step._replace(expected=np.zeros(2), measured=np.zeros(2))
    while not (fault := monitor.update(step._replace(stamp=count * interval))):
        count += 1
    assert "it is not seen to move" in fault
    assert 0.5 - interval <= count * interval <= 0.5 + interval


@pytest.mark.parametrize(
    ("at_shape", "turned", "is_fault"), [(False, 0.0, True), (False, 0.3, False), (True, 0.0, False)]
)
def test_a_heading_that_never_turns_with_the_field_is_not_the_needles(at_shape: bool, turned: float, is_fault: bool):
    """Its place moves as it should. A shape may hold it."""
    monitor = FollowMonitor(5e-4)
    step = MotionStep(0.0, INTERVAL, EAST, 0.1, EAST, 0.1 * turned, STILL, EAST)
    faults = [monitor.update(step._replace(stamp=INTERVAL * k), at_shape=at_shape) for k in range(8)]
    assert [fault for fault in faults if "not seen to turn" in fault] == faults[5:] * is_fault


@pytest.mark.parametrize(
    ("innovation", "at_shape", "is_fault"), [(9.1, False, True), (8.9, False, False), (20.0, True, False)]
)
def test_a_motion_that_changes_otherwise_than_a_pull_is_not_the_needles(
    innovation: float, at_shape: bool, is_fault: bool
):
    monitor = FollowMonitor(5e-4)
    step = MotionStep(0.0, INTERVAL, EAST, 0.0, EAST, 0.0, STILL, innovation=innovation)
    faults = [monitor.update(step._replace(stamp=INTERVAL * k), at_shape=at_shape) for k in range(4)]
    assert [bool(fault) for fault in faults] == [False, False, is_fault, is_fault]


def test_a_needle_that_is_armed_anew_may_have_stood_before():
    monitor, still, driven = FollowMonitor(5e-4), np.zeros(2), np.array([1.4e-3, 0.0])
    step = MotionStep(0.0, INTERVAL, still, 0.0, still, 0.0, STILL, driven)
    assert monitor.update(step) == ""
    monitor.clear()
    assert monitor.update(step._replace(stamp=INTERVAL)) == ""
    assert monitor.update(step._replace(stamp=2 * INTERVAL)) != ""


def test_a_motion_that_cannot_be_seen_is_not_judged():
    monitor = FollowMonitor(5e-4)
    step = MotionStep(0.0, 0.05, 0.05 * EAST, 0.0, STILL, 0.0, STILL)
    assert not any(monitor.update(step._replace(stamp=0.05 * k)) for k in range(200))


def test_a_needle_that_turns_about_itself_moves_in_no_wrong_direction():
    """The direction of the expected motion depends on when it turned."""
    monitor = FollowMonitor(5e-4)
    for k in range(20):
        expected, measured = (8e-4 * np.array([math.cos(a), math.sin(a)]) for a in (0.5 * k, 0.5 * k - 1.2))
        assert monitor.update(MotionStep(0.05 * k, 0.05, expected, 0.5, measured, 0.5, STILL)) == ""


def test_a_command_that_ends_ends_the_probe_without_a_fault():
    monitor, still = FollowMonitor(5e-4), MotionStep(0.0, INTERVAL, STILL, 0.0, STILL, 0.0, STILL)
    while not monitor.probe_rate:
        watch(monitor, np.zeros(2), count=1)
    monitor.end_probe()
    assert not any(monitor.update(still._replace(stamp=1.0 + INTERVAL * k)) for k in range(1, 40))


@pytest.mark.parametrize("at_shape", [False, True])
def test_what_a_needle_lies_at_moves_it_to_no_other_place(at_shape: bool):
    """In 0.15 s 1.5 mm are expected to the east, and measured to the west."""
    monitor, step = FollowMonitor(5e-4), MotionStep(0.0, INTERVAL, 5.0 * EAST, 0.0, -5.0 * EAST, 0.0, STILL)
    faults = [monitor.update(step._replace(stamp=INTERVAL * k), at_shape=at_shape) for k in range(3)]
    assert faults[-1].endswith("elsewhere")


def test_what_a_needle_lies_at_may_hold_it_for_a_while_and_not_for_good():
    monitor, step = FollowMonitor(5e-4), MotionStep(0.0, INTERVAL, EAST, 0.0, STILL, 0.0, STILL)
    faults = [monitor.update(step._replace(stamp=INTERVAL * k), at_shape=True) for k in range(40)]
    assert not any(faults[:15])
    assert "needle does not follow: 2 mm expected" in faults[-1]


def let_go(monitor: FollowMonitor, pull: NDArray[np.float64], *, moves: bool) -> list[float]:
    """Hold a turning needle in its place against a pull that was small when it last moved; return its speed by that.

    What lets it go moves it, if it is what is seen.
    """
    speeds, place = [], np.zeros(2)
    for k in range(40):
        unproven = monitor.unproven_pull(pull)
        moved = INTERVAL * unproven if moves else np.zeros(2)
        place = place + moved
        turn, driven = 0.05, INTERVAL * (unproven - pull)
        step = MotionStep(k * INTERVAL, INTERVAL, INTERVAL * unproven, turn, moved, turn, STILL, driven, pull)
        assert monitor.update(step) == ""
        speeds.append(math.hypot(*unproven))
    assert math.hypot(*place) < 4e-4
    return speeds


def test_a_needle_that_is_held_so_still_that_its_place_proves_nothing_is_let_go_until_it_is_seen():
    """One that is pulled moves then, and is seen to; poses that are not its own drive it no farther."""
    pull, small = np.array([1.5e-3, 0.0]), np.array([1e-4, 0.0])
    for known, moves in ((small, True), (small, False), (-small, False)):
        monitor = FollowMonitor(5e-4)
        monitor.update(MotionStep(-1.0, INTERVAL, EAST, 0.0, EAST, 0.0, STILL, EAST, known))
        speeds = let_go(monitor, pull, moves=moves)
        assert speeds.count(0.0) > (25 if moves else 5)
        assert max(speeds) > 1e-4
        if not moves:
            assert sum(1.5e-3 - speed for speed in speeds) * INTERVAL < MAX_UNSEEN


@pytest.mark.parametrize(("rate", "is_fault"), [(0.09, False), (-0.09, False), (0.3, True), (-0.3, True)])
def test_a_field_that_turns_no_faster_than_a_torque_holds_the_needle_is_no_turn(rate: float, is_fault: bool):
    """A field that is there beside that of the coils keeps a needle off its direction for good."""
    monitor, faults = FollowMonitor(5e-4), list[str]()
    for k in range(400):
        faults.append(monitor.update(MotionStep(k * INTERVAL, INTERVAL, EAST, rate * INTERVAL, EAST, 0.0, STILL, EAST)))
    assert any("not seen to turn" in fault for fault in faults) is is_fault
