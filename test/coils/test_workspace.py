"""Where the needle may be."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from magnetosuture_thread.coils.workspace import Workspace

from magnetosuture_thread.coils.allocation import NeedleMechanics
from magnetosuture_thread.coils.needle import NeedleWatch
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.arc import needle_axis
from magnetosuture_thread.geometry.obstacles import Disc, Polygon

NEEDLE = CoilBridgeSettings().needle()
CURVED = dataclasses.replace(NEEDLE, curvature=250.0)
RADIUS, KEEP, RATE = 0.0175, 0.0005, 10.0
DISC = Disc((0.006, 0.004), 0.002)
BLOCK = Polygon(((-0.009, 0.003), (-0.004, 0.004), (-0.005, 0.008), (-0.008, 0.0075)))
EAST = np.array([1.0, 0.0])


def workspace(needle: NeedleMechanics = NEEDLE, *obstacles: Disc | Polygon, keep: float = KEEP) -> Workspace:
    """Return a workspace with a disc in it, or other obstacles."""
    return Workspace(RADIUS, obstacles or (DISC,), keep, RATE, needle)


SPACES = {id(needle): workspace(needle) for needle in (NEEDLE, CURVED)}


def direction(angle: float | np.ndarray) -> np.ndarray:
    """Return a unit vector, shape (2,), or those of some angles, shape (2, m)."""
    return np.array([np.cos(angle), np.sin(angle)])


def barriers(needle: NeedleMechanics, tail: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return h and its derivatives by v, by another way: where points are after a small motion, each way."""

    def h(velocity: np.ndarray) -> np.ndarray:
        small = 1e-6
        turned, moved = carried(needle, tail, heading, velocity, small)
        count = 29  # a quarter of a millimetre apart
        points, _ = needle_axis(
            moved, math.atan2(turned[1], turned[0]), needle.length, needle.curvature, np.linspace(0.0, 1.0, count)
        )
        wall = RADIUS - np.linalg.norm(points, axis=1)
        return np.concatenate([wall, DISC.signed_distance(points)[0]]) - KEEP

    step = 0.1
    slopes = [(h(step * way) - h(-step * way)) / (2.0 * step * 1e-6) for way in np.eye(2)]
    return h(np.zeros(2)), np.column_stack(slopes)


