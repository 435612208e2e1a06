"""Path follower: settings of the path of the needle's tip, the path, and the controller that follows it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.needle_arc import needle_chord
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.geometry.scene import WALL_NAME, Scene, find_collision
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class PathFollowerSettings(shared.LifecycleSettings, shared.SceneName, shared.NeedleArc):
    """Path of the needle's tip, its speed and the controller gains."""

    GROUP: ClassVar[str] = "path_follower"

    waypoints: tuple[float, ...] = quantity(
        (),
        "waypoints of the tip after its initial position: x and y of each, in the dish frame",
        unit="m",
        minimum=-0.5,
        maximum=0.5,
        multiple=2,
    )
    speed: float = quantity(0.005, "of the tip along the path", unit="m/s", minimum=1e-5, maximum=0.1)
    acceleration: float = quantity(0.01, "at both ends of the path", unit="m/s^2", minimum=1e-4, maximum=10.0)
    gain: float = quantity(8.0, "proportional gain on the tip's position error", unit="1/s", minimum=0.0, maximum=50.0)
    integral_gain: float = quantity(
        4.0, "integral gain on the tip's position error", unit="1/s^2", minimum=0.0, maximum=50.0
    )
    tolerance: float = quantity(
        0.0005, "the path is done when the tip is this close to its end", unit="m", minimum=1e-5, maximum=0.1
    )
    settle: float = quantity(
        1.5,
        "between the first pose and the start, for node discovery and for the thread to come to rest",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    pose_timeout: float = quantity(
        0.5, "a needle pose that is older on arrival gives no command", unit="s", minimum=0.05, maximum=5.0
    )
    audience: int = quantity(
        1, "subscribers to its commands that it waits for: the bridge, and any recorder", minimum=1, maximum=100
    )
    max_lag: float = quantity(
        0.002,
        "maximum distance from the tip to its setpoint while the setpoint moves",
        unit="m",
        minimum=1e-5,
        maximum=0.1,
    )

    def check_path(self, scene: Scene) -> None:
        """Reject a waypoint beyond the wall or inside a shape.

        Raises:
            ConfigurationError: the message names the waypoint and the shape.
        """
        for point in np.reshape(self.waypoints, (-1, 2)):
            what = find_collision(scene, point[None])
            if what:
                within = f"within the dish, {scene.dish.radius:g} m"
                expected = within if what == WALL_NAME else f"a point outside of {what}"
                raise ConfigurationError(f"{self.GROUP}.waypoints", point.tolist(), expected)

    def follower(self) -> PathFollower:
        """Return a controller for this path."""
        return PathFollower(self)


class SmoothPath:
    """Cubic spline through waypoints with an optional initial direction.

        p(l), 0 <= l <= L,    |dp / dl| = 1

    Args:
        waypoints: shape (m, 2), m >= 2, no two the same after one another [m].
        direction: initial unit tangent, shape (2,); free if None.

    Raises:
        InvalidInputError: the waypoints do not define a path.
    """

    def __init__(self, waypoints: Points, direction: NDArray[np.float64] | None = None) -> None:
        steps = np.linalg.norm(np.diff(waypoints, axis=0), axis=1) if len(waypoints) > 1 else np.zeros(1)
        knots = np.concatenate([[0.0], np.cumsum(steps)])
        if not np.all(np.isfinite(waypoints)) or not np.all(np.diff(knots) > 0.0):
            raise InvalidInputError("waypoints", waypoints.tolist(), "at least two that differ, finite [m]")
        from scipy.interpolate import CubicSpline  # here, as it takes a third of a second to import

        free: tuple[Literal[1, 2], NDArray[np.float64]] = (2, np.zeros(2))
        curve = CubicSpline(knots, waypoints, bc_type=(free if direction is None else (1, direction), free))
        # 200 points between two waypoints measure the arc length.
        at = np.unique(np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(knots)]))
        self._points = np.asarray(curve(at))
        self._tangents = np.asarray(curve(at, 1))
        self._tangents /= np.linalg.norm(self._tangents, axis=1)[:, None]
        self._lengths = arc_lengths(self._points)

    @property
    def length(self) -> float:
        """Arc length L [m]."""
        return float(self._lengths[-1])

    def point(self, length: float) -> NDArray[np.float64]:
        """Return the point p(l), shape (2,) [m]; l is clamped to the path."""
        return np.array([np.interp(length, self._lengths, self._points[:, k]) for k in range(2)])

    def tangent(self, length: float) -> NDArray[np.float64]:
        """Return the unit tangent dp / dl, shape (2,)."""
        tangent = np.array([np.interp(length, self._lengths, self._tangents[:, k]) for k in range(2)])
        return np.asarray(tangent / np.linalg.norm(tangent))


