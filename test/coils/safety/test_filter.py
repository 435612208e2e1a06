"""What the filter makes of a commanded velocity."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from benchmarks.keep_out import Needle, World, random_scene
from magnetosuture_thread.coils.filter import MAX_SIDESTEP, SIDESTEP_MARGIN, SIDESTEP_RATE, NeedleSafetyFilter
from magnetosuture_thread.coils.needle_motion import BAND, NeedleKinematics
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.settings.errors import InvalidInputError

EAST, NORTH = np.array([1.0, 0.0]), np.array([0.0, 1.0])
HOLD, RATE, KEEP, LENGTH = 0.2, 5.0, 5e-4, 0.007
POST = SceneShape("post", "instrument", Disc((0.006, 0.004), 0.002))
BLOCK = SceneShape("block", "wall", Polygon(((-0.01, 0.0), (0.01, 0.0), (0.01, 0.002), (-0.01, 0.002))))


def needle_filter(*shapes: SceneShape, length: float = LENGTH, **values: float) -> NeedleSafetyFilter:
    """Return a filter in a dish of 35 mm."""
    given: dict[str, Any] = {
        "keep_out": KEEP,
        "approach_rate": 10.0,
        "hold_time": HOLD,
        "needle_length": length,
        **values,
    }
    return NeedleSafetyFilter(Scene(Dish(0.035), shapes), **given)


@pytest.mark.parametrize("way", [0.0, 1.0, 2.5, -2.0])
def test_far_from_everything_a_velocity_is_left_bit_for_bit(way: float):
    velocity = 0.01 * np.array([math.cos(way), math.sin(way)])
    found = needle_filter(POST).filter(velocity, np.array([-0.0035, -0.006]), EAST)
    assert found.filtered.tolist() == velocity.tolist()
    assert (found.active, found.reason) == ((), "")


def test_friction_comes_first_then_speed_then_acceleration():
    limited = needle_filter(max_speed=0.02, max_acceleration=0.5)
    at = (np.array([-0.0035, 0.0]), EAST)
    found = limited.filter(np.array([0.03, 0.0]), *at, slowdown=0.5)
    assert (found.filtered.tolist(), found.active) == ([0.015, 0.0], ("friction",))
    found = limited.filter(np.array([0.03, 0.04]), *at)
    assert found.filtered.tolist() == pytest.approx([0.012, 0.016])
    assert found.active == ("speed",)
    found = limited.filter(np.array([0.03, 0.0]), *at, previous=np.zeros(2), elapsed=0.01)
    assert (found.filtered.tolist(), found.active) == ([0.005, 0.0], ("speed", "acceleration"))
    found = limited.filter(np.array([0.03, 0.0]), *at, max_speed=0.001)
    assert (found.filtered.tolist(), found.active) == ([0.001, 0.0], ("speed",))
    assert limited.filter(np.array([1e308, 1e308]), *at).filtered.tolist() == pytest.approx([0.02 / 2**0.5] * 2)
    for slowdown in (-0.1, 1.1, math.nan):
        with pytest.raises(InvalidInputError, match="slowdown"):
            limited.filter(np.array([0.03, 0.0]), *at, slowdown=slowdown)


def test_towards_the_wall_it_slows_down_and_says_by_what():
    tail = np.array([0.0175 - 2.0 * KEEP - LENGTH, 0.0])
    found = needle_filter().filter(np.array([0.02, 0.0]), tail, EAST)
    assert found.filtered.tolist() == pytest.approx([RATE * KEEP, 0.0], rel=0.01)
    assert (found.active, found.reason) == (("wall",), "")


def test_a_point_slides_along_a_block_and_leaves_it():
    point = needle_filter(BLOCK, length=0.0)
    at = (np.array([0.0, -KEEP - BAND]), EAST)
    np.testing.assert_allclose(point.filter(np.array([0.003, 0.004]), *at).filtered, [0.003, 0.0], atol=1e-5)
    away = np.array([0.003, -0.004])
    assert point.filter(away, *at).filtered.tolist() == away.tolist()


@pytest.mark.parametrize("depth", [1e-5, 8e-5, 1.8e-4])
@pytest.mark.parametrize("turned", [False, True])
def test_a_needle_along_a_block_is_taken_off_sideways(depth: float, turned: bool):
    """The block is on the left of a needle to the east, and on the right of one to the west."""
    y = -(KEEP + SIDESTEP_MARGIN - depth)
    tail, heading = (np.array([0.5 * LENGTH, y]), -EAST) if turned else (np.array([-0.5 * LENGTH, y]), EAST)
    step = needle_filter(BLOCK).sidestep(tail, heading)
    assert step == pytest.approx((1.0 if turned else -1.0) * min(MAX_SIDESTEP, SIDESTEP_RATE * depth), rel=1e-6)


def test_far_from_everything_and_in_a_gap_there_is_no_step_sideways():
    assert needle_filter(BLOCK).sidestep(np.array([-0.5 * LENGTH, -2e-3]), EAST) == 0.0
    walls = [
        SceneShape(
            f"wall_{k}", "wall", Polygon(((-0.01, s * 4e-4), (0.01, s * 4e-4), (0.01, s * 2e-3), (-0.01, s * 2e-3)))
        )
        for k, s in enumerate((1.0, -1.0))
    ]
    gap = needle_filter(*walls)
    assert [gap.sidestep(np.array([-0.5 * LENGTH, y]), EAST) for y in (0.0, 1e-4)] == [0.0, 0.0]


@pytest.mark.parametrize("seed", range(3))
def test_it_is_never_faster_than_commanded_and_near_nothing_the_best_there_is(seed: int):
    random = np.random.default_rng(seed)
    rested = 0
    for _ in range(10):
        scene = random_scene(random)
        world = World(scene)
        safety = NeedleSafetyFilter(scene, keep_out=3e-4, approach_rate=10.0, hold_time=HOLD, needle_length=0.004)
        for _ in range(30):
            point = 1.2 * world.radius * random.uniform(-1.0, 1.0, 2)
            needle = Needle(0.004, 0.0, complex(*point), float(random.uniform(-3.0, 3.0)))
            velocity = random.uniform(-0.02, 0.02, 2)
            found = safety.filter(velocity, *needle.pose())
            assert np.linalg.norm(found.filtered) <= np.linalg.norm(velocity) * (1.0 + 1e-9)
            assert bool(found.reason) == (not found.filtered.any())
            assert bool(found.active) == (found.filtered.tolist() != velocity.tolist())
            share, _ = safety.safe_share(found.filtered, *needle.pose())
            assert share > 1.0 - 1e-6
            rested += bool(found.reason)
    assert rested < 200


def test_through_the_channel_of_the_hernia_nothing_is_taken_off():
    safety = NeedleSafetyFilter(
        read_scene("hernia_ring"), keep_out=2.5e-4, approach_rate=10.0, hold_time=0.205, needle_length=0.0025
    )
    for y in np.linspace(-0.0105, -0.005, 40):
        for speed in (0.002, 0.003):
            found = safety.filter(speed * NORTH, np.array([0.0, y]), NORTH)
            assert found.filtered.tolist() == (speed * NORTH).tolist()


def test_shapes_are_named_right_whatever_kinds_come_before_them():
    """Discs come before polygons in compiled code."""
    safety = needle_filter(BLOCK, POST, length=0.0)
    for name, at, velocity in (
        ("block", np.array([0.0, -0.001]), 0.02 * NORTH),
        ("post", np.array([0.006, 0.0071]), -0.02 * NORTH),
    ):
        assert safety.safe_share(velocity, at, EAST)[1] == name
        assert safety.filter(velocity, at, EAST).active == (name,)


def test_a_curved_needle_is_kept_clear_of_the_wall_with_its_belly():
    """Driven forwards and to the right its belly comes 0.4 mm before the wall, though its ends do not."""
    half = 0.5 * 250.0 * LENGTH
    chord, belly = 2.0 / 250.0 * math.sin(half), (1.0 - math.cos(half)) / 250.0
    safety, needle = needle_filter(needle_curvature=250.0), NeedleKinematics(LENGTH, 250.0)
    tail, heading = np.array([-0.5 * chord, belly + KEEP + 2e-4 - 0.0175]), np.array([math.cos(half), -math.sin(half)])
    velocity = np.array([0.0, -0.01])
    assert safety.clearance(tail, heading) == pytest.approx(KEEP + 2e-4, abs=1e-6)
    found = safety.filter(velocity, tail, heading)
    assert found.active == ("wall",)
    for commanded in (velocity, np.array([0.006, -0.01])):
        share, name = safety.safe_share(commanded, tail, heading)
        along, across = needle.body_velocity(heading, commanded)
        for part, clear in ((1.0, True), (1.05, False)):
            poses = [
                needle.moved(tail, heading, part * share * along, part * share * across, time)
                for time in np.linspace(0.0, HOLD, 41)
            ]
            assert (min(safety.clearance(*pose) for pose in poses) > KEEP - 1e-8) == clear
        assert name == "wall"


def test_clearance_is_that_of_the_closest_point_from_wall_and_shapes():
    tail, heading = np.array([0.001, 0.002]), np.array([0.6, 0.8])
    tip = tail + LENGTH * heading
    assert needle_filter().clearance(tail, heading) == pytest.approx(0.0175 - math.hypot(*tip))
    beside = tail + 0.5 * LENGTH * heading + 0.003 * np.array([-0.8, 0.6])
    post = SceneShape("post", "instrument", Disc((float(beside[0]), float(beside[1])), 0.001))
    assert needle_filter(post).clearance(tail, heading) == pytest.approx(0.002)