def carried(
    needle: NeedleMechanics, tail: np.ndarray, heading: np.ndarray, velocity: np.ndarray, time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return heading and tail after a time, as `NeedleWatch.pose` carries them."""
    e = needle.chord_direction(heading)
    lever = 0.5 * needle.chord
    angle = float(velocity @ (-e[1], e[0])) / lever * time
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = tail + lever * e + float(velocity @ e) * time * e
    return turn @ heading, middle - turn @ (lever * e)


POSE = {
    "x": st.floats(-0.014, 0.014),
    "y": st.floats(-0.014, 0.014),
    "angle": st.floats(-np.pi, np.pi),
    "way": st.floats(-np.pi, np.pi),
    "speed": st.floats(1e-4, 0.05),
    "needle": st.sampled_from([NEEDLE, CURVED]),
}


def test_the_kinematics_here_are_those_of_the_watch():
    watch = NeedleWatch(NEEDLE, 0.2, 0.045)
    velocity, tail, heading = np.array([0.004, 0.009]), np.array([0.001, 0.002]), direction(0.4)
    watch.see(tail, heading, 1.0, 1, 1.0, 1.0)
    watch.move(velocity, 1.0)
    pose = watch.pose(1.02, 1.02)
    assert pose is not None
    turned, moved = carried(NEEDLE, tail, heading, velocity, 0.02)
    np.testing.assert_allclose(pose.tail, moved, atol=1e-15)
    np.testing.assert_allclose(pose.heading, turned, atol=1e-15)


@settings(max_examples=60, deadline=None)
@given(**POSE)
def test_every_point_keeps_its_distance_and_no_nearer_velocity_does(
    x: float, y: float, angle: float, way: float, speed: float, needle: NeedleMechanics
):
    tail, heading, velocity = np.array([x, y]), direction(angle), speed * direction(way)
    h, slopes = barriers(needle, tail, heading)
    assume(h.min() >= 0.0)  # beyond, it has to lean too
    found = SPACES[id(needle)].safe_velocity(velocity, tail, heading)
    least = -RATE * np.maximum(h, 0.0)
    assert np.all(slopes @ found >= least - 1e-5 * speed)  # of the central differences
    circle = direction(np.linspace(0.0, 2.0 * np.pi, 181)).T
    others = (speed * np.linspace(0.0, 1.0, 41)[:, None, None] * circle).reshape(-1, 2)
    good = others[(others @ slopes.T >= least).all(axis=1)]
    apart = np.linalg.norm(found - velocity)
    assert apart <= np.linalg.norm(good - velocity, axis=1).min() + 1e-5 * speed
    assert SPACES[id(needle)].allows(found, tail, heading, 1e-12 * speed)


@settings(max_examples=60, deadline=None)
@given(**POSE)
def test_wherever_it_is_it_may_stop_and_goes_no_deeper_where_it_is_too_near(
    x: float, y: float, angle: float, way: float, speed: float, needle: NeedleMechanics
):
    tail, heading, velocity = 1.4 * np.array([x, y]), direction(angle), speed * direction(way)
    space = SPACES[id(needle)]
    assert space.allows(np.zeros(2), tail, heading, 0.0)
    assert space.safe_velocity(np.zeros(2), tail, heading).tolist() == [0.0, 0.0]
    found = space.safe_velocity(velocity, tail, heading)
    assert space.allows(found, tail, heading, 1e-12 * speed)
    assert np.linalg.norm(found) <= speed * (1.0 + 1e-12)
    h, slopes = barriers(needle, tail, heading)
    assert np.all(slopes[h <= 0.0] @ found >= -1e-5 * speed)


@settings(deadline=None)
@given(way=st.floats(-np.pi, np.pi), speed=st.floats(0.0, 0.02))
def test_far_from_everything_a_velocity_is_left_bit_for_bit(way: float, speed: float):
    velocity = speed * direction(way)
    tail = np.array([-0.0035, -0.006])
    assert SPACES[id(NEEDLE)].safe_velocity(velocity, tail, EAST).tolist() == velocity.tolist()


def test_a_velocity_faster_than_usual_is_kept_clear_too():
    """The quick search does not reach so far."""
    tail, velocity = np.array([0.0, -0.0035]), np.array([0.0, -1.0])
    found = workspace().safe_velocity(velocity, tail, np.array([0.0, -1.0]))
    np.testing.assert_allclose(found, [0.0, -RATE * (RADIUS - 0.0105 - KEEP)], atol=1e-12)


def test_a_velocity_of_any_size_is_held_back():
    tail = np.array([RADIUS - 2.0 * KEEP - NEEDLE.length, 0.0])
    for speed in (1.0, 1e30, 1e300):
        found = workspace().safe_velocity(speed * EAST, tail, EAST)
        np.testing.assert_allclose(found, [RATE * KEEP, 0.0], atol=1e-11)


def test_in_contact_a_needle_slides_leaves_and_does_not_enter():
    space = workspace(NEEDLE, Polygon(((-0.01, 0.0), (0.01, 0.0), (0.01, 0.002), (-0.01, 0.002))))
    up, tail = np.array([0.0, 1.0]), np.array([0.0, -KEEP - NEEDLE.length])  # the tip at the bound
    np.testing.assert_allclose(space.safe_velocity(np.array([0.003, 0.004]), tail, up), [0.003, 0.0], atol=1e-15)
    away = np.array([0.003, -0.004])
    assert space.safe_velocity(away, tail, up).tolist() == away.tolist()
    assert not space.allows(np.array([0.0, 0.004]), tail, up, 0.0039)
    assert space.allows(np.array([0.0, 0.004]), tail, up, 0.0041)


def test_beyond_the_bound_a_needle_that_slides_leaves_a_little():
    space = workspace(NEEDLE, Polygon(((-0.01, 0.0), (0.01, 0.0), (0.01, 0.002), (-0.01, 0.002))))
    up, tail = np.array([0.0, 1.0]), np.array([0.0, -0.9 * KEEP - NEEDLE.length])
    x, y = space.safe_velocity(np.array([0.003, 0.004]), tail, up)
    assert x > 0.002
    assert y / x == pytest.approx(-math.tan(0.1), rel=1e-9)


def test_between_two_walls_too_near_a_needle_can_still_leave_along_them():
    walls = [
        Polygon(((-0.01, side * 4e-4), (0.01, side * 4e-4), (0.01, side * 2e-3), (-0.01, side * 2e-3)))
        for side in (1.0, -1.0)
    ]
    found = workspace(NEEDLE, *walls).safe_velocity(np.array([0.004, 0.003]), np.array([-0.0035, 0.0]), EAST)
    np.testing.assert_allclose(found, [0.004, 0.0], atol=1e-12)


def test_what_is_pushed_against_it_along_the_needle_is_stopped():
    tail = np.array([RADIUS - KEEP - NEEDLE.length, 0.0])
    np.testing.assert_allclose(workspace().safe_velocity(0.01 * EAST, tail, EAST), [0.0, 0.0], atol=1e-15)


def test_a_curved_needle_is_kept_clear_with_its_belly():
    """Its chord passes the post by more than the clearance, its body does not."""
    length, curvature = CURVED.length, CURVED.curvature
    chord = CURVED.chord_direction(EAST)
    heading = np.array([chord[0], -chord[1]])  # so that the chord is along x, the belly below it
    points, _ = needle_axis(
        np.array([-0.5 * CURVED.chord, 0.0]), math.atan2(*heading[::-1]), length, curvature, np.array([0.5])
    )
    post = Disc((points[0, 0], points[0, 1] - KEEP - 0.001), 0.001)
    tail, down = np.array([-0.5 * CURVED.chord, 0.0]), np.array([0.0, -0.01])
    space = workspace(CURVED, post)
    assert space.clearance(tail, heading) == pytest.approx(KEEP, abs=1e-9)
    assert not space.allows(down, tail, heading, 1e-4)
    assert workspace(NEEDLE, post).allows(down, tail, EAST, 0.0)
    ends = np.array([tail, -tail])
    assert post.signed_distance(ends)[0].min() > 2.0 * KEEP


def test_the_clearance_is_the_least_distance_of_the_body():
    space = workspace(NEEDLE, DISC, BLOCK)
    at = np.linspace(0.0, 1.0, 201)
    for x, y, angle in (
        (0.0, 0.0, 0.3),
        (0.004, -0.002, 1.2),
        (0.008, 0.0, 0.1),
        (-0.012, 0.0, 1.0),
        (0.0, 0.004, 0.0),
    ):
        points, _ = needle_axis(np.array([x, y]), angle, NEEDLE.length, 0.0, at)
        expected = min(RADIUS - np.linalg.norm(points, axis=1).max(), DISC.signed_distance(points)[0].min())
        found = space.clearance(np.array([x, y]), direction(angle))
        assert found <= expected + 2e-5
        if x > 0.0:
            assert found == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_refused(bad: float):
    space, good = workspace(), np.array([0.001, 0.0])
    for velocity, tail, heading in (
        (np.array([bad, 0.0]), good, EAST),
        (good, np.array([0.0, bad]), EAST),
        (good, good, np.array([bad, 0.0])),
        (good, good, np.zeros(2)),
    ):
        with pytest.raises(InvalidInputError, match="finite numbers"):
            space.safe_velocity(velocity, tail, heading)
        with pytest.raises(InvalidInputError, match="finite numbers"):
            space.allows(velocity, tail, heading, 0.0)
    with pytest.raises(InvalidInputError, match="finite numbers"):
        space.clearance(np.array([bad, 0.0]), EAST)


def driven(space: Workspace, seed: int, seconds: float, steps: int) -> float:
    """Return the least h on a ride under random commands at full speed, each for half a second; 200 Hz."""
    random = np.random.default_rng(seed)
    tail, heading, worst = np.array([-0.0035, -0.002]), EAST, math.inf
    interval = 0.005 / steps
    for tick in range(round(200 * seconds)):
        if tick % 100 == 0:
            velocity = 0.02 * direction(random.uniform(-np.pi, np.pi))
        for _ in range(steps):
            safe = space.safe_velocity(velocity, tail, heading)
            heading, tail = carried(NEEDLE, tail, heading, safe, interval)
            worst = min(worst, space.clearance(tail, heading) - KEEP)
    return worst


@pytest.mark.parametrize("seed", range(3))
def test_no_command_takes_the_needle_into_the_clearance(seed: int):
    """With ten steps in each period what a held velocity is off is a hundredth in each, a tenth in all."""
    assert driven(workspace(NEEDLE, DISC, BLOCK), seed, 5.0, 10) > -1e-6


@pytest.mark.parametrize("seed", range(3))
def test_at_the_bridges_rate_it_is_off_by_what_a_held_velocity_is(seed: int):
    """Up to 0.3 um in each period where both ends slide around the wall, as the docstring says."""
    assert driven(workspace(NEEDLE, DISC, BLOCK), seed, 5.0, 1) > -0.3e-6 * 200 * 5.0


def test_a_tip_that_slides_along_the_wall_stays_at_the_bound():
    """Without the lean it would sink by a quarter of a micrometre in each period, and never return."""
    space = workspace(NEEDLE, Disc((0.0, 0.0), 0.001))
    tail, heading, worst = np.array([0.004, 0.0]), EAST, math.inf
    for _ in range(600):
        tip = tail + NEEDLE.chord * heading
        outwards = tip / np.linalg.norm(tip)
        velocity = 0.02 * (0.9 * np.array([-outwards[1], outwards[0]]) + 0.3 * outwards)
        if abs(outwards @ heading) < 0.5:  # nearly along the wall, where both ends would touch: across again
            tail, heading = tip - NEEDLE.chord * outwards, outwards
        heading, tail = carried(NEEDLE, tail, heading, space.safe_velocity(velocity, tail, heading), 0.005)
        worst = min(worst, space.clearance(tail, heading) - KEEP)
    assert -2e-6 < worst < 1e-5
