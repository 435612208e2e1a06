"""Barriers that a user adds to the needle's safety filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread import Barrier, ConfigurationError, Disc, Gradient, NeedleSafetyFilter, Scene

HOLD, LENGTH = 0.2, 0.0025
EAST = np.array([1.0, 0.0])


class HalfPlane(Barrier):
    """Every point of the needle keeps y below a bound that may move: h_i = bound + t rate - y_i."""

    name = "half_plane"

    def __init__(self, bound: float = 0.003, rate: float = 0.0) -> None:
        self.bound, self.rate, self.time = bound, rate, 0.0

    def set_time(self, time: float) -> None:
        """Move the bound."""
        self.time = time

    def value(self, positions: np.ndarray) -> np.ndarray:
        """Return a row for each point."""
        return np.asarray(self.bound + self.rate * self.time - positions[:, 1])

    def gradient(self, positions: np.ndarray) -> Gradient:
        """Return its gradient."""
        count = len(positions)
        return Gradient(np.arange(count)[:, None], np.tile([[[0.0, -1.0]]], (count, 1, 1)))


class Appearing(HalfPlane):
    """The same bound, which there is only from a time on."""

    def value(self, positions: np.ndarray) -> np.ndarray:
        """Return a row for each point, or none."""
        return super().value(positions)[: len(positions) if self.time > 0.1 else 0]

    def gradient(self, positions: np.ndarray) -> Gradient:
        """Return its gradient."""
        found = super().gradient(positions)
        count = len(self.value(positions))
        return Gradient(found.nodes[:count], found.values[:count])


class TurnedAway(Barrier):
    """The needle's tip stays right of its tail: one row over two points, so that only turning can break it."""

    name = "turned_away"

    def value(self, positions: np.ndarray) -> np.ndarray:
        """Return the one row."""
        return np.asarray(positions[-1:, 0] - positions[0, 0])

    def gradient(self, positions: np.ndarray) -> Gradient:
        """Return its gradient."""
        return Gradient(np.array([[0, len(positions) - 1]]), np.array([[[-1.0, 0.0], [1.0, 0.0]]]))


def needle(*barriers: Barrier, length: float = LENGTH, scene: Scene | None = None) -> NeedleSafetyFilter:
    """Return a filter in an empty dish of 35 mm."""
    return NeedleSafetyFilter(
        scene or Scene.create(dish_diameter=0.035), barriers, hold_time=HOLD, needle_length=length
    )


def driven(safety: NeedleSafetyFilter, seed: int, periods: int = 300) -> tuple[float, set[str]]:
    """Drive a needle by random commands, each held for the whole hold time; return the least h and what was active."""
    random = np.random.default_rng(seed)
    tail, heading, least = np.array([-0.001, 0.0]), np.array([1.0, 0.0]), math.inf
    active: set[str] = set()
    for period in range(periods):
        if period % 5 == 0:
            angle = random.uniform(-math.pi, math.pi)
            command = random.uniform(0.0, 0.015) * np.array([math.cos(angle), math.sin(angle)])
        now = period * HOLD
        found = safety.filter(command, tail, heading, time=now)
        active.update(found.active)
        along, across = safety.kinematics.body_velocity(heading, found.filtered)
        for part in np.linspace(0.0, 1.0, 33):
            points = safety._points_at(*safety.kinematics.moved(tail, heading, along, across, part * HOLD))
            for barrier in safety._barriers:
                barrier.set_time(now + part * HOLD)
                least = min(least, float(barrier.value(points).min()))
        tail, heading = safety.kinematics.moved(tail, heading, along, across, HOLD)
    return least, active


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("barrier", "length"), [(HalfPlane(), LENGTH), (HalfPlane(), 0.0), (TurnedAway(), LENGTH)])
def test_an_added_barrier_holds_whatever_is_commanded(barrier: Barrier, length: float, seed: int):
    least, active = driven(needle(barrier, length=length), seed)
    # It is checked at 8 instants of a hold, and between two of them the arc of a needle bends by no more than this.
    assert least > -1e-6
    assert barrier.name in active


@pytest.mark.parametrize("seed", range(3))
def test_two_added_barriers_hold_together(seed: int):
    least, active = driven(needle(HalfPlane(), TurnedAway()), seed)
    assert least > -1e-6
    assert active >= {"half_plane", "turned_away"}


def test_a_needle_slides_along_an_added_barrier():
    safety = needle(HalfPlane(0.0))
    found = safety.filter(np.array([0.01, 0.01]), np.array([0.0, -1e-7]), np.array([1.0, 0.0]))
    assert found.active == ("half_plane",)
    assert found.filtered[0] > 0.005  # slower, as the needle turns a little towards the bound while it goes
    assert 0.0 < found.filtered[1] < 1e-5
    assert found.reason == ""
    into = safety.filter(np.array([0.0, 0.01]), np.array([0.0, -1e-7]), np.array([1.0, 0.0]))
    assert into.reason == "stopped by half_plane"


def test_where_it_does_not_matter_a_velocity_is_left_bit_for_bit():
    velocity = np.array([0.005, 0.001])
    found = needle(HalfPlane(0.01)).filter(velocity, np.array([-0.002, 0.0]), np.array([1.0, 0.0]))
    assert found.filtered.tolist() == velocity.tolist()
    assert found.active == ()


