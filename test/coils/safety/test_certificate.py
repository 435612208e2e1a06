"""For how long a motion keeps clear, against looking at it in small steps by other code."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from benchmarks.keep_out import Needle, World, random_scene
from magnetosuture_thread.coils.filter import NeedleSafetyFilter
from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

EAST = np.array([1.0, 0.0])
HOLD = 0.3


def safety(
    scene: Scene, length: float, curvature: float = 0.0, keep: float = 5e-4, turn_time: float = math.inf
) -> NeedleSafetyFilter:
    """Return a filter that holds for 0.3 s."""
    made = NeedleSafetyFilter(
        scene, keep_out=keep, approach_rate=10.0, hold_time=HOLD, needle_length=length, needle_curvature=curvature
    )
    made.limit_turns(turn_time)
    return made


@pytest.mark.parametrize("seed", range(6))
def test_what_is_certified_keeps_clear_and_little_more_would_not(seed: int):
    random = np.random.default_rng(seed)
    tight = 0
    for _ in range(8):
        scene = random_scene(random)
        length = float(random.uniform(0.001, 0.01))
        curvature = float(random.choice([0.0, random.uniform(-2.5, 2.5) / length]))
        world, filtered = World(scene), safety(scene, length, curvature, 3e-4)
        for _ in range(25):
            r, angle = world.radius * math.sqrt(random.uniform()), float(random.uniform(-math.pi, math.pi))
            needle = Needle(length, curvature, cmath.rect(r, float(random.uniform(-3.0, 3.0))), angle)
            if world.clearance([needle.points()]) < 3.6e-4:
                continue
            velocity = cmath.rect(float(random.uniform(0.0, 0.03)), float(random.uniform(-3.0, 3.0)))
            share, _ = filtered.safe_share(np.array([velocity.real, velocity.imag]), *needle.pose())
            axes = [needle.moved(velocity, HOLD * share * k / 300).points() for k in range(301)]
            assert world.clearance(axes) > 3e-4 - 1e-9
            if share < 0.9:
                end = needle.moved(velocity, HOLD * min(1.0, share + 0.01)).points()
                tight += world.clearance([end]) < 3e-4 + 6e-5
    assert tight > 0


@pytest.mark.parametrize("seed", range(4))
def test_a_turn_that_ends_keeps_clear_whenever_it_ends_and_is_let_through_where_a_turn_that_lasts_is_not(seed: int):
    random, found = np.random.default_rng(seed), 0
    while found < 25:
        scene, length = random_scene(random), float(random.uniform(0.001, 0.006))
        curvature = float(random.choice([0.0, random.uniform(-2.0, 2.0) / length]))
        turn_time = float(random.uniform(0.0, 0.08))
        world = World(scene)
        lasts = safety(scene, length, curvature, 3e-4)
        ends = safety(scene, length, curvature, 3e-4, turn_time)
        for _ in range(25):
            r, angle = world.radius * math.sqrt(random.uniform()), float(random.uniform(-math.pi, math.pi))
            needle = Needle(length, curvature, cmath.rect(r, float(random.uniform(-3.0, 3.0))), angle)
            if not 3e-4 < world.clearance([needle.points()]) < 2e-3:
                continue
            forwards, sideways = random.uniform(-0.003, 0.003), random.uniform(-0.03, 0.03)
            drift = float(random.choice([0.0, random.uniform(-0.003, 0.003)]))
            velocity = complex(forwards, sideways + drift) * cmath.exp(1j * angle)
            tip = np.array([velocity.real, velocity.imag])
            allowed, without = (each.safe_share(tip, *needle.pose(), drift)[0] for each in (ends, lasts))
            assert allowed in {without, 1.0}
            if allowed == without:
                continue
            found += 1
            left, axes = turn_time, [needle.points()]
            for part in random.uniform(0.0, 1.0, 4):  # it turns, more slowly too, and then no more
                rate, duration = float(random.uniform(0.0, 1.0)), float(part * left)
                for _ in range(5):
                    turned = complex(forwards, rate * sideways) * cmath.exp(1j * needle.angle)
                    after = needle.moved(turned, duration / 5)
                    after.middle += drift * duration / 5 * 1j * cmath.exp(0.5j * (needle.angle + after.angle))
                    needle = after
                    axes.append(needle.points())
                left -= duration
            straight = complex(forwards, drift) * cmath.exp(1j * needle.angle) * (HOLD - turn_time + left)
            shift = np.array([straight.real, straight.imag])
            axes += [needle.points() + k / 60 * shift for k in range(1, 61)]
            assert world.clearance(axes) > 3e-4 - 1e-9


def test_what_lies_between_the_ends_of_a_turn_stops_it():
    """A post before the needle's tip is clear of it where the turn begins and where it ends, and not between."""
    turn, turn_time, at = 0.3, 0.05, 2.12e-3
    post = Disc((at * math.cos(0.5 * turn), at * math.sin(0.5 * turn)), 2e-5)
    filtered = safety(
        Scene(Dish(0.03), (SceneShape("post", "instrument", post),)), 0.004, keep=3e-4, turn_time=turn_time
    )
    ends = [np.array([math.cos(angle), math.sin(angle)]) for angle in (0.0, turn)]
    assert min(filtered.clearance(-0.002 * e, e) for e in ends) > 3e-4
    velocity = np.array([0.0, 0.002 * turn / turn_time])
    assert filtered.safe_share(velocity, -0.002 * EAST, EAST)[0] < 0.5
    assert filtered.safe_share(-velocity, -0.002 * EAST, EAST)[0] == 1.0