def delayed_gain(age: float, interval: float) -> float:
    """Return the gain 1 / (e tau) on a place that is measured late [1/s]: with the delay tau it is critically damped.

    Args:
        age: of the measurement when its command acts [s].
        interval: to the next one [s].
    """
    return 1.0 / (math.e * max(age + interval, 1e-3))


class FollowerCommand(NamedTuple):
    """Setpoint and velocity command of the path follower.

    Attributes:
        tip: setpoint of the tip at the time of the pose, shape (2,) [m].
        velocity: commanded velocity of the tip, shape (2,) [m/s].
        progress: completed fraction of the path, 0 to 1.
    """

    tip: Vector
    velocity: Vector
    progress: float


class PathFollower:
    """Proportional-integral controller that keeps the needle's tip at a setpoint moving along a path.

        v = w dp/dl + k e + c,    e = p(l) - x_tip,    dc/dt = k_i e,    |c| <= half of the speed

    with the setpoint's speed w, which has a trapezoidal profile, k at most `delayed_gain`, and k_i at most k^2 / 4,
    that of two equal roots. The setpoint moves only while poses arrive, and waits while the tip is farther from it than
    `max_lag`, so it does not run away from a needle that does not move. The path begins along the needle, where its tip
    is when `settle` is over.

    Args:
        settings: waypoints after the tip's initial position, w, k, k_i, and the needle.
    """

    def __init__(self, settings: PathFollowerSettings) -> None:
        self._settings = settings
        self._first: float | None = None
        self._done = False
        chord, rotation = needle_chord(settings.needle_length, settings.needle_curvature)
        self._to_tip = chord * rotation
        self._path: SmoothPath | None = None
        self._stamp = 0.0
        self._length = 0.0
        self._correction = np.zeros(2)

    def compute_command(self, stamp: float, tail: Vector, heading: Vector, age: float = 0.0) -> FollowerCommand:
        """Compute the velocity command for a needle pose.

        Args:
            stamp: of the pose [s].
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            age: of the pose when the command is sent [s].

        Raises:
            InvalidInputError: waypoints and first pose do not define a path.
        """
        settings, tip = self._settings, tail + self._to_tip @ heading
        self._first = stamp if self._first is None else self._first
        if self._path is None and stamp - self._first < settings.settle:
            return FollowerCommand(tip, np.zeros(2), 0.0)
        if self._path is None:
            waypoints = np.vstack([tip, np.reshape(settings.waypoints, (-1, 2))])
            self._path = SmoothPath(waypoints, self._to_tip @ heading / np.linalg.norm(tip - tail))
            self._stamp = stamp
        path = self._path
        # After a gap of more than 0.1 s between poses the setpoint has waited and does not run ahead.
        interval = min(max(stamp - self._stamp, 0.0), 0.1)
        self._stamp = stamp
        remaining = path.length - self._length
        # Trapezoidal profile: the setpoint starts from rest and can still stop at the end.
        acceleration = settings.acceleration
        max_from_rest = np.sqrt(2.0 * acceleration * (self._length + 0.5 * acceleration * interval**2))
        speed = float(min(settings.speed, max_from_rest, np.sqrt(2.0 * acceleration * max(remaining, 0.0))))
        waiting = float(np.linalg.norm(path.point(self._length) - tip)) > settings.max_lag
        speed = 0.0 if waiting else speed
        self._length = min(path.length, self._length + speed * interval)
        error = path.point(self._length) - tip
        at_end = path.length - self._length < 1e-6
        self._done = self._done or (at_end and float(np.linalg.norm(error)) < settings.tolerance)
        if self._done:
            return FollowerCommand(path.point(path.length), np.zeros(2), 1.0)
        gain = min(settings.gain, delayed_gain(age, interval))
        if not waiting:
            self._correction += min(settings.integral_gain, 0.25 * gain**2) * interval * error
        size = float(np.linalg.norm(self._correction))
        self._correction *= min(1.0, 0.5 * settings.speed / size) if size > 0.0 else 1.0
        velocity = speed * path.tangent(self._length) + gain * error + self._correction
        return FollowerCommand(
            # The path is done when the tip has arrived, not the setpoint ahead of it.
            path.point(self._length),
            velocity,
            min(0.999, self._length / path.length),
        )


def prepare_paths() -> None:
    """Import what the first path needs, which would delay whoever waits for that."""
    SmoothPath(np.array([[0.0, 0.0], [1e-3, 0.0]]))