def test_a_bound_that_comes_nearer_lets_a_needle_flee_and_not_wait_for_it():
    safety = needle(HalfPlane(0.002, rate=-0.01))
    tail, heading = np.array([0.0, 0.0]), np.array([1.0, 0.0])
    free = safety.filter(np.array([0.01, 0.0]), tail, heading, time=0.0)
    assert free.active == ()  # at the end of the hold the bound is at the needle
    caught = safety.filter(np.array([0.01, 0.0]), tail, heading, time=0.15)
    assert caught.reason == "stopped by half_plane"
    fleeing = safety.filter(np.array([0.0, -0.012]), tail, np.array([0.0, -1.0]), time=0.15)
    assert fleeing.filtered.tolist() == [0.0, -0.012]


def test_the_share_that_the_bridge_asks_for_knows_added_barriers():
    safety = needle(HalfPlane(0.001))
    share, name = safety.safe_share(np.array([0.0, 0.02]), np.array([0.0, 0.0]), np.array([0.0, 1.0]))
    assert name == "half_plane"
    assert share == 0.0  # its tip is beyond the bound
    share, name = safety.safe_share(np.array([0.0, 0.02]), np.array([0.0, -0.004]), np.array([0.0, 1.0]))
    assert 0.25 <= share < 1.0
    assert name == "half_plane"
    assert safety.safe_share(np.array([0.0, -0.02]), np.array([0.0, 0.0]), np.array([0.0, 1.0])) == (1.0, "")


def test_shapes_wall_and_added_barriers_are_named_apart():
    scene = Scene.create(dish_diameter=0.035, shapes={"post": Disc((0.0, -0.003), 0.001)})
    safety = needle(HalfPlane(0.0), scene=scene)
    heading = np.array([1.0, 0.0])
    assert safety.filter(np.array([0.0, 0.01]), np.array([0.0, -1e-7]), heading).active == ("half_plane",)
    assert safety.filter(np.array([0.0, -0.01]), np.array([-0.001, -0.0014]), heading).active == ("post",)
    assert safety.filter(np.array([0.01, 0.0]), np.array([0.0143, -0.001]), heading).active == ("wall",)
    with pytest.raises(ConfigurationError, match="a name that no other barrier has"):
        needle(HalfPlane(), HalfPlane())


def test_the_share_that_keeps_an_added_barrier_includes_the_drift():
    safety = needle(HalfPlane(0.001))
    tail, east, drift = np.array([0.0, 0.0008]), np.array([1.0, 0.0]), 2e-3
    share, name = safety.safe_share(np.zeros(2), tail, east, drift)  # the tip stays, and the tail moves twice as fast
    assert name == "half_plane"
    assert share == pytest.approx(2e-4 / (2.0 * drift * HOLD), abs=0.01)


@pytest.mark.parametrize("unit", [1.0, 250.0])
def test_a_gain_limits_how_fast_an_added_barrier_is_approached_in_any_unit(unit: float):
    class Slow(HalfPlane):
        gain = 2.0

        def value(self, positions: np.ndarray) -> np.ndarray:
            return unit * super().value(positions)

        def gradient(self, positions: np.ndarray) -> Gradient:
            found = super().gradient(positions)
            return Gradient(found.nodes, unit * found.values)

    found = needle(Slow(0.001), length=0.0).filter(np.array([0.0, 0.01]), np.array([0.0, -0.002]), EAST)
    assert found.filtered.tolist() == pytest.approx([0.0, 2.0 * 0.003])
    assert found.active == ("half_plane",)


def test_beyond_an_added_barrier_a_point_leaves_a_little_as_it_slides():
    x, y = needle(HalfPlane(0.0), length=0.0).filter(np.array([0.003, 0.004]), np.array([0.0, 1e-3]), EAST).filtered
    assert x > 0.002
    assert y / x == pytest.approx(-math.tan(0.1), rel=1e-6)


def test_a_barrier_that_appears_within_the_hold_is_kept_too():
    safety, tail = needle(Appearing(0.0), length=0.0), np.array([0.0, -0.001])
    assert safety.filter(np.array([0.01, 0.0]), tail, EAST).active == ()
    found = safety.filter(np.array([0.0, 0.01]), tail, EAST)  # 2 mm in the hold
    assert found.active == ("half_plane",)
    assert found.filtered.tolist() == pytest.approx([0.0, 0.005], abs=2e-5)


def test_with_added_barriers_the_share_is_still_that_of_the_wall_and_no_older_reason_is_named():
    safety, east = needle(HalfPlane(0.002, rate=-0.01)), np.array([0.01, 0.0])
    at_wall = np.array([0.0175 - LENGTH - 0.0015, -0.002])
    share, name = safety.safe_share(east, at_wall, EAST)
    assert name == "wall"
    assert 0.3 < share < 0.6
    assert safety.filter(east, at_wall, EAST).active == ("wall",)
    assert safety.filter(east, np.zeros(2), EAST, time=0.15).active == ("half_plane",)
