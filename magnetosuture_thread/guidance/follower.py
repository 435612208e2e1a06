"""Follows a path with the needle's tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.guidance.path import SmoothPath

Vector = NDArray[np.float64]

LONGEST_INTERVAL = 0.1  # s; after a longer gap between poses the wish has waited, and does not run ahead


@dataclass(frozen=True)
class Wish:
    """What the follower asks for.

    Attributes:
        tip: where the tip should have been at the time of the pose, shape (2,) [m].
        velocity: of the tip, shape (2,) [m/s].
        progress: share of the path that is done, 0 to 1.
    """

    tip: Vector
    velocity: Vector
    progress: float


class PathFollower:
    """Asks for tip velocities that keep the needle's tip with a point that runs along the path.

        v = w dp/dl + k e + c,    e = p(l) - x_tip,    dc/dt = k_i e,    |c| <= half of the speed

    with the point's speed w, which rises and falls by a constant acceleration at the ends. The point
    runs only while poses come. The path begins at the tip of the first pose, along the needle.

    Args:
        waypoints: where the path leads from there, shape (m, 2) [m].
        speed: w [m/s].
        acceleration: [m/s^2].
        gain: k [1/s].
        integral_gain: k_i [1/s^2]; makes up for drag that the coils' model does not know.
        to_tip: called with tail and unit heading, both of shape (2,); returns the tip [m].
    """

    def __init__(
        self,
        waypoints: Points,
        speed: float,
        acceleration: float,
        gain: float,
        integral_gain: float,
        needle_length: float,
        needle_curvature: float,
    ) -> None:
        self._waypoints = waypoints
        self._speed = speed
        self._acceleration = acceleration
        self._gain = gain
        self._integral_gain = integral_gain
        half = 0.5 * needle_curvature * needle_length
        chord = needle_length * float(np.sinc(half / np.pi))
        self._to_tip = chord * np.array([[np.cos(half), -np.sin(half)], [np.sin(half), np.cos(half)]])
        self._path: SmoothPath | None = None
        self._stamp = 0.0
        self._length = 0.0
        self._correction = np.zeros(2)

    def follow(self, stamp: float, tail: Vector, heading: Vector) -> Wish:
        """Return what to ask for at a needle pose.

        Args:
            stamp: of the pose [s].
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).

        Raises:
            InvalidInputError: the waypoints and the first pose make no path.
        """
        tip = tail + self._to_tip @ heading
        if self._path is None:
            self._path = SmoothPath(
                np.vstack([tip, self._waypoints]), self._to_tip @ heading / np.linalg.norm(tip - tail)
            )
            self._stamp = stamp
        path = self._path
        interval = min(max(stamp - self._stamp, 0.0), LONGEST_INTERVAL)
        self._stamp = stamp
        left = path.length - self._length
        # As fast as allowed such that the point can still come to rest at the end, and has come up from rest.
        rising = np.sqrt(2.0 * self._acceleration * (self._length + 0.5 * self._acceleration * interval**2))
        speed = float(min(self._speed, rising, np.sqrt(2.0 * self._acceleration * max(left, 0.0))))
        self._length = min(path.length, self._length + speed * interval)
        error = path.point(self._length) - tip
        if path.length - self._length < 1e-6:
            return Wish(path.point(path.length), np.zeros(2), 1.0)
        self._correction += self._integral_gain * interval * error
        size = float(np.linalg.norm(self._correction))
        self._correction *= min(1.0, 0.5 * self._speed / size) if size > 0.0 else 1.0
        velocity = speed * path.tangent(self._length) + self._gain * error + self._correction
        return Wish(path.point(self._length), velocity, self._length / path.length)
