"""Barriers that a user adds to the needle's safety filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread import (
    Barrier,
    Gradient,
    InvalidInputError,
    NeedleSafetyFilter,
    Scene,
)
from test.examples import load_example

MovingDisc = load_example("barriers/moving_disc").MovingDisc
HOLD, LENGTH = 0.2, 0.0025
EAST = np.array([1.0, 0.0])


class HalfPlane(Barrier):
    """Every point of the needle keeps y below a bound: h_i = bound - y_i."""

    name = "half_plane"

    def __init__(self, bound: float = 0.003) -> None:
        self.bound = bound

    def value(self, positions: np.ndarray) -> np.ndarray:
        """Return a row for each point."""
        return np.asarray(self.bound - positions[:, 1])

    def gradient(self, positions: np.ndarray) -> Gradient:
        """Return its gradient."""
        count = len(positions)
        return Gradient(np.arange(count)[:, None], np.tile([[[0.0, -1.0]]], (count, 1, 1)))


class MovingHalfPlane(HalfPlane):
    """The same bound, which moves: h_i = bound + t rate - y_i."""

    def __init__(self, bound: float = 0.003, rate: float = 0.0) -> None:
        super().__init__(bound)
        self.rate, self.time, self.start = rate, 0.0, bound

    def set_time(self, time: float) -> None:
        """Move the bound."""
        self.time, self.bound = time, self.start + time * self.rate


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
            points = safety._added.points_at(*safety.kinematics.moved(tail, heading, along, across, part * HOLD))
            for barrier in safety._added.barriers:
                barrier.set_time(now + part * HOLD)
                least = min(least, float(barrier.value(points).min()))
        tail, heading = safety.kinematics.moved(tail, heading, along, across, HOLD)
    return least, active


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("barrier", "length"), [(HalfPlane(), LENGTH), (HalfPlane(), 0.0), (TurnedAway(), LENGTH)])
def test_an_added_barrier_holds_whatever_is_commanded(barrier: Barrier, length: float, seed: int):
    least, active = driven(needle(barrier, length=length), seed)
    # It is checked at 8 instants of a hold, and between two of them the arc of a needle bends by no more than this.
    assert least > -1e-6
    assert barrier.name in active


def test_the_share_that_the_bridge_asks_for_knows_added_barriers():
    safety = needle(HalfPlane(0.001))
    share, name = safety.safe_share(np.array([0.0, 0.02]), np.array([0.0, 0.0]), np.array([0.0, 1.0]))
    assert name == "half_plane"
    assert share == 0.0  # its tip is beyond the bound
    share, name = safety.safe_share(np.array([0.0, 0.02]), np.array([0.0, -0.004]), np.array([0.0, 1.0]))
    assert 0.25 <= share < 1.0
    assert name == "half_plane"
    assert safety.safe_share(np.array([0.0, -0.02]), np.array([0.0, 0.0]), np.array([0.0, 1.0])) == (1.0, "")


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


PERIOD, CLEARANCE = 0.05, 1e-4  # s and m


def chased(command: np.ndarray, *discs: Barrier, steps: int = 40) -> tuple[list[np.ndarray], list[float]]:
    """Command a point at the origin that discs move to; return what was filtered, and the least h after each step."""
    safety, tail = needle(*discs, length=0.0), np.zeros(2)
    filtered, least = [], []
    for step in range(steps):
        found = safety.filter(command, tail, EAST, time=100.0 + step * PERIOD, first_time=100.0)
        tail = tail + PERIOD * found.filtered
        filtered.append(found.filtered)
        for disc in discs:
            disc.set_time((step + 1) * PERIOD)
        least.append(min(float(disc.value(tail[None])[0]) for disc in discs))
    return filtered, least


def disc_from(side: float, name: str = "moving_disc") -> Barrier:
    """Return a disc that comes along x at 2 mm/s from -1, the left, or 1, the right."""
    disc = MovingDisc((side * (0.0015 + CLEARANCE), 0.0), (-0.002 * side, 0.0), 0.0015)
    disc.name = name
    return disc


def test_a_needle_that_is_slower_than_the_disc_behind_it_flees_as_fast_as_it_is_commanded():
    command = np.array([0.001, 0.0])
    filtered, least = chased(command, disc_from(-1.0), steps=20)
    assert all(np.allclose(velocity, command, rtol=1e-9) for velocity in filtered)
    assert least[-1] == pytest.approx(CLEARANCE - (0.002 - 0.001) * 20 * PERIOD)  # it is run over, and does not wait


def test_between_two_discs_that_close_in_a_needle_leaves_sideways_and_does_not_run_into_one():
    filtered, _ = chased(np.array([0.0, 0.003]), disc_from(-1.0), disc_from(1.0, "other_disc"), steps=10)
    assert all(velocity[1] > 0.0029 for velocity in filtered)
    (towards, *_), _ = chased(np.array([0.003, 0.0]), disc_from(-1.0), disc_from(1.0, "other_disc"), steps=1)
    assert not towards.any()


def test_a_filter_with_a_barrier_that_moves_needs_the_time():
    safety, tail = needle(disc_from(-1.0), length=0.0), np.array([0.0, 0.005])
    for call in (safety.filter, safety.safe_share, safety.nearest_clear):
        with pytest.raises(InvalidInputError, match=r"time: got None.*moving_disc moves"):
            call(np.array([0.001, 0.0]), tail, EAST)
    assert not needle(HalfPlane()).filter(np.array([0.001, 0.0]), tail - 0.01, EAST).active
