"""The needle's motion beside the commanded one, measured from its poses, for the coils to compensate."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.safety import NeedleKinematics

Vector = NDArray[np.float64]

GAIN = 8.0  # 1/s; of the velocities, well below the rate and the delay of a camera's poses
MAX_INTERVAL = 0.2  # s; two poses farther apart say nothing of the motion between them
MAX_GAP = 1.0  # s; of poses, over which what was measured before is kept: a thread goes on pulling
MAX_SPEED = 0.006  # m/s; compensated at most


class MotionDisturbance(NamedTuple):
    """Motion of the needle that its currents do not explain.

    Attributes:
        along: velocity of the whole needle along its chord [m/s].
        drift: velocity of the whole needle across its chord, to the left [m/s].
    """

    along: float = 0.0
    drift: float = 0.0

    def velocity(self, e: Vector) -> Vector:
        """Return the velocity of the whole needle for the unit vector from tail to tip, shapes (2,) [m/s]."""
        return np.array([self.along * e[0] - self.drift * e[1], self.along * e[1] + self.drift * e[0]])


class MotionObserver:
    """Estimates the needle's motion that its currents, by the bridge's model of coils and needle, do not explain.

    A thread that trails at an angle pulls the needle aside, and a longer one slows it. With the velocity m of the
    needle's middle along and across its chord, measured by two poses, and that of the applied currents c, the estimate
    d follows by

        d' = g (m - c - d)

    Source: disturbance observers of first order, Ohnishi, Shibata and Murakami 1996. Deviation: of velocities, not of
    forces, as inertia has no part. Pure: times come in, in seconds.

    Args:
        needle: its kinematics.
    """

    def __init__(self, needle: NeedleKinematics) -> None:
        self._needle = needle
        self._velocity = np.zeros(2)
        self._last: tuple[float, Vector, Vector] | None = None
        self._applied, self._duration = np.zeros(2), 0.0

    def update(self, tail: Vector, heading: Vector, stamp: float) -> None:
        """Take a measured pose.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            stamp: when it was measured [s].
        """
        e = self._needle.chord_direction(heading)
        middle = tail + 0.5 * self._needle.chord * e
        last, self._last = self._last, (stamp, middle, e)
        applied = self._applied / self._duration if self._duration > 0.0 else np.zeros(2)
        self._applied, self._duration = np.zeros(2), 0.0
        if last is None or not 0.0 < stamp - last[0] <= MAX_INTERVAL:
            if last is None or not 0.0 < stamp - last[0] <= MAX_GAP:
                self._velocity = np.zeros(2)
            return
        interval, moved = stamp - last[0], middle - last[1]
        self._velocity += min(1.0, GAIN * interval) * (moved / interval - applied - self._velocity)

    def apply(self, heading: Vector, along: float, drift: float, duration: float) -> None:
        """Register what currents are set for.

        Args:
            heading: that the field is set for, at the tail, shape (2,).
            along: velocity along the chord that the currents give, by the bridge's model [m/s].
            drift: the same across it, to the left [m/s].
            duration: since the last currents [s].
        """
        e = self._needle.chord_direction(heading)
        self._applied += duration * np.array([along * e[0] - drift * e[1], along * e[1] + drift * e[0]])
        self._duration += duration

    def rest(self, duration: float) -> None:
        """Register that the currents are zero for a time [s]."""
        self._duration += duration

    def disturbance(self, heading: Vector) -> MotionDisturbance:
        """Return what to compensate.

        Args:
            heading: unit vector at the tail, shape (2,).
        """
        e = self._needle.chord_direction(heading)
        x, y = self._velocity * min(1.0, MAX_SPEED / max(math.hypot(*self._velocity), 1e-12))
        return MotionDisturbance(float(e[0] * x + e[1] * y), float(e[0] * y - e[1] * x))
