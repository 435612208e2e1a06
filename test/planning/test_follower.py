"""The path-following controller, on an ideal needle and on one with drift."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.planning.follower import PathFollower, PathFollowerSettings, SmoothPath
from magnetosuture_thread.settings.errors import InvalidInputError

LENGTH = 0.007
EAST = np.array([1.0, 0.0])
RATE = 60.0


def follower(**changes: Any) -> PathFollower:
    """Return a follower of a bent path."""
    settings = PathFollowerSettings(waypoints=(0.02, 0.003, 0.025, 0.012), **{"settle": 0.0, **changes})
    return settings.follower()


def run(controller: PathFollower, drift: np.ndarray, first: int = 0) -> tuple[np.ndarray, float]:
    """Move a tip by the commanded velocity and a drift; return distances from the setpoint and progress."""
    tip = LENGTH * EAST
    apart = []
    command = controller.compute_command(first / RATE, tip - LENGTH * EAST, EAST)
    for step in range(first + 1, first + int(30.0 * RATE)):
        tip = tip + (command.velocity + drift * np.any(command.velocity)) / RATE
        command = controller.compute_command(step / RATE, tip - LENGTH * EAST, EAST)
        apart.append(np.linalg.norm(command.tip - tip))
        if command.progress >= 1.0:
            break
    return np.array(apart), command.progress


def test_integral_term_compensates_a_constant_drift():
    """A proportional law alone would stay behind by drift / gain, here 0.125 mm."""
    drift = np.array([0.0, 0.001])
    with_integral, _ = run(follower(), drift)
    without, _ = run(follower(integral_gain=0.0), drift)
    settled = slice(150, 240)
    assert np.median(without[settled]) > 1.0e-4
    assert np.median(with_integral[settled]) < 0.5 * np.median(without[settled])


def test_path_begins_at_the_tip_after_settling():
    controller = follower(settle=1.0)
    for step in range(60):
        command = controller.compute_command(step / RATE, np.array([1e-5 * step, 0.0]), EAST)
        assert command.velocity.tolist() == [0.0, 0.0]
        assert command.progress == 0.0
    controller.compute_command(1.0, np.array([6e-4, 0.0]), EAST)
    command = controller.compute_command(1.0 + 1 / RATE, np.array([6e-4, 0.0]), EAST)
    assert command.progress > 0.0
    np.testing.assert_allclose(command.tip, [LENGTH + 6e-4, 0.0], atol=1e-5)


def test_setpoint_waits_for_a_blocked_needle_and_the_command_stays_bounded():
    controller = follower(max_lag=0.001)
    for step in range(600):
        command = controller.compute_command(step / RATE, np.zeros(2), EAST)
    assert np.linalg.norm(command.tip - LENGTH * EAST) < 0.0012
    assert np.linalg.norm(command.velocity) < 0.014
    apart, progress = run(controller, np.zeros(2), first=600)
    assert progress == 1.0
    assert np.median(apart) < 1.5e-4


CORNERS = np.array([[0.0, 0.0], [0.01, 0.002], [0.012, 0.01], [0.0, 0.012]])


@pytest.mark.parametrize("points", [np.zeros((1, 2)), np.array([[0.0, 0.0], [np.nan, 1.0]]), CORNERS[[0, 1, 1, 2]]])
def test_invalid_waypoints_are_rejected(points: np.ndarray):
    with pytest.raises(InvalidInputError, match="waypoints"):
        SmoothPath(points)
