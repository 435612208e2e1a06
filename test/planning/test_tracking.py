"""Tracking of a planned path, for a needle that is pulled aside near the axes of the coils."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.tracking import (
    ALWAYS_OFF,
    AXIS_LOOKAHEAD,
    CROSSING_GAIN,
    DRIFT_PER_ANGLE,
    MAX_ALONG_RATIO,
    MAX_AXIS_ANGLE,
    MIN_SPEED_SHARE,
    MIN_TACK_TIME,
    TACK_SHARE,
    TURN_GAIN,
    PathTracker,
)
from magnetosuture_thread.safety.kinematics import NeedleKinematics

NEEDLE = NeedleKinematics(0.0025)
COIL_ANGLES = (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)
LEEWAY = 6e-4
RATE = 20.0


def path(angles: np.ndarray, step: float = 1e-4) -> BodyPath:
    """Return a path that is driven ahead, with the same way between two poses."""
    middles = np.cumsum(step * np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)
    leeway = np.full(len(angles), LEEWAY)
    made = BodyPath(middles, angles, 0.5 * NEEDLE.chord, leeway, np.zeros(0))
    return BodyPath(middles, angles, 0.5 * NEEDLE.chord, leeway, np.array([made.length]))


def headings(
    tracker: PathTracker, drift: float | Callable[[float], float], slowdown: float = 1.0, seconds: float = 60.0
) -> np.ndarray:
    """Return the headings of an ideal needle on a path, whose drift, also by heading, the coils compensate [rad]."""
    middle, angle = tracker.path.at(0.0)
    found: list[float] = []
    for k in range(round(seconds * RATE)):
        measured = drift(angle) if callable(drift) else drift
        command = tracker.compute_command(k / RATE, middle, angle, 0.002, slowdown, measured)
        if command.done:
            return np.array(found)
        e = np.array([math.cos(angle), math.sin(angle)])
        along, across = (
            slowdown * command.velocity @ e,
            slowdown * (e[0] * command.velocity[1] - e[1] * command.velocity[0]),
        )
        middle, angle = middle + along * e / RATE, angle + across / tracker.path.lever / RATE
        found.append(angle)
    raise AssertionError("the end of the path is not reached")


@pytest.mark.parametrize("drift", [0.0, 6e-4, -1.2e-3])
@pytest.mark.parametrize("axis", COIL_ANGLES)
def test_a_needle_that_is_pulled_aside_stays_off_the_axis_of_a_coil(axis: float, drift: float):
    off = headings(PathTracker(path(np.full(18, axis)), COIL_ANGLES), drift)[round(0.5 * RATE) :] - axis
    assert len(off) >= 6
    assert np.abs(off).min() >= 0.95 * abs(drift) / DRIFT_PER_ANGLE
    assert np.all(off > 0.0) or np.all(off < 0.0) or not drift


@pytest.mark.parametrize("axis", COIL_ANGLES)
def test_on_a_long_way_along_an_axis_it_tacks_and_stays_close_to_its_path(axis: float):
    tracker = PathTracker(path(np.full(400, axis)), COIL_ANGLES)
    off = headings(tracker, 1.8e-3)[round(0.5 * RATE) :] - axis
    assert np.count_nonzero(np.diff(np.sign(off))) >= 3, "it changes sides"
    assert np.mean(np.abs(off) < 0.5 * MAX_AXIS_ANGLE) < 0.15, "and does so quickly"
    # The error across the path is the sum of its ways to the side.
    error = np.abs(np.cumsum(0.002 / RATE * np.sin(off)))
    assert np.ptp(error) < 2.5 * TACK_SHARE * LEEWAY


def test_it_stays_off_the_axis_also_where_less_of_the_pull_is_measured_close_to_it():
    bend = path(np.concatenate([np.full(20, 0.3), np.linspace(0.3, 0.02, 12), np.full(4, 0.02)]))
    found = headings(PathTracker(bend, COIL_ANGLES), lambda angle: 1.2e-3 if angle > 0.11 else 3e-4)
    assert found.min() >= 0.7 * 1.2e-3 / DRIFT_PER_ANGLE


def test_it_crosses_the_axis_on_a_bend_at_once():
    bend = np.linspace(math.radians(40.0), math.radians(-40.0), 150)
    without, off = (headings(PathTracker(path(bend), angles), 2e-3) for angles in ((), COIL_ANGLES))
    near = [np.count_nonzero(np.abs(found) < 0.5 * MAX_AXIS_ANGLE) / RATE for found in (without, off)]
    assert near[1] < 0.4 * near[0]
    assert np.count_nonzero(np.diff(np.sign(off))) == 1


def test_a_needle_that_is_thrown_aside_in_a_crossing_stays_on_its_side_of_the_axis():
    """It is off its path by more than the leeway then, for which it would tack."""
    tracker = PathTracker(path(np.linspace(math.radians(30.0), math.radians(-12.0), 80)), COIL_ANGLES)
    middle, angle = tracker.path.at(0.0)
    after: list[float] = []
    for k in range(200):
        command = tracker.compute_command(k / RATE, middle, angle, 0.002, 1.0, 2e-3)
        e = np.array([math.cos(angle), math.sin(angle)])
        across = float(e[0] * command.velocity[1] - e[1] * command.velocity[0])
        before, angle = angle, angle + across / tracker.path.lever / RATE
        middle = middle + command.velocity @ e * e / RATE
        if not after and before > 0.0 >= angle:
            middle = middle - 8e-4 * np.array([-e[1], e[0]])
        if after or before > 0.0 >= angle:
            after.append(angle)
        if len(after) >= 0.8 * MIN_TACK_TIME * RATE:
            break
    assert len(after) >= 0.8 * MIN_TACK_TIME * RATE
    assert max(after[2:]) < -0.5 * MAX_AXIS_ANGLE


def commands_beside_an_axis(stamps: tuple[float, ...], side: float) -> list[np.ndarray]:
    """Return commands, in the needle's frame, for a path just beyond an axis, of a needle that lay on a side of it."""
    tracker = PathTracker(path(np.full(100, -0.04)), COIL_ANGLES)
    tracker._side = side
    middle, angle = tracker.path.at(0.0)[0], 0.03
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return [turn @ tracker.compute_command(stamp, middle, angle, 0.002, 1.0, 1e-3).velocity for stamp in stamps]


