"""The path follower, on a needle that does exactly as it is told, or nearly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.guidance.follower import PathFollower
from magnetosuture_thread.guidance.settings import PathFollowerSettings

LENGTH = 0.007
EAST = np.array([1.0, 0.0])
RATE = 60.0


def follower(**changes: Any) -> PathFollower:
    """Return a follower of a bent path."""
    settings = PathFollowerSettings(waypoints=(0.02, 0.003, 0.025, 0.012), **{"settle": 0.0, **changes})
    return settings.follower()


def run(
    steering: PathFollower, drift: np.ndarray, seconds: float = 30.0, first: int = 0
) -> tuple[np.ndarray, np.ndarray, float]:
    """Move a tip by what is asked and a drift; return its distance from the wish, its speeds, and the progress."""
    tip = LENGTH * EAST
    apart, speeds = [], []
    wish = steering.follow(first / RATE, tip - LENGTH * EAST, EAST)
    for step in range(first + 1, first + int(seconds * RATE)):
        tip = tip + (wish.velocity + drift * np.any(wish.velocity)) / RATE
        wish = steering.follow(step / RATE, tip - LENGTH * EAST, EAST)
        apart.append(np.linalg.norm(wish.tip - tip))
        speeds.append(np.linalg.norm(wish.velocity))
        if wish.progress >= 1.0:
            break
    return np.array(apart), np.array(speeds), wish.progress


def test_a_needle_that_obeys_is_taken_along_the_whole_path():
    apart, speeds, progress = run(follower(), np.zeros(2))
    assert progress == 1.0
    assert apart.max() < 1.5e-4
    assert np.median(speeds) == pytest.approx(0.005, rel=0.05)


def test_the_speed_rises_and_falls_within_the_acceleration():
    _, speeds, _ = run(follower(acceleration=0.004), np.zeros(2))
    assert speeds[5] < 0.001
    assert speeds[-10] < 0.003
    assert np.abs(np.diff(speeds[:-2])).max() < 0.004 / RATE * 2.5


def test_a_lasting_drift_is_made_up_for():
    """A proportional law alone would stay behind by drift / gain, here 0.125 mm."""
    drift = np.array([0.0, 0.001])
    with_integral, _, _ = run(follower(), drift)
    without, _, _ = run(follower(integral_gain=0.0), drift)
    settled = slice(150, 240)
    assert np.median(without[settled]) > 1.0e-4
    assert np.median(with_integral[settled]) < 0.5 * np.median(without[settled])


def test_at_the_end_it_asks_for_no_velocity_any_more():
    steering = follower()
    run(steering, np.zeros(2))
    wish = steering.follow(40.0, np.array([0.1, 0.1]), EAST)
    assert wish.progress == 1.0
    assert wish.velocity.tolist() == [0.0, 0.0]


def test_it_is_done_only_when_the_tip_is_there():
    steering = follower(longest_lag=0.1)
    for step in range(1200):
        wish = steering.follow(step / RATE, np.zeros(2), EAST)
    assert wish.progress < 1.0
    assert np.any(wish.velocity)
    there = np.array([0.025, 0.012]) - LENGTH * EAST
    assert steering.follow(20.0, there + np.array([0.0, 4e-4]), EAST).progress == 1.0


def test_nothing_moves_before_it_has_settled_and_the_path_begins_where_the_tip_is_then():
    steering = follower(settle=1.0)
    for step in range(60):
        wish = steering.follow(step / RATE, np.array([1e-5 * step, 0.0]), EAST)
        assert wish.velocity.tolist() == [0.0, 0.0]
        assert wish.progress == 0.0
    steering.follow(1.0, np.array([6e-4, 0.0]), EAST)
    wish = steering.follow(1.0 + 1 / RATE, np.array([6e-4, 0.0]), EAST)
    assert wish.progress > 0.0
    np.testing.assert_allclose(wish.tip, [LENGTH + 6e-4, 0.0], atol=1e-5)


def test_the_point_waits_while_no_pose_comes():
    steering = follower()
    for step in range(60):
        before = steering.follow(step / RATE, step / RATE * 0.005 * EAST, EAST)
    after = steering.follow(61 / RATE + 5.0, 0.005 * EAST, EAST)
    assert after.progress - before.progress < 0.11 * 0.005 / 0.02


def test_the_point_waits_for_a_needle_that_does_not_come_and_asks_for_no_more_than_before():
    steering = follower(longest_lag=0.001)
    for step in range(600):
        wish = steering.follow(step / RATE, np.zeros(2), EAST)
    assert np.linalg.norm(wish.tip - LENGTH * EAST) < 0.0012
    assert np.linalg.norm(wish.velocity) < 0.014
    apart, _, progress = run(steering, np.zeros(2), first=600)
    assert progress == 1.0
    assert np.median(apart) < 1.5e-4


def test_time_that_goes_back_does_not_move_the_point_back():
    steering = follower()
    for step in range(60):
        before = steering.follow(step / RATE, step / RATE * 0.005 * EAST, EAST)
    assert steering.follow(0.2, 0.005 * EAST, EAST).progress == before.progress


def test_a_curved_needle_is_followed_at_its_tip():
    steering = follower(needle_curvature=150.0)
    wish = steering.follow(0.0, np.zeros(2), EAST)
    angle = 150.0 * LENGTH
    np.testing.assert_allclose(wish.tip, [np.sin(angle) / 150.0, (1.0 - np.cos(angle)) / 150.0], atol=1e-9)
