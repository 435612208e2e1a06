"""Slow paths of the tip of a needle: the square by which a commissioning is verified, and what the thread needs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.polyline import Points, Vector, arc_lengths
from magnetosuture_thread.planning.follower import PathFollower, PathFollowerSettings, SmoothPath

SPEED = 2e-3  # m/s


class TipPath:
    """Steers the tip of a needle along a path, by a velocity for each measured pose.

    Args:
        needle_length: [m].
        routes: waypoints of the tip after its first place, shape (m, 2) [m]; of several, the one that is followed turns
            least sharply out of the first pose.

    Attributes:
        time_limit: three times as long as the way takes from the first waypoint on [s].
        done: whether the end was reached.
    """

    def __init__(self, needle_length: float, *routes: Points) -> None:
        self._routes, self._path = routes, cast("PathFollower | None", None)
        self.time_limit = 3.0 * float(arc_lengths(routes[0])[-1]) / SPEED
        self._length, self._progress = needle_length, 0.0
        self._tips: list[Vector] = []
        self._setpoints: list[Vector] = []

    @property
    def done(self) -> bool:
        """Whether the end was reached."""
        return self._progress >= 1.0

    def command(self, stamp: float, pose: Vector, age: float) -> Vector:
        """Return the velocity of the tip for a pose, tail and heading, of a time, and its age, shape (2,) [m/s]."""
        heading = np.array([math.cos(pose[2]), math.sin(pose[2])])
        if self._path is None:
            tip = pose[:2] + self._length * heading
            route = self._routes[0]
            if len(self._routes) > 1:
                route = min(self._routes, key=lambda route: _sharpest_turn(np.vstack([tip, route[:5]]), heading))
            places = tuple(np.ravel(route).tolist())
            settings = PathFollowerSettings(waypoints=places, needle_length=self._length, speed=SPEED, settle=0.0)
            self._path = PathFollower(settings)
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


def _sharpest_turn(waypoints: Points, heading: Vector) -> float:
    """Return the greatest turn of a path within half a millimetre [rad]."""
    path = SmoothPath(waypoints, heading)
    tangents = np.array([path.tangent(at) for at in np.arange(0.0, path.length, 5e-4)])
    return float(np.abs(np.diff(np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0])))).max(initial=0.0))


class Square(TipPath):
    """Steers the tip of a needle around a square.

    Args:
        coils: settings of the bridge, with a thread.
        dish_radius: [m].
        any_corner: whether it may begin at each corner, in either sense, by the first pose.

    Attributes:
        settings: of the bridge that is to follow with a bare needle: without thread and prediction, and slow.
    """

    def __init__(self, coils: CoilBridgeSettings, dish_radius: float, *, any_corner: bool = False) -> None:
        side = min(8e-3, 0.5 * dish_radius)  # m
        corners = 0.5 * side * np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]])
        turned = [np.roll(way, k, axis=0) for way in (corners, corners[::-1]) for k in range(4 if any_corner else 1)]
        routes = [np.vstack([way, way[:1]]) for way in (turned if any_corner else turned[:1])]
        super().__init__(coils.needle_length, *routes)
        self.settings: CoilBridgeSettings = replace(
            coils,
            needle_drag=coils.needle_drag - coils.thread_drag,
            thread_drag=0.0,
            without_prediction="slow",
            speed_without_prediction=2.0 * SPEED,
        )


def pulls(dish_radius: float, count: int, *, left: bool = True) -> list[Points]:
    """Return routes of straight pulls through the middle of a dish, with wide turns between them, by first angle.

    A pull goes from -d to d along its angle, and a turn by 240 degrees, of radius b = d tan(30 degrees), leads to the
    next one. With d = 0.42 of the dish's radius, no tip is beyond 0.73 of it: what goes through sharper turns, or
    closer to the wall, pushes the thread against it, by a force that nobody measures.

    Args:
        dish_radius: [m].
        count: of the pulls.
        left: whether turns are counter-clockwise.

    Returns:
        Waypoints of each, shape (m, 2) [m].
    """
    d, side = 0.42 * dish_radius, 1.0 if left else -1.0
    b = d * math.tan(math.pi / 6.0)
    turn = np.linspace(0.0, 4.0 * math.pi / 3.0, 7)[1:-1]
    line = np.column_stack([np.linspace(-d, d, 5), np.zeros(5)])
    arc = np.column_stack([d + b * np.sin(turn), side * b * (1.0 - np.cos(turn))])
    routes = []
    for first in np.linspace(0.0, math.tau, 24, endpoint=False).tolist():
        parts = []
        for k in range(count):
            angle = first + side * k * 4.0 * math.pi / 3.0
            c, s = math.cos(angle), math.sin(angle)
            parts.append(np.vstack([line, arc] if k < count - 1 else [line]) @ np.array([[c, s], [-s, c]]))
        routes.append(np.vstack(parts))
    return routes