def test_in_a_crossing_the_needle_is_turned_faster():
    crossing, beyond = (commands_beside_an_axis((1.0, 1.05), side)[1][1] for side in (1.0, -1.0))
    assert crossing == pytest.approx(CROSSING_GAIN / TURN_GAIN * beyond, rel=1e-3)
    assert beyond < 0.0


def test_after_time_was_set_back_nothing_is_left_of_a_crossing():
    crossing, beyond = (commands_beside_an_axis((9.0, 1.0, 1.05), side) for side in (1.0, -1.0))
    assert crossing[0][1] < 1.5 * beyond[0][1] < 0.0
    np.testing.assert_allclose(crossing[2], beyond[2], rtol=1e-6)


def test_headings_beside_the_axes_are_as_planned_however_the_needle_is_pulled():
    tracked = [headings(PathTracker(path(np.full(80, 0.6)), COIL_ANGLES), drift) for drift in (0.0, 3e-3)]
    assert tracked[0].tolist() == tracked[1].tolist()


def test_no_heading_off_an_axis_takes_more_than_half_of_the_leeway():
    narrow = path(np.full(80, 0.0))
    narrow = BodyPath(narrow.middles, narrow.angles, narrow.lever, np.full(80, 1e-4), narrow.ends)
    assert np.abs(headings(PathTracker(narrow, COIL_ANGLES), 3e-3)).max() <= 0.5 * 1e-4 / narrow.lever + 1e-9


@pytest.mark.parametrize("slowdown", [1.0, 0.5, 0.35])
def test_friction_that_slows_the_needle_does_not_slow_its_turns_to_the_path(slowdown: float):
    tracker = PathTracker(path(np.zeros(80)))
    middle, angle = tracker.path.at(0.0)
    command = tracker.compute_command(0.0, middle, angle + 0.1, 0.002, slowdown)
    turning = command.velocity @ np.array([-math.sin(angle + 0.1), math.cos(angle + 0.1)])
    assert slowdown * turning == pytest.approx(-6.0 * 0.1 * tracker.path.lever, rel=0.02)


