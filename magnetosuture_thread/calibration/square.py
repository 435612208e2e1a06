"""A slow square of a bare needle, by which a commissioning is verified."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.planning.follower import PathFollower, PathFollowerSettings

SPEED = 2e-3  # m/s


class Square:
    """Steers the tip of a needle around a square, by a velocity for each measured pose.

    Args:
        coils: settings of the bridge, with a thread.
        dish_radius: [m].

    Attributes:
        settings: of the bridge that is to follow: without thread and prediction, and slow.
        time_limit: [s].
        done: whether the end was reached.
    """

    def __init__(self, coils: CoilBridgeSettings, dish_radius: float) -> None:
        side = min(8e-3, 0.5 * dish_radius)  # m
        corners = 0.5 * side * np.array([[1, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]])
        needle = {"needle_length": coils.needle_length, "speed": SPEED, "settle": 0.0}
        waypoints = tuple(corners.ravel().tolist())
        self._path = PathFollower(PathFollowerSettings(waypoints=waypoints, **needle))  # type: ignore[arg-type]
        bare = {"needle_drag": coils.needle_drag - coils.thread_drag, "thread_drag": 0.0}
        slow = {"without_prediction": "slow", "speed_without_prediction": 2.0 * SPEED}
        self.settings: CoilBridgeSettings = replace(coils, **bare, **slow)  # type: ignore[arg-type]
        self.time_limit = 3.0 * 4.0 * side / SPEED  # three times as long as the way takes
        self._length, self._progress = coils.needle_length, 0.0
        self._tips: list[Vector] = []
        self._setpoints: list[Vector] = []

    @property
    def done(self) -> bool:
        """Whether the end was reached."""
        return self._progress >= 1.0

    def command(self, stamp: float, pose: Vector, age: float) -> Vector:
        """Return the velocity of the tip for a pose, tail and heading, of a time, and its age, shape (2,) [m/s]."""
        heading = np.array([math.cos(pose[2]), math.sin(pose[2])])
        command = self._path.compute_command(stamp, pose[:2], heading, age)
        self._tips.append(pose[:2] + self._length * heading)
        self._setpoints.append(command.tip)
        self._progress = command.progress
        return command.velocity

    def result(self, fault: str) -> tuple[float, str]:
        """Return the largest distance of the tip from its path [m], and why its end was not reached.

        Args:
            fault: of the bridge; empty for none.
        """
        if not self.done:
            return math.inf, fault or f"only {self._progress:.0%} of it was done in time"
        apart = np.linalg.norm(np.array(self._tips)[:, None] - np.array(self._setpoints), axis=2).min(axis=1)
        return float(apart.max()), ""
