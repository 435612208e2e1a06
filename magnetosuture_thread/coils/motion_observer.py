"""The needle's motion beside the commanded one, measured from its poses, for the coils to compensate."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.follow_monitor import MotionStep
from magnetosuture_thread.safety import NeedleKinematics
from magnetosuture_thread.safety.motion import limit_pair

Vector = NDArray[np.float64]

GAIN = 12.0  # 1/s; of the velocities, below the rate of a camera's poses
MAX_INTERVAL = 0.2  # s; two poses farther apart say nothing of the motion between them
MAX_GAP = 1.0  # s; of poses, over which what was measured before is kept: a thread goes on pulling
VISIBLE = 6e-5  # m; four times the noise of a displacement between two poses


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

        d' = g (m - c - d),    |d| <= max_speed

    It learns only from motion that can be seen: poses are compared once the middle has moved by `VISIBLE`, or while no
    currents are on, or while the needle is trusted to be tracked. Poses that stand still thus wind up nothing.

    The coils compensate d: with a commanded velocity u, c = u - d. Of a needle that moves at k c, d converges at any
    lateness of the poses where |k - 1| < 1, and at k = 2 at up to 0.2 s.

    Source: disturbance observers of first order, Ohnishi, Shibata and Murakami 1996. Deviation: of velocities, not of
    forces, as inertia has no part. Pure: times come in, in seconds.

    Args:
        needle: its kinematics.
        min_hold: the coils hold their currents for at least this long; for how much longer is not known [s].
        max_speed: of the disturbance that is compensated [m/s].
    """

    def __init__(self, needle: NeedleKinematics, min_hold: float = math.inf, max_speed: float = math.inf) -> None:
        self._needle, self._min_hold, self._max_speed = needle, min_hold, max_speed
        self._velocity = np.zeros(2)
        self._last: tuple[float, Vector, Vector] | None = None  # stamp, middle and chord's direction of the last pose
        self._seen: tuple[float, Vector] | None = None  # the last pose that the needle has visibly moved to
        self._applied: deque[tuple[float, Vector]] = deque()  # what the currents were set for, each with its start

    @property
    def velocity(self) -> Vector:
        """The disturbance in the dish's frame, shape (2,) [m/s]."""
        return self._velocity

    def update(self, tail: Vector, heading: Vector, stamp: float, trusted: bool = False) -> MotionStep | None:
        """Take a measured pose; return the motion since the last one, None where it cannot be compared.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            stamp: when it was measured [s].
            trusted: whether to learn also from a needle that stands still.
        """
        e = self._needle.chord_direction(heading)
        middle = tail + 0.5 * self._needle.chord * e
        last, self._last = self._last, (stamp, middle, e)
        seen = self._seen
        if seen is None or not 0.0 < stamp - seen[0] <= MAX_INTERVAL:
            if last is None or not 0.0 < stamp - last[0] <= MAX_GAP:
                self._velocity = np.zeros(2)
            seen = self._seen = stamp, middle
        elif (applied := self._mean_applied(seen[0], stamp)) is not None:
            interval = stamp - seen[0]
            if trusted or not applied[:2].any() or math.hypot(*(middle - seen[1])) > VISIBLE:
                unexplained = (middle - seen[1]) / interval - applied[:2]
                learnt = self._velocity + min(1.0, GAIN * interval) * (unexplained - self._velocity)
                self._velocity = np.array(limit_pair(float(learnt[0]), float(learnt[1]), self._max_speed))
                self._seen = stamp, middle
        if last is None or not 0.0 < stamp - last[0] <= MAX_INTERVAL:
            return None
        applied = self._mean_applied(last[0], stamp)
        if applied is None:
            return None
        interval, before = stamp - last[0], last[2]
        turn = math.atan2(before[0] * e[1] - before[1] * e[0], float(before @ e))
        return MotionStep(stamp, interval, interval * applied[2:4], interval * applied[4], middle - last[1], turn)

    def apply(self, now: float, applied: Vector, intended: Vector, turn_rate: float) -> None:
        """Register what currents are set for from a time on.

        Args:
            now: time of the stamps' clock [s].
            applied: velocity of the needle's middle that the currents give by the bridge's model, shape (2,) [m/s].
            intended: velocity of the middle that was intended, with the disturbance compensated, shape (2,) [m/s].
            turn_rate: at which the field turns the needle [rad/s].
        """
        self._register(now, np.array([*applied, *intended, turn_rate]))

    def rest(self, now: float) -> None:
        """Register that the currents are zero from a time of the stamps' clock on [s]."""
        self._register(now, np.zeros(5))

    def _register(self, now: float, velocity: Vector) -> None:
        if self._applied and now < self._applied[-1][0]:
            self._applied.clear()  # time was set back
            self._last = self._seen = None
        self._applied.append((now, velocity))
        while len(self._applied) > 1 and self._applied[1][0] < now - MAX_GAP:
            self._applied.popleft()

    def _mean_applied(self, start: float, end: float) -> Vector | None:
        """Return the mean velocity by the currents between two times [m/s]; None where they are not known.

        Before the first currents the needle rests.
        """
        total, until = np.zeros(5), end
        for since, velocity in reversed(self._applied):
            if since < until:
                if velocity[:2].any() and until - since > self._min_hold * (1.0 + 1e-9):
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
        x, y = self._velocity
        return MotionDisturbance(float(e[0] * x + e[1] * y), float(e[0] * y - e[1] * x))
