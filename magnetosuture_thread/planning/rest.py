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


@dataclass
class RestDetector:
    """Notices a needle that is commanded and rests, by its last poses."""

    poses: deque[tuple[float, float, float, float]] = field(default_factory=deque)

    def update(self, stamp: float, middle: Vector, angle: float, lever: float, commanded: bool) -> bool:
        """Return whether the needle has rested for `REST_TIME`, while it was commanded."""
        if not commanded:
            self.poses.clear()
            return False
        self.poses.append((stamp, float(middle[0]), float(middle[1]), lever * angle))
        while len(self.poses) > 2 and self.poses[1][0] <= stamp - REST_TIME:
            self.poses.popleft()
        first = self.poses[0]
        if stamp - first[0] < REST_TIME:
            return False
        return all(math.dist(first[1:], each[1:]) < REST_WAY for each in self.poses)