def test_a_point_is_not_taken_for_a_needle_that_turns():
    scene, at, velocity = Scene(Dish(0.05)), np.array([0.0, 0.0244]), np.array([0.0, 0.02])
    turns, lasts = safety(scene, 0.0, turn_time=0.05), safety(scene, 0.0)
    assert turns.safe_share(velocity, at, EAST) == lasts.safe_share(velocity, at, EAST)
    assert turns.safe_share(velocity, at, EAST)[0] < 0.1


@pytest.mark.parametrize("bad", [-1.0, math.nan])
def test_a_turn_time_that_is_none_is_refused(bad: float):
    with pytest.raises(ConfigurationError, match="turn_time"):
        safety(Scene(), 0.004).limit_turns(bad)


def test_one_who_is_too_near_may_slide_and_leave_and_goes_no_deeper():
    block = SceneShape("block", "wall", Polygon(((-0.01, 0.0), (0.01, 0.0), (0.01, 0.002), (-0.01, 0.002))))
    filtered = safety(Scene(Dish(0.05), (block,)), 0.0)
    for y in (-3e-4, -1e-6, 2e-4, 9e-4):  # before it, and inside
        at = np.array([0.0, y])
        assert filtered.safe_share(np.array([0.0, 0.001]), at, EAST)[0] < 1e-6 if y < 9e-4 else True
        assert filtered.safe_share(np.array([0.0, -0.001]), at, EAST)[0] == 1.0
        if y < 0.0:
            assert filtered.safe_share(np.array([0.001, 0.0]), at, EAST)[0] == 1.0


@pytest.mark.parametrize("seed", range(2))
def test_what_is_certified_for_a_needle_that_drifts_and_turns_fast_keeps_clear_and_little_more_would_not(seed: int):
    """By up to 7 rad in the hold, beside a post and a block."""
    random, tight = np.random.default_rng(seed), 0
    post = SceneShape("post", "instrument", Disc((0.003, 0.003), 0.001))
    block = SceneShape(
        "block", "wall", Polygon(((-0.003, -0.004), (0.002, -0.004), (0.002, -0.0025), (-0.003, -0.0025)))
    )
    filtered = safety(Scene(Dish(0.03), (block, post)), 0.005)

    def clearance(part: float) -> float:
        way = (part * along, part * across)
        times = np.linspace(0.0, HOLD, 101).tolist()
        return min(filtered.clearance(*filtered.kinematics.moved(tail, heading, *way, t, part * drift)) for t in times)

    for _ in range(40):
        angle, tail = float(random.uniform(-3.0, 3.0)), random.uniform(-0.006, 0.006, 2)
        heading = np.array([math.cos(angle), math.sin(angle)])
        velocity, drift = random.uniform(-0.05, 0.05, 2), float(random.choice([0.0, random.uniform(-0.02, 0.02)]))
        along, across = filtered.kinematics.body_velocity(heading, velocity)
        if filtered.clearance(tail, heading) < 6e-4:
            continue
        share, _ = filtered.safe_share(velocity, tail, heading, drift)
        assert clearance(share) > 5e-4 - 1e-9
        if share < 0.9:
            tight += clearance(share + 0.03) < 5.1e-4
    assert tight > 3


