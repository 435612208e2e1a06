"""Follows a path with the needle's tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.needle_arc import needle_chord
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.guidance.path import SmoothPath

Vector = NDArray[np.float64]

LONGEST_INTERVAL = 0.1  # s; after a longer gap between poses the wish has waited, and does not run ahead

ALMOST = 0.999  # of the path; it is done when the tip is there, not the point that runs ahead of it


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
    runs only while poses come, and waits while the tip is farther from it than `longest_lag`: when nobody
    moves the needle, it does not run away. The path begins along the needle, where its tip is when `settle` is over.

    Args:
        waypoints: where the path leads from there, shape (m, 2) [m].
        speed: w [m/s].
        acceleration: [m/s^2].
        gain: k [1/s].
        integral_gain: k_i [1/s^2]; makes up for drag that the coils' model does not know.
        longest_lag: [m]
        tolerance: the path is done once the tip was this near to its end [m].
        settle: time from the first pose, in which nothing moves yet [s].
        needle_length: along the body [m].
        needle_curvature: of the needle's arc, positive to the left of its heading [1/m].
    """

    def __init__(
        self,
        waypoints: Points,
        speed: float,
        acceleration: float,
        gain: float,
        integral_gain: float,
        longest_lag: float,
        tolerance: float,
        settle: float,
        needle_length: float,
        needle_curvature: float,
    ) -> None:
        self._waypoints = waypoints
        self._speed = speed
        self._acceleration = acceleration
        self._gain = gain
        self._integral_gain = integral_gain
        self._longest_lag = longest_lag
        self._tolerance = tolerance
        self._settle = settle
        self._first: float | None = None
        self._done = False
        chord, turned = needle_chord(needle_length, needle_curvature)
        self._to_tip = chord * turned
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
        self._first = stamp if self._first is None else self._first
        if self._path is None and stamp - self._first < self._settle:
            return Wish(tip, np.zeros(2), 0.0)
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
        waits = float(np.linalg.norm(path.point(self._length) - tip)) > self._longest_lag
        speed = 0.0 if waits else speed
        self._length = min(path.length, self._length + speed * interval)
        error = path.point(self._length) - tip
        at_end = path.length - self._length < 1e-6
        self._done = self._done or (at_end and float(np.linalg.norm(error)) < self._tolerance)
        if self._done:
            return Wish(path.point(path.length), np.zeros(2), 1.0)
        if not waits:
            self._correction += self._integral_gain * interval * error
        size = float(np.linalg.norm(self._correction))
        self._correction *= min(1.0, 0.5 * self._speed / size) if size > 0.0 else 1.0
        velocity = speed * path.tangent(self._length) + self._gain * error + self._correction
        return Wish(path.point(self._length), velocity, min(ALMOST, self._length / path.length))
