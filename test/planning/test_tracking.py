"""Tracking of a planned path, for a needle that is pulled aside near the axes of the coils."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.tracking import DRIFT_PER_ANGLE, MAX_AXIS_ANGLE, PathTracker
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


def headings(tracker: PathTracker, drift: float, slowdown: float = 1.0, seconds: float = 60.0) -> np.ndarray:
    """Return the headings of an ideal needle on a path, whose drift the coils compensate [rad]."""
    middle, angle = tracker.path.at(0.0)
    found: list[float] = []
    for k in range(round(seconds * RATE)):
        command = tracker.compute_command(k / RATE, middle, angle, 0.002, slowdown, drift)
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


@pytest.mark.parametrize("drift", [0.0, 6e-4, -1.2e-3, 1.8e-3])
@pytest.mark.parametrize("axis", COIL_ANGLES)
def test_a_needle_that_is_pulled_aside_stays_off_the_axis_of_a_coil(axis: float, drift: float):
    off = headings(PathTracker(path(np.full(80, axis)), COIL_ANGLES), drift)[round(0.5 * RATE) :] - axis
    assert np.abs(off).min() >= 0.95 * abs(drift) / DRIFT_PER_ANGLE
    assert np.all(off > 0.0) or np.all(off < 0.0) or not drift


def test_it_crosses_the_axis_on_a_bend_at_once():
    bend = np.linspace(math.radians(40.0), math.radians(-40.0), 150)
    without, off = (headings(PathTracker(path(bend), angles), 2e-3) for angles in ((), COIL_ANGLES))
    near = [np.count_nonzero(np.abs(found) < 0.5 * MAX_AXIS_ANGLE) / RATE for found in (without, off)]
    assert near[1] < 0.4 * near[0]
    assert np.count_nonzero(np.diff(np.sign(off))) == 1


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