def test_around_a_dish_both_ends_slide_at_the_bound():
    """The motion is a turn about the dish's centre: nothing gets nearer, whatever rounding says."""
    filtered, radius = safety(Scene(Dish(0.035)), 0.007), 0.0175 - 5e-4
    lever = 0.0035
    middle = math.sqrt(radius**2 - lever**2)
    velocity = np.array([-0.02 * lever / middle, 0.02])  # forwards, and turned to the left
    assert filtered.safe_share(velocity, np.array([middle, -lever]), np.array([0.0, 1.0]))[0] == 1.0
    assert filtered.safe_share(velocity * [0.9, 1.0], np.array([middle, -lever]), np.array([0.0, 1.0]))[0] < 0.01


def test_between_two_points_of_the_needle_a_corner_keeps_out_too():
    random, worst = np.random.default_rng(3), math.inf
    for _ in range(40):
        x = float(random.uniform(-0.003, 0.003))
        spike = SceneShape("spike", "instrument", Polygon(((x, 0.002), (x + 2e-5, 0.006), (x - 2e-5, 0.006))))
        scene = Scene(Dish(0.05), (spike,))
        filtered, needle = safety(scene, 0.007), Needle(0.007, 0.0, 0j, 0.0)
        # Sidewards, as a motion that is only turned about a far point: many small steps.
        for _ in range(30):
            pose = needle.pose()
            velocity = np.array([0.0, 0.02 if x > 0.0 else -0.02])
            share, _ = filtered.safe_share(velocity, *pose)
            needle = needle.moved(complex(*velocity), HOLD * share)
        worst = min(worst, World(scene).clearance([needle.points()]))
    assert 5e-4 - 1e-9 < worst < 5.3e-4


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_refused(bad: float):
    filtered, good = safety(Scene(), 0.007), np.array([0.001, 0.0])
    for velocity, tail, heading in (
        (np.array([bad, 0.0]), good, EAST),
        (good, np.array([0.0, bad]), EAST),
        (good, good, np.array([bad, 0.0])),
        (good, good, np.zeros(2)),
    ):
        with pytest.raises(InvalidInputError, match=r"finite numbers|a direction"):
            filtered.filter(velocity, tail, heading)
        with pytest.raises(InvalidInputError, match=r"finite numbers|a direction"):
            filtered.safe_share(velocity, tail, heading)


@pytest.mark.parametrize("curvature", [0.0, 250.0])
def test_a_needle_that_drifts_and_turns_goes_as_in_small_steps(curvature: float):
    kinematics, heading = NeedleKinematics(0.007, curvature), np.array([math.cos(0.9), math.sin(0.9)])
    along, across, drift, duration = 0.004, 0.011, -0.006, 0.5
    tail = np.array([0.001, 0.002])
    moved = kinematics.moved(tail, heading, along, across, duration, drift)
    steps = 2000
    for _ in range(steps):
        e = kinematics.chord_direction(heading)
        tail, heading = kinematics.moved(tail, heading, along, across - drift, duration / steps)
        tail = tail + drift * duration / steps * np.array([-e[1], e[0]])
    np.testing.assert_allclose(moved[0], tail, atol=2e-6)
    np.testing.assert_allclose(moved[1], heading, atol=1e-9)


def test_inside_a_shape_no_point_of_a_needle_that_turns_gets_deeper():
    """It backs out of a block whose lower side is near, tail first, and turns by up to three rad/s."""
    block = SceneShape("block", "wall", Polygon(((-0.05, 0.0), (0.05, 0.0), (0.05, 0.05), (-0.05, 0.05))))
    filtered, random = safety(Scene(Dish(0.2), (block,)), 0.007), np.random.default_rng(4)
    body, limited = filtered.compiled_data().body.points, 0
    for _ in range(60):
        angle = float(random.uniform(0.2, math.pi - 0.2))
        heading, tail = np.array([math.cos(angle), math.sin(angle)]), np.array([0.0, 0.002])
        velocity = np.array([0.0, -0.01]) + float(random.uniform(-0.01, 0.01)) * np.array([-heading[1], heading[0]])
        share, _ = filtered.safe_share(velocity, tail, heading)
        along, across = filtered.kinematics.body_velocity(heading, share * velocity)
        heights = []
        for time in np.linspace(0.0, HOLD, 61):
            (_, y), (c, s) = filtered.kinematics.moved(tail, heading, along, across, float(time))
            heights.append(y + s * body[:, 0] + c * body[:, 1])
        assert (np.array(heights) <= heights[0] + 1e-9).all()
        limited += 0.02 < share < 0.98
    assert limited > 3
