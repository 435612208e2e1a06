"""Path tracking: which tip velocity takes the needle's body along planned poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.path import BodyPath, turning_points

Vector = NDArray[np.float64]

GAIN = 6.0  # 1/s; on the error of the leading end
INTEGRAL_GAIN = 6.0  # 1/s^2; for what thread and coil model take of the velocity
MAX_CORRECTION = 1.0  # of the allowed speed, by the integral
ACCELERATION = 0.008  # m/s^2
MAX_LAG = 4e-4  # m; the setpoint waits for a needle that is farther from it
ARRIVED = 1.5e-4  # m; an end of the path, or a change of direction on it, is reached this close
MAX_INTERVAL = 0.2  # s; after a longer gap between poses the setpoint has waited


@dataclass(frozen=True)
class TrackingCommand:
    """What moves the needle along its path.

    Attributes:
        velocity: of the tip, shape (2,) [m/s].
        travel: way of the tip along the path, up to the setpoint [m].
        error: of the leading end from its setpoint [m].
        done: whether the path's end is reached.
    """

    velocity: Vector
    travel: float
    error: float
    done: bool


class PathTracker:
    """Tracks a path of poses by its leading end: the tip where it is driven ahead, the tail where it is driven back.

        v = w dp/ds + k e + c,    e = p(s) - x_end,    dc/dt = k_i e,    |c| <= the allowed speed

    with the leading end p(s) of the planned poses, and the setpoint's speed w, which has a trapezoidal profile between
    the places where the needle changes between ahead and back. The setpoint waits while the end is farther from it than
    `MAX_LAG`. An end of the needle can be given a velocity in any direction, and the rest of the body follows it, as a
    trailer follows. The tip's velocity for that of the tail is its mirror image about the chord.

    Args:
        path: to track.
    """

    def __init__(self, path: BodyPath) -> None:
        self.path = path
        self.travel = 0.0
        turning = turning_points(path.middles, path.angles, path.lever)
        self._stops = [(float(path.travel[index]), sense) for index, sense in turning]
        self._stamp: float | None = None
        self._speed = 0.0
        self._correction = np.zeros(2)
        along = path.lever * np.column_stack([np.cos(path.angles), np.sin(path.angles)])
        self._ends = {1.0: path.middles + along, -1.0: path.middles - along}

    @property
    def leeway(self) -> float:
        """Leeway of the path where the setpoint is [m]."""
        return self.path.leeway_at(self.travel)

    def compute_command(
        self, stamp: float, middle: Vector, angle: float, speed: float, slowdown: float = 1.0
    ) -> TrackingCommand:
        """Compute the command for a pose.

        Args:
            stamp: of the pose [s].
            middle: of the chord, shape (2,) [m].
            angle: of the chord [rad].
            speed: of the tip that is allowed now [m/s].
            slowdown: factor on every velocity that the bridge applies.
        """
        interval = 0.0 if self._stamp is None else stamp - self._stamp
        interval = interval if 0.0 < interval <= MAX_INTERVAL else 0.0
        self._stamp = stamp
        e = np.array([math.cos(angle), math.sin(angle)])
        stop, sense = self._stops[0]
        end = middle + sense * self.path.lever * e
        error = self._at(sense, self.travel) - end
        size = math.hypot(*error)
        waits = size > MAX_LAG
        braked = math.sqrt(2.0 * ACCELERATION * max(stop - self.travel, 0.0))
        self._speed = 0.0 if waits else min(self._speed + ACCELERATION * interval, speed, braked)
        self.travel = min(stop, self.travel + slowdown * self._speed * interval)
        if stop - self.travel < 1e-6 and size < ARRIVED:
            self._speed, self._correction = 0.0, np.zeros(2)
            if len(self._stops) == 1:
                return TrackingCommand(np.zeros(2), self.path.length, size, True)
            self._stops.pop(0)
        if interval > 0.0 and not waits:
            self._correction = self._correction + INTEGRAL_GAIN * interval * error
            limit = MAX_CORRECTION * speed / max(math.hypot(*self._correction), 1e-12)
            self._correction = self._correction * min(1.0, limit)
        ahead = self._at(sense, min(stop, self.travel + 5e-5)) - self._at(sense, self.travel)
        way = math.hypot(*ahead)
        tangent = ahead / way if way > 0.0 else np.zeros(2)
        velocity = self._speed * tangent + GAIN * error + self._correction
        if sense < 0.0:  # of the tail; that of the tip turns the other way
            velocity = 2.0 * float(velocity @ e) * e - velocity
        return TrackingCommand(velocity, self.travel, size, False)

    def _at(self, sense: float, travel: float) -> Vector:
        """Return the leading end of the planned pose at a way of the tip, shape (2,) [m]."""
        ends: Points = self._ends[sense]
        return np.array([np.interp(travel, self.path.travel, column) for column in ends.T])