@pytest.mark.parametrize("drift", [2.4e-3, -3.6e-3, 0.02])
def test_a_needle_is_slower_before_an_axis_where_coils_cannot_hold_it_against_the_pull(drift: float):
    """From the lookahead on, the pull that friction makes of the thread's drag has to fall."""
    before, step = 60, 1e-4
    bend = np.concatenate([np.full(before, 0.6), np.linspace(0.6, 0.0, 10), np.full(60, 0.0)])
    tracker = PathTracker(path(bend, step), COIL_ANGLES)
    middle, angle = tracker.path.at(0.0)
    speeds: dict[float, float] = {}
    for k in range(2000):
        travel = tracker.travel
        if tracker.compute_command(k / RATE, middle, angle, 0.002, 1.0, drift).done:
            break
        speeds[travel] = RATE * (tracker.travel - travel)
        middle, angle = tracker.path.at(tracker.travel)
        angle += max(0.0, MAX_AXIS_ANGLE - angle)  # kept off the axis, as commanded
    far = [speed for travel, speed in speeds.items() if 1e-3 < travel < before * step - 1.5 * AXIS_LOOKAHEAD]
    near = [speed for travel, speed in speeds.items() if before * step < travel < before * step + 2e-3]
    expected = max(MIN_SPEED_SHARE, min(1.0, DRIFT_PER_ANGLE * MAX_AXIS_ANGLE / abs(drift)))
    assert near == pytest.approx([expected * 0.002] * len(near), rel=1e-6)
    assert near
    assert min(far) == pytest.approx(min(1.0, max(MIN_SPEED_SHARE, DRIFT_PER_ANGLE * 0.6 / abs(drift))) * 0.002)


def test_a_pull_that_coils_hold_at_an_axis_slows_nothing():
    axis = path(np.full(80, 0.0))
    drift = 0.99 * DRIFT_PER_ANGLE * ALWAYS_OFF
    counts = [len(headings(PathTracker(axis, COIL_ANGLES), each)) for each in (0.0, drift)]
    assert counts[0] == counts[1]


def test_a_needle_that_is_kept_off_an_axis_does_not_turn_with_the_path():
    bend = path(np.concatenate([np.full(20, 0.6), np.linspace(0.6, 0.02, 12), np.full(8, 0.02)]))
    drift = 0.9 * DRIFT_PER_ANGLE * MAX_AXIS_ANGLE
    found = headings(PathTracker(bend, COIL_ANGLES), drift)
    assert found.min() >= 0.95 * drift / DRIFT_PER_ANGLE


def test_a_needle_that_lags_is_not_driven_faster_than_half_beyond_the_allowed_speed():
    straight = path(np.full(80, 0.6))
    tracker = PathTracker(straight)
    middle, angle = straight.at(0.0)
    e = np.array([math.cos(angle), math.sin(angle)])
    velocities = [tracker.compute_command(k / RATE, middle, angle, 0.002).velocity @ e for k in range(40)]
    assert max(velocities) <= (1.0 + MAX_ALONG_RATIO) * 0.002 * (1.0 + 1e-9)
    assert max(velocities) > 0.002


def offset_before_crossing(drift: float, bend: float) -> float:
    """Return how far left of its path an ideal needle is at half a millimetre before the middle of a bend [m]."""
    tracker = PathTracker(path(np.linspace(-bend, bend, 80)), COIL_ANGLES)
    middle, angle = tracker.path.at(0.0)
    for k in range(round(20.0 * RATE)):
        wanted, direction = tracker.path.at(tracker.travel)
        if tracker.travel > 0.5 * tracker.path.length - 5e-4:
            off = middle - wanted
            return float(math.cos(direction) * off[1] - math.sin(direction) * off[0])
        command = tracker.compute_command(k / RATE, middle, angle, 0.002, drift=drift)
        e = np.array([math.cos(angle), math.sin(angle)])
        along, across = command.velocity @ e, e[0] * command.velocity[1] - e[1] * command.velocity[0]
        middle, angle = middle + along * e / RATE, angle + across / tracker.path.lever / RATE
    raise AssertionError("the middle of the path is not reached")


def test_before_a_crossing_the_needle_is_kept_to_the_side_that_it_is_thrown_from():
    """In the crossing nothing compensates the pull: it goes from one side of its path to the other, not off it."""
    plain = offset_before_crossing(0.0, 0.6)
    left, right = offset_before_crossing(-2.5e-3, 0.6), offset_before_crossing(2.5e-3, 0.6)
    assert left > plain + 5e-5
    assert right < plain - 5e-5
    # The lead is 0.4 of it; were it integrated besides, the needle would be off by 0.64.
    assert max(abs(left), abs(right)) < 0.5 * LEEWAY
    assert abs(plain) < 1e-5, "what is not pulled is on its path"


def test_a_needle_that_is_held_where_it_is_is_commanded_all_the_same():
    """At a zero command the coils are off, and compensate nothing."""
    tracker = PathTracker(path(np.zeros(80)))
    middle, angle = tracker.path.at(0.0)
    for k in range(3):
        command = tracker.compute_command(k / RATE, middle, angle, 0.002, hold=True)
        assert 0.0 < math.hypot(*command.velocity) < 1e-5
        assert not command.done
