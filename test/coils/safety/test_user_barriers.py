"""Barriers that a user adds to the needle's safety filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread import Barrier, Gradient, InvalidInputError, NeedleSafetyFilter, Scene
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


class TurnedAway(Barrier):
    """The needle's tip stays right of its tail: one row over two points, so that only turning can break it."""

    name = "turned_away"

    def value(self, positions: np.ndarray) -> np.ndarray:
        """Return the one row."""
        return np.asarray(positions[-1:, 0] - positions[0, 0])

    def gradient(self, positions: np.ndarray) -> Gradient:
        """Return its gradient."""
        return Gradient(np.array([[0, len(positions) - 1]]), np.array([[[-1.0, 0.0], [1.0, 0.0]]]))


def needle(*barriers: Barrier, length: float = LENGTH) -> NeedleSafetyFilter:
    """Return a filter in an empty dish of 35 mm."""
    return NeedleSafetyFilter(Scene.create(dish_diameter=0.035), barriers, hold_time=HOLD, needle_length=length)


def driven(safety: NeedleSafetyFilter, seed: int) -> tuple[float, set[str]]:
    """Drive a needle by random commands, each held for the whole hold time; return the least h and what was active."""
    random = np.random.default_rng(seed)
    tail, heading, least = np.array([-0.001, 0.0]), np.array([1.0, 0.0]), math.inf
    active: set[str] = set()
    for period in range(300):
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


def test_a_filter_with_a_barrier_that_moves_needs_the_time():
    disc = MovingDisc((-0.0016, 0.0), (0.002, 0.0), 0.0015)
    safety, tail = needle(disc, length=0.0), np.array([0.0, 0.005])
    for call in (safety.filter, safety.safe_share, safety.nearest_clear):
        with pytest.raises(InvalidInputError, match=r"time: got None.*moving_disc moves"):
            call(np.array([0.001, 0.0]), tail, EAST)
    assert not needle(HalfPlane()).filter(np.array([0.001, 0.0]), tail - 0.01, EAST).active
