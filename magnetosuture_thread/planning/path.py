"""A planned path of the needle's body: poses of the middle of its chord, smoothed within the clearance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from magnetosuture_thread.compiled import compiled_without_gil
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.lattice import ClearanceMap, body_clearance

SPACING = 1.0e-4  # m; of the tip's way between two poses
PASSES = 400  # of the smoothing
PULL = 0.4  # share by which a pose moves towards the middle of its neighbours in a pass
PREFERRED = 5e-4  # m; beyond the required clearance, more is not worth a longer way
GIVE = 1e-6  # m; by which the clearance may fall in a pass, so that a corner of the lattice can be rounded
FILTER = 4.0  # poses; width of the last filter
ALIGN = 0.3  # share by which its heading turns to the way


@dataclass(frozen=True, eq=False)
class BodyPath:
    """Poses that the needle's body is to go through, one after the other.

    Attributes:
        middles: of the chord, shape (m, 2) [m].
        angles: of the chord against the x axis, unwrapped, shape (m,) [rad].
        lever: half of the needle's chord [m].
        leeway: by how much the body may be off each pose before it is as close as it may be, shape (m,) [m].
        ends: ways of the tip at which the goals on the path are reached, rising, shape (g,) [m].
    """

    middles: Points
    angles: NDArray[np.float64]
    lever: float
    leeway: NDArray[np.float64]
    ends: NDArray[np.float64]

    @cached_property
    def travel(self) -> NDArray[np.float64]:
        """Way of the tip in the needle's frame up to each pose, |dx| + lever |dangle| summed up, shape (m,) [m]."""
        steps = np.hypot(*np.diff(self.middles, axis=0).T) + self.lever * np.abs(np.diff(self.angles))
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length(self) -> float:
        """Way of the tip from the first pose to the last [m]."""
        return float(self.travel[-1])

    def at(self, travel: float) -> tuple[NDArray[np.float64], float]:
        """Return middle and angle at a way of the tip."""
        x, y = (float(np.interp(travel, self.travel, column)) for column in self.middles.T)
        return np.array([x, y]), float(np.interp(travel, self.travel, self.angles))

    def leeway_at(self, travel: float) -> float:
        """Return the leeway at a way of the tip [m]."""
        return float(np.interp(travel, self.travel, self.leeway))


def smooth_path(
    states: Points,
    ends: NDArray[np.int64],
    lever: float,
    body: Points,
    required: float,
    margin: float,
    near: ClearanceMap,
) -> BodyPath:
    """Return the path through the states of the lattice, its corners rounded as far as the clearance allows.

    Args:
        states: x, y [m] and direction [rad] of each, shape (k, 3); the first and the last stay.
        ends: index of the state at which each goal is reached, shape (g,).
        lever: half of the needle's chord [m].
        body: points of the needle's axis, see `body_clearance`.
        required: clearance of the body [m].
        margin: how much more than that is kept on the path [m].
        near: distances from wall and shapes.
    """
    coarse = BodyPath(states[:, :2], np.unwrap(states[:, 2]), lever, np.zeros(len(states)), np.zeros(0))
    count = max(2, math.ceil(coarse.length / SPACING) + 1)
    at = np.linspace(0.0, coarse.length, count)
    dense = np.column_stack(
        [
            *(np.interp(at, coarse.travel, column) for column in coarse.middles.T),
            np.interp(at, coarse.travel, coarse.angles),
        ]
    )
    _relax(dense, body, required + margin, required + margin + PREFERRED, near)
    dense = _filtered(dense, body, required + margin, near)
    leeway = np.array([body_clearance(x, y, angle, body, near) for x, y, angle in dense]) - required
    smooth = BodyPath(dense[:, :2].copy(), dense[:, 2].copy(), lever, np.maximum(leeway, 0.0), np.zeros(0))
    # The poses of a goal have moved with the smoothing, but are still those with the same numbers.
    return replace(smooth, ends=np.interp(coarse.travel[ends], at, smooth.travel))


def turning_points(middles: Points, angles: NDArray[np.float64], lever: float) -> list[tuple[int, float]]:
    """Return the poses at which a stretch ends that is driven in one sense, and that sense: 1 ahead, -1 back."""
    steps, turns = np.diff(middles, axis=0), np.diff(angles)
    between = 0.5 * (angles[1:] + angles[:-1])
    drive = steps[:, 0] * np.cos(between) + steps[:, 1] * np.sin(between)
    # A turn on the spot is of no sense.
    driven = np.abs(drive) > np.maximum(1e-9, 0.2 * (np.hypot(*steps.T) + lever * np.abs(turns)))
    found, sense = [], 0.0
    for k in np.flatnonzero(driven):
        here = math.copysign(1.0, drive[k])
        if sense and here != sense:
            found.append((int(k), sense))
        sense = here
    return [*found, (len(middles) - 1, sense or 1.0)]


def _filtered(poses: Points, body: Points, required: float, near: ClearanceMap) -> Points:
    """Return the poses without the kinks of the lattice, each stretch on its own, where the body stays clear."""
    smooth, first = poses.copy(), 0
    for last, _ in turning_points(poses[:, :2], poses[:, 2], 0.0):
        stretch = poses[first : last + 1]
        reach = min(int(4.0 * FILTER), len(stretch) - 1)
        if reach > 1:
            padded = np.pad(stretch, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
            smooth[first : last + 1] = gaussian_filter1d(padded, FILTER, axis=0)[reach:-reach]
        first = last
    near_before = [body_clearance(x, y, angle, body, near) for x, y, angle in poses]
    for k, (x, y, angle) in enumerate(smooth):
        if body_clearance(x, y, angle, body, near) < min(required, near_before[k]):
            smooth[k] = poses[k]
    return np.asarray(smooth)


@compiled_without_gil
def _relax(poses: Points, body: Points, required: float, preferred: float, near: ClearanceMap) -> None:
    """Move each pose to the middle of its neighbours, and turn it along the way, where the clearance allows.

    A clearance may not fall below the one that is preferred; where it is less already, it may not fall at all.
    """
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
            kept = max(required, min(preferred, body_clearance(x, y, angle, body, near)) - GIVE)
            if body_clearance(nx, ny, turned, body, near) >= kept:
                poses[k, 0], poses[k, 1], poses[k, 2] = nx, ny, turned
            elif body_clearance(x, y, turned, body, near) >= kept:
                poses[k, 2] = turned
            elif body_clearance(nx, ny, angle, body, near) >= kept:
                poses[k, 0], poses[k, 1] = nx, ny
