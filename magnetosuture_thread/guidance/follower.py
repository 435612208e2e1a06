"""Path-following controller for the needle's tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.needle_arc import needle_chord
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.guidance.path import SmoothPath

Vector = NDArray[np.float64]

MAX_INTERVAL = 0.1  # s; after a longer gap between poses the setpoint has waited and does not run ahead
MAX_PROGRESS_UNFINISHED = 0.999  # the path is done when the tip has arrived, not the setpoint ahead of it


@dataclass(frozen=True)
class FollowerCommand:
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

    with the setpoint's speed w, which has a trapezoidal profile. The setpoint moves only while poses arrive,
    and waits while the tip is farther from it than `max_lag`, so it does not run away from a needle that
    does not move. The path begins along the needle, where its tip is when `settle` is over.

    Args:
        waypoints: of the path after the tip's initial position, shape (m, 2) [m].
        speed: w [m/s].
        acceleration: [m/s^2].
        gain: k [1/s].
        integral_gain: k_i [1/s^2]; compensates drag that the coil model does not include.
        max_lag: maximum distance from tip to setpoint while the setpoint moves [m].
        tolerance: the path is done once the tip was this close to its end [m].
        settle: time after the first pose without motion [s].
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
        max_lag: float,
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
        self._max_lag = max_lag
        self._tolerance = tolerance
        self._settle = settle
        self._first: float | None = None
        self._done = False
        chord, rotation = needle_chord(needle_length, needle_curvature)
        self._to_tip = chord * rotation
        self._path: SmoothPath | None = None
        self._stamp = 0.0
        self._length = 0.0
        self._correction = np.zeros(2)

    def compute_command(self, stamp: float, tail: Vector, heading: Vector) -> FollowerCommand:
        """Compute the velocity command for a needle pose.

        Args:
            stamp: of the pose [s].
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).

        Raises:
            InvalidInputError: waypoints and first pose do not define a path.
        """
        tip = tail + self._to_tip @ heading
        self._first = stamp if self._first is None else self._first
        if self._path is None and stamp - self._first < self._settle:
            return FollowerCommand(tip, np.zeros(2), 0.0)
        if self._path is None:
            self._path = SmoothPath(
                np.vstack([tip, self._waypoints]), self._to_tip @ heading / np.linalg.norm(tip - tail)
            )
            self._stamp = stamp
        path = self._path
        interval = min(max(stamp - self._stamp, 0.0), MAX_INTERVAL)
        self._stamp = stamp
        remaining = path.length - self._length
        # Trapezoidal profile: the setpoint starts from rest and can still stop at the end.
        max_from_rest = np.sqrt(2.0 * self._acceleration * (self._length + 0.5 * self._acceleration * interval**2))
        speed = float(min(self._speed, max_from_rest, np.sqrt(2.0 * self._acceleration * max(remaining, 0.0))))
        waiting = float(np.linalg.norm(path.point(self._length) - tip)) > self._max_lag
        speed = 0.0 if waiting else speed
        self._length = min(path.length, self._length + speed * interval)
        error = path.point(self._length) - tip
        at_end = path.length - self._length < 1e-6
        self._done = self._done or (at_end and float(np.linalg.norm(error)) < self._tolerance)
        if self._done:
            return FollowerCommand(path.point(path.length), np.zeros(2), 1.0)
        if not waiting:
            self._correction += self._integral_gain * interval * error
        size = float(np.linalg.norm(self._correction))
        self._correction *= min(1.0, 0.5 * self._speed / size) if size > 0.0 else 1.0
        velocity = speed * path.tangent(self._length) + self._gain * error + self._correction
        return FollowerCommand(
            path.point(self._length), velocity, min(MAX_PROGRESS_UNFINISHED, self._length / path.length)
        )
