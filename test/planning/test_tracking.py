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
from magnetosuture_thread.planning.tracking import MAX_AXIS_ANGLE, TACK_SHARE, PathTracker

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


def headings(
    tracker: PathTracker,
    drift: float,
    age: float = 0.0,
    intervals: Sequence[float] = (1.0 / RATE,),
) -> np.ndarray:
    """Return the headings of an ideal needle on a path, whose drift the coils compensate [rad].

    A command comes into force when the pose that it answers has an age [s]. Poses come at intervals, in turns [s].
    """
    middle, angle = tracker.path.at(0.0)
    found: list[float] = []
    now, velocity, sent = 0.0, np.zeros(2), deque[tuple[float, np.ndarray]]()
    for interval in islice(cycle(intervals), round(60.0 / min(intervals))):
        command = tracker.compute_command(now, middle, angle, 0.002, 1.0, drift, age)
        if command.done:
            return np.array(found)
        sent.append((now + age, command.velocity))
        end = now + interval
        while now < end:
            if sent and sent[0][0] <= now:
                velocity = sent.popleft()[1]
            until = min(end, sent[0][0]) if sent else end
            e = np.array([math.cos(angle), math.sin(angle)])
            along, across = velocity @ e, e[0] * velocity[1] - e[1] * velocity[0]
            middle, angle = middle + (until - now) * along * e, angle + (until - now) * across / tracker.path.lever
            now = until
        found.append(angle)
    raise AssertionError("the end of the path is not reached")


@pytest.mark.parametrize("drift", [0.0, 6e-4, -1.2e-3])
@pytest.mark.parametrize("axis", COIL_ANGLES)
def test_a_needle_that_is_pulled_aside_stays_off_the_axis_of_a_coil(axis: float, drift: float):
    off = headings(PathTracker(path(np.full(18, axis)), AXES), drift)[round(0.5 * RATE) :] - axis
    assert len(off) >= 6
    assert np.abs(off).min() >= 0.95 * abs(drift) / HELD
    assert np.all(off > 0.0) or np.all(off < 0.0) or not drift


@pytest.mark.parametrize("axis", COIL_ANGLES)
def test_on_a_long_way_along_an_axis_it_tacks_and_stays_close_to_its_path(axis: float):
    tracker = PathTracker(path(np.full(400, axis)), AXES)
    off = headings(tracker, 1.8e-3)[round(0.5 * RATE) :] - axis
    assert np.count_nonzero(np.diff(np.sign(off))) >= 3, "it changes sides"
    assert np.mean(np.abs(off) < 0.5 * MAX_AXIS_ANGLE) < 0.15, "and does so quickly"
    # The error across the path is the sum of its ways to the side.
    error = np.abs(np.cumsum(0.002 / RATE * np.sin(off)))
    assert np.ptp(error) < 2.5 * TACK_SHARE * LEEWAY


@pytest.mark.parametrize("age", [0.0, 0.02, 0.045, 0.07, 0.12, 0.2])
@pytest.mark.parametrize("rate", [10.0, 20.0, 30.0, 60.0])
def test_an_axis_is_crossed_at_once_and_no_farther_than_the_needle_stays_off_it(age: float, rate: float):
    tracker = PathTracker(path(np.linspace(0.4, -0.4, 80)), AXES)
    off = headings(tracker, 3e-3, age=age, intervals=(1.0 / rate,))
    before, after = np.flatnonzero(off > 0.95 * MAX_AXIS_ANGLE)[-1], np.flatnonzero(off < -0.9 * MAX_AXIS_ANGLE)[0]
    assert after - before <= max(2.0, 0.16 * rate)
    assert off[after:].min() > -0.45
    assert np.count_nonzero(np.diff(np.sign(off))) == 1


def test_a_pull_slows_the_needle_only_where_its_path_is_narrow():
    """The coils compensate a third of it, and the rest takes the needle 1.5 mm aside before it is steered back."""
    made = path(np.full(60, 0.0))
    wide = BodyPath(made.middles, made.angles, made.lever, np.full(60, 5e-3), made.ends)
    times = [len(headings(PathTracker(each, AXES), 6e-3)) for each in (made, wide)]
    assert times[0] >= 1.5 * times[1]
    assert times[1] <= 1.3 * len(headings(PathTracker(wide), 6e-3))


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
    assert (float(command.velocity @ (carried - setpoint)) > 0.0) is goes_on


def test_no_heading_off_an_axis_takes_more_than_half_of_the_leeway():
    narrow = path(np.full(80, 0.0))
    narrow = BodyPath(narrow.middles, narrow.angles, narrow.lever, np.full(80, 1e-4), narrow.ends)
    assert np.abs(headings(PathTracker(narrow, AXES), 3e-3)).max() <= 0.5 * 1e-4 / narrow.lever + 1e-9


@pytest.mark.parametrize("slowdown", [1.0, 0.5, 0.35])
def test_friction_that_slows_the_needle_does_not_slow_its_turns_to_the_path(slowdown: float):
    tracker = PathTracker(path(np.zeros(80)))
    middle, angle = tracker.path.at(0.0)
    command = tracker.compute_command(0.0, middle, angle + 0.1, 0.002, slowdown)
    turning = command.velocity @ np.array([-math.sin(angle + 0.1), math.cos(angle + 0.1)])
    assert slowdown * turning == pytest.approx(-6.0 * 0.1 * tracker.path.lever, rel=0.02)
