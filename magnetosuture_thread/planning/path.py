"""A planned path of the needle's body: poses of its pivot, smoothed within the clearance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.clearance_map import ClearanceMap, body_clearance

SPACING = 1.0e-4  # m; of the tip's way between two poses
PASSES = 400  # of the smoothing
PULL = 0.4  # share by which a pose moves towards the middle of its neighbours in a pass
ALIGN = 0.3  # share by which its heading turns to the way


@dataclass(frozen=True, eq=False)
class BodyPath:
    """Poses that the needle's body is to go through, one after the other.

    Attributes:
        pivots: points of the chord about which the needle turns, shape (m, 2) [m].
        angles: of the chord against the x axis, unwrapped, shape (m,) [rad].
        lever: from the pivot to the tip [m].
        room: by how much the body may be off each pose before it is as close as it may be, shape (m,) [m].
    """

    pivots: Points
    angles: NDArray[np.float64]
    lever: float
    room: NDArray[np.float64]

    @cached_property
    def travel(self) -> NDArray[np.float64]:
        """Way of the tip in the needle's frame up to each pose, |dx| + lever |dangle| summed up, shape (m,) [m]."""
        steps = np.hypot(*np.diff(self.pivots, axis=0).T) + self.lever * np.abs(np.diff(self.angles))
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length(self) -> float:
        """Way of the tip from the first pose to the last [m]."""
        return float(self.travel[-1])

    def at(self, travel: float) -> tuple[NDArray[np.float64], float]:
        """Return pivot and angle at a way of the tip."""
        x, y = (float(np.interp(travel, self.travel, column)) for column in self.pivots.T)
        return np.array([x, y]), float(np.interp(travel, self.travel, self.angles))

    def room_at(self, travel: float) -> float:
        """Return the room at a way of the tip [m]."""
        return float(np.interp(travel, self.travel, self.room))

    def joined(self, other: BodyPath) -> BodyPath:
        """Return the path that goes on along another one, which begins where this one ends."""
        turns = round((self.angles[-1] - other.angles[0]) / (2.0 * math.pi)) * 2.0 * math.pi
        return BodyPath(
            np.vstack([self.pivots, other.pivots[1:]]),
            np.concatenate([self.angles, other.angles[1:] + turns]),
            self.lever,
            np.concatenate([self.room, other.room[1:]]),
        )


def smooth_path(
    states: Points, lever: float, body: Points, required: float, margin: float, near: ClearanceMap
) -> BodyPath:
    """Return the path through the states of the lattice, its corners rounded as far as the clearance allows.

    Args:
        states: x, y [m] and direction [rad] of each, shape (k, 3); the first and the last stay.
        lever: from the pivot to the tip [m].
        body: points of the needle's axis, see `body_clearance`.
        required: clearance of the body [m].
        margin: how much more than that is kept on the path [m].
        near: distances from wall and shapes.
    """
    coarse = BodyPath(states[:, :2], np.unwrap(states[:, 2]), lever, np.zeros(len(states)))
    count = max(2, int(math.ceil(coarse.length / SPACING)) + 1)
    at = np.linspace(0.0, coarse.length, count)
    dense = np.column_stack(
        [*(np.interp(at, coarse.travel, column) for column in coarse.pivots.T), np.interp(at, coarse.travel, coarse.angles)]
    )
    _relax(dense, lever, body, required + margin, near)
    room = np.array([body_clearance(x, y, angle, body, near) for x, y, angle in dense]) - required
    return BodyPath(dense[:, :2].copy(), dense[:, 2].copy(), lever, np.maximum(room, 0.0))


@compiled
def _relax(poses: Points, lever: float, body: Points, required: float, near: ClearanceMap) -> None:
    """Move each pose to the middle of its neighbours, and turn it along the way, where its body stays clear."""
    count = len(poses)
    for _ in range(PASSES):
        for k in range(1, count - 1):
            x, y, angle = poses[k, 0], poses[k, 1], poses[k, 2]
            nx = x + PULL * (0.5 * (poses[k - 1, 0] + poses[k + 1, 0]) - x)
            ny = y + PULL * (0.5 * (poses[k - 1, 1] + poses[k + 1, 1]) - y)
            turned = angle + PULL * (0.5 * (poses[k - 1, 2] + poses[k + 1, 2]) - angle)
            wx, wy = poses[k + 1, 0] - poses[k - 1, 0], poses[k + 1, 1] - poses[k - 1, 1]
            way = math.hypot(wx, wy)
            if way > 0.0:
                # Ahead or back, whichever is nearer to how it is headed; the less it goes, the less this says.
                off = (math.atan2(wy, wx) - turned + 0.5 * math.pi) % math.pi - 0.5 * math.pi
                turned += ALIGN * min(1.0, way / (2.0 * SPACING)) * off
            if body_clearance(nx, ny, turned, body, near) >= required:
                poses[k, 0], poses[k, 1], poses[k, 2] = nx, ny, turned
            elif body_clearance(x, y, turned, body, near) >= required:
                poses[k, 2] = turned
            elif body_clearance(nx, ny, angle, body, near) >= required:
                poses[k, 0], poses[k, 1] = nx, ny
