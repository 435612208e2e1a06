"""The needle's motion beside the commanded one, measured from its poses, for the coils to compensate."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.safety import NeedleKinematics

Vector = NDArray[np.float64]

GAIN = 12.0  # 1/s; of the velocities, below the rate of a camera's poses
MAX_INTERVAL = 0.2  # s; two poses farther apart say nothing of the motion between them
MAX_GAP = 1.0  # s; of poses, over which what was measured before is kept: a thread goes on pulling
MAX_SPEED = 0.012  # m/s; compensated at most


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
    needle's middle along and across its chord, measured by two poses, and the mean c of the velocity by the currents
    between the times of these poses, the estimate d follows by

        d' = g (m - c - d)

    The coils compensate d: with a commanded velocity u, c = u - d. Of a needle that moves at k c, d converges at any
    lateness of the poses where |k - 1| < 1, and at k = 2 at up to 0.2 s.

    Source: disturbance observers of first order, Ohnishi, Shibata and Murakami 1996. Deviation: of velocities, not of
    forces, as inertia has no part. Pure: times come in, in seconds.

    Args:
        needle: its kinematics.
        min_hold: the coils hold their currents for at least this long; for how much longer is not known [s].
    """

    def __init__(self, needle: NeedleKinematics, min_hold: float = math.inf) -> None:
        self._needle, self._min_hold = needle, min_hold
        self._velocity = np.zeros(2)
        self._last: tuple[float, Vector] | None = None
        self._applied: deque[tuple[float, Vector]] = deque()  # velocities by the currents, each with its start

    def update(self, tail: Vector, heading: Vector, stamp: float) -> None:
        """Take a measured pose.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            stamp: when it was measured [s].
        """
        middle = tail + 0.5 * self._needle.chord * self._needle.chord_direction(heading)
        last, self._last = self._last, (stamp, middle)
        if last is None or not 0.0 < stamp - last[0] <= MAX_INTERVAL:
            if last is None or not 0.0 < stamp - last[0] <= MAX_GAP:
                self._velocity = np.zeros(2)
            return
        interval, applied = stamp - last[0], self._mean_applied(last[0], stamp)
        if applied is not None:
            unexplained = (middle - last[1]) / interval - applied
            self._velocity += min(1.0, GAIN * interval) * (unexplained - self._velocity)

    def apply(self, now: float, heading: Vector, along: float, drift: float) -> None:
        """Register what currents are set for from a time on.

        Args:
            now: time of the stamps' clock [s].
            heading: that the field is set for, at the tail, shape (2,).
            along: velocity along the chord that the currents give, by the bridge's model [m/s].
            drift: the same across it, to the left [m/s].
        """
        e = self._needle.chord_direction(heading)
        self._register(now, np.array([along * e[0] - drift * e[1], along * e[1] + drift * e[0]]))

    def rest(self, now: float) -> None:
        """Register that the currents are zero from a time of the stamps' clock on [s]."""
        self._register(now, np.zeros(2))

    def _register(self, now: float, velocity: Vector) -> None:
        if self._applied and now < self._applied[-1][0]:
            self._applied.clear()  # time was set back
            self._last = None
        self._applied.append((now, velocity))
        while len(self._applied) > 1 and self._applied[1][0] < now - MAX_GAP:
            self._applied.popleft()

    def _mean_applied(self, start: float, end: float) -> Vector | None:
        """Return the mean velocity by the currents between two times [m/s]; None where they are not known.

        Before the first currents the needle rests.
        """
        total, until = np.zeros(2), end
        for since, velocity in reversed(self._applied):
            if since < until:
                if velocity.any() and until - since > self._min_hold * (1.0 + 1e-9):
                    return None  # nobody has set the currents for so long that the coils may have switched off
                total += (until - max(since, start)) * velocity
                until = since
            if since <= start:
                break
        return total / (end - start)

    def disturbance(self, heading: Vector) -> MotionDisturbance:
        """Return what to compensate.

        Args:
            heading: unit vector at the tail, shape (2,).
        """
        e = self._needle.chord_direction(heading)
        x, y = self._velocity * min(1.0, MAX_SPEED / max(math.hypot(*self._velocity), 1e-12))
        return MotionDisturbance(float(e[0] * x + e[1] * y), float(e[0] * y - e[1] * x))
