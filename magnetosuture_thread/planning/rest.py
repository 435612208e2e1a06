"""Notices a needle that rests although it is commanded."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

REST_TIME = 1.0  # s; a needle that is commanded and has not moved for this long rests
REST_WAY = 5e-5  # m; of the tip, which a needle that moves covers in that time
STALL_TIME = 4.0  # s; for which the setpoint may wait for a needle that moves


@dataclass
class RestDetector:
    """Notices a needle that is commanded and rests, by its last poses."""

    travel: float = 0.0  # up to which the setpoint had come, at the stamp `since` [m]
    since: float = math.inf  # [s]
    poses: deque[tuple[float, float, float, float]] = field(default_factory=deque)

    def update(self, stamp: float, middle: Vector, angle: float, lever: float, commanded: bool, travel: float) -> bool:
        """Return whether the needle does not get on: it has rested for `REST_TIME`, or trembles in one place.

        A needle that is held up by a wall, and as long as noise of its angle moves it to and fro, never rests.

        Args:
            stamp: of the pose [s].
            middle: of the chord, shape (2,) [m].
            angle: of the chord [rad].
            lever: half of the chord [m].
            commanded: whether it is to move.
            travel: of the setpoint, which waits for the needle [m].
        """
        if not commanded:
            self.poses.clear()
            self.since = math.inf
            return False
        if travel - self.travel >= REST_WAY or not self.since <= stamp:
            self.travel, self.since = travel, stamp
        elif stamp - self.since > STALL_TIME:
            return True
        if self.poses and stamp < self.poses[-1][0]:
            self.poses.clear()  # time was set back
        self.poses.append((stamp, float(middle[0]), float(middle[1]), lever * angle))
        while len(self.poses) > 2 and self.poses[1][0] <= stamp - REST_TIME:
            self.poses.popleft()
        first = self.poses[0]
        if stamp - first[0] < REST_TIME:
            return False
        return all(math.dist(first[1:], each[1:]) < REST_WAY for each in self.poses)
