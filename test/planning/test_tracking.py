"""Tracking of a planned path, for a needle that is pulled aside near the axes of the coils."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import cycle, islice

import numpy as np
import pytest

from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.tracking import MAX_AXIS_ANGLE, PathTracker, RestDetector

NEEDLE = NeedleKinematics(0.0025)
COIL_ANGLES = (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)
HELD = 0.015  # m/s; across the needle, for each radian off an axis
AXES = tuple((axis, HELD) for axis in COIL_ANGLES[:2])
LEEWAY = 6e-4
RATE = 20.0


def path(angles: np.ndarray) -> BodyPath:
    """Return a path that is driven ahead, with the same way between two poses."""
    middles = np.cumsum(1e-4 * np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)
    leeway = np.full(len(angles), LEEWAY)
    made = BodyPath(middles, angles, 0.5 * NEEDLE.chord, leeway, np.zeros(0))
    return BodyPath(middles, angles, 0.5 * NEEDLE.chord, leeway, np.array([made.length]))


def poses(
    tracker: PathTracker, pull: float, age: float = 0.0, intervals: Sequence[float] = (1.0 / RATE,)
) -> np.ndarray:
    """Return middle and heading of an ideal needle on a path, whose pull to the left of the path the coils compensate.

    A command comes into force when the pose that it answers has an age [s]. Poses come at intervals, in turns [s].
    """
    middle, angle = tracker.path.at(0.0)
    found: list[tuple[float, float, float]] = []
    now, twist, sent = 0.0, np.zeros(3), deque[tuple[float, np.ndarray]]()
    left = pull * np.array([-math.sin(angle), math.cos(angle)])
    for interval in islice(cycle(intervals), round(60.0 / min(intervals))):
        command = tracker.compute_command(now, middle, angle, 0.002, 1.0, left, age)
        if command.done:
            return np.array(found)
        sent.append((now + age, command.twist))
        end = now + interval
        while now < end:
            if sent and sent[0][0] <= now:
                twist = sent.popleft()[1]
            until = min(end, sent[0][0]) if sent else end
            e = np.array([math.cos(angle), math.sin(angle)])
            middle = middle + (until - now) * (twist[0] * e + twist[1] * np.array([-e[1], e[0]]))
            angle, now = angle + (until - now) * twist[2], until
        found.append((float(middle[0]), float(middle[1]), angle))
    raise AssertionError("the end of the path is not reached")


@pytest.mark.parametrize("pull", [0.0, 6e-4, -1.2e-3])
@pytest.mark.parametrize("axis", COIL_ANGLES)
def test_a_needle_that_is_pulled_aside_stays_off_the_axis_of_a_coil(axis: float, pull: float):
    off = poses(PathTracker(path(np.full(18, axis)), AXES), pull)[round(0.5 * RATE) :, 2] - axis
    assert len(off) >= 6
    assert np.abs(off).min() >= 0.9 * abs(pull) / HELD
    assert np.all(off > 0.0) or np.all(off < 0.0) or not pull


@pytest.mark.parametrize("age", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("pull", [1.2e-3, -1.2e-3])
def test_a_needle_that_is_kept_off_an_axis_stays_on_its_path_however_late_its_poses_are(age: float, pull: float):
    """Driven along itself it would leave the path until the place, corrected the less the later, brought it back."""
    x, y, off = poses(PathTracker(path(np.zeros(80)), AXES), pull, age).T[:, round(1.5 * RATE) :]
    assert np.abs(off).min() > 0.9 * abs(pull) / HELD
    assert len(x) > 20
    assert np.abs(y).max() < 3e-5


@pytest.mark.parametrize("drive", [1.0, -1.0])
def test_a_needle_whose_pull_nobody_measures_is_driven_along_itself(drive: float):
    """Nothing moves it across then: that would be taken for a turn, the wrong way round where it is driven back."""
    forth = path(np.zeros(60))
    back = BodyPath(forth.middles[::-1].copy(), forth.angles, forth.lever, forth.leeway, forth.ends)
    across = []
    for pull in (0.0, 1e-3):
        tracker = PathTracker(forth if drive > 0.0 else back)
        for frame in range(20):
            middle, angle = tracker.path.at(tracker.travel)
            command = tracker.compute_command(frame / RATE, middle, angle + 0.1, 0.002, 1.0, np.array([pull, 0.0]))
        assert command.twist[0] * drive > 1e-3
        across.append(command.twist[1])
    assert abs(across[0]) < 1e-4
    assert across[1] * drive < -1.5e-4


@pytest.mark.parametrize("age", [0.0, 0.02, 0.045, 0.07, 0.12, 0.2])
@pytest.mark.parametrize("rate", [10.0, 20.0, 30.0, 60.0])
def test_an_axis_is_crossed_at_once_and_no_farther_than_the_needle_stays_off_it(age: float, rate: float):
    tracker = PathTracker(path(np.linspace(0.4, -0.4, 80)), AXES)
    off = poses(tracker, 3e-3, age, (1.0 / rate,))[:, 2]
    before, after = np.flatnonzero(off > 0.9 * MAX_AXIS_ANGLE)[-1], np.flatnonzero(off < -0.9 * MAX_AXIS_ANGLE)[0]
    assert after - before <= max(2.0, 0.16 * rate)
    assert off[after:].min() > -0.45
    assert np.count_nonzero(np.diff(np.sign(off))) == 1


@pytest.mark.parametrize("age", [0.0, 0.05, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("aside", [3e-4, -3e-4])
def test_a_needle_beside_its_path_is_taken_back_by_force_at_any_lateness(aside: float, age: float):
    """It is moved across itself and turns little; it swings over by less than a tenth."""
    tracker = PathTracker(path(np.full(60, 0.3)), AXES)
    e = np.array([math.cos(0.3), math.sin(0.3)])
    n = np.array([-e[1], e[0]])
    start, _ = tracker.path.at(0.0)
    middle, angle, now, sent = start + aside * n, 0.3, 0.0, deque([np.zeros(3)] * round(age * 200.0))
    left, turned, twist = [], [], np.zeros(3)
    for step in range(1200):
        if step % 10 == 0:
            twist = tracker.compute_command(now, middle, angle, 0.002, 1.0, np.zeros(2), age).twist
        sent.append(twist)
        acting = sent.popleft()
        middle = middle + (acting[0] * e + acting[1] * n) / 200.0
        angle, now = angle + acting[2] / 200.0, now + 1.0 / 200.0
        left.append(math.copysign(1.0, aside) * float((middle - start) @ n))
        turned.append(abs(angle - 0.3))
    assert min(left) > -0.1 * abs(aside)
    assert left[round(200 * (0.2 + 5.0 * math.e * (age + 0.05)))] < 0.1 * abs(aside)
    assert max(turned) < 0.12


@pytest.mark.parametrize(("gap", "goes_on"), [(0.25, True), (0.5, False)])
def test_the_setpoint_goes_on_while_frames_are_lost_for_as_long_as_a_command_lasts(gap: float, goes_on: bool):
    """One that has stood still would call back a needle that has gone on."""
    tracker = PathTracker(path(np.full(60, 0.3)))
    for frame in range(20):
        setpoint, angle = tracker.path.at(tracker.travel)
        tracker.compute_command(frame / RATE, setpoint, angle, 0.002)
    setpoint, angle = tracker.path.at(tracker.travel)
    before = tracker.travel
    carried = setpoint + 0.002 * gap * np.array([math.cos(angle), math.sin(angle)])
    command = tracker.compute_command(19 / RATE + gap, carried, angle, 0.002)
    assert (tracker.travel - before > 0.9 * 0.002 * gap) is goes_on
    assert (float(command.twist[0]) > 0.0) is goes_on


def test_no_heading_off_an_axis_takes_more_than_half_of_the_leeway():
    narrow = path(np.full(80, 0.0))
    narrow = BodyPath(narrow.middles, narrow.angles, narrow.lever, np.full(80, 1e-4), narrow.ends)
    assert np.abs(poses(PathTracker(narrow, AXES), 3e-3)[:, 2]).max() <= 0.5 * 1e-4 / narrow.lever + 1e-9


def test_before_a_crossing_the_needle_is_on_the_side_that_the_turn_takes_it_from():
    """A taut thread holds the tail, so that a turn displaces the middle by more of it than that of a slack one."""

    def aside(pull: np.ndarray) -> float:
        tracker, velocities = PathTracker(path(np.linspace(0.12, -0.4, 60)), AXES), []
        for frame in range(30):
            place, angle = tracker.path.at(tracker.travel)
            velocities.append(float(tracker.compute_command(frame / RATE, place, angle, 0.002, 1.0, pull).twist[1]))
        return max(velocities)

    slack, taut = aside(np.array([1.2e-2, 0.0])), aside(np.array([-1.2e-2, 0.0]))
    assert 0.0 < slack < 0.5 * taut, "to the left, as the turn to the right takes the middle to the right"
    assert taut <= 8.0 * 0.4 * LEEWAY + 1e-9


@pytest.mark.parametrize(("pull", "kept"), [(5e-3, 0.2), (2e-2, 0.35)])
def test_a_needle_is_kept_as_far_off_an_axis_as_the_pull_across_it_needs(pull: float, kept: float):
    """The coils hold 25 mm/s a radian off the axis; a pull along it needs less."""
    for angle in (0.0, 0.7):
        c, s = math.cos(angle), math.sin(angle)
        assert PathTracker._kept(angle, 0.025, pull * np.array([-s, c])) == pytest.approx(kept)
        assert PathTracker._kept(angle, 0.025, pull * np.array([c, s])) == pytest.approx(0.15)


@pytest.mark.parametrize("slowdown", [1.0, 0.5, 0.35])
def test_friction_that_slows_the_needle_does_not_slow_its_turns_to_the_path(slowdown: float):
    tracker = PathTracker(path(np.zeros(80)))
    middle, angle = tracker.path.at(0.0)
    command = tracker.compute_command(0.0, middle, angle + 0.1, 0.002, slowdown)
    assert slowdown * command.twist[2] == pytest.approx(-6.0 * 0.1, rel=0.02)


def test_a_needle_that_moves_on_its_next_path_is_not_called_stalled_by_the_way_on_the_one_before():
    detector, stalls = RestDetector(), []
    for frame in range(200):
        x = 1e-4 * frame  # the needle, at 2 mm/s; the next path begins after 2 s, 50 mm into the one before
        travel = 0.05 + x if frame < 40 else x - 40e-4
        stalls.append(detector.update(1.0 + frame / RATE, np.array([x, 0.0]), 0.0, 1.25e-3, True, travel))
    assert not any(stalls)
    for frame in range(200, 290):  # and then its setpoint waits for a needle that trembles in one place
        at = np.array([x + 6e-5 * (frame % 2), 0.0])
        stalls.append(detector.update(1.0 + frame / RATE, at, 0.0, 1.25e-3, True, travel))
    assert stalls[-1]


def test_what_currents_are_late_by_counts_as_the_age_of_poses():
    """As a bridge that aims a needle which turns: the gain falls, and turns on the way are counted."""
    late, aged = (PathTracker(path(np.linspace(0.3, 1.2, 80)), AXES, delay) for delay in (0.06, 0.0))
    for k in range(20):
        middle, angle = late.path.at(2e-4 * k)
        pose = (
            0.05 * k,
            np.array([middle[0] + 1e-4, middle[1] - 1e-4]),
            angle - 0.05,
            0.002,
            1.0,
            np.array([1e-3, 2e-3]),
        )
        assert late.compute_command(*pose, 0.02).twist == pytest.approx(aged.compute_command(*pose, 0.08).twist)
