"""Decides whether a walk from a needle's tail has joined a line that passes there, and not a thread that leaves it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.vision.sampling import middle, sample
from magnetosuture_thread.vision.thread.ridge import Ridge

TAIL_PX = 3.0  # from the tail, up to which its own edge shows
START_PX = 12.0  # from there on, in which a thread that leaves the tail is visible
NEXT_PX = 50.0  # from the tail, up to which it is compared with
START_SHARE, MAX_FAINT = 0.3, 0.4  # of the strength there; share of the start that may be fainter
MIN_VISIBLE = 10  # places there that are not hidden, by which the two are compared
JOINT_PX = 24.0  # from the tail, up to which a walk may join a line
# In pixels of the ridge, which is shrunk where the thread is wide:
AHEAD_PX = 8.0  # of the walk beyond a joint, that give the line's direction
BACK_FIRST_PX, BACK_LAST_PX = 4.0, 22.0  # from a joint, between which the line is looked for the other way
BACK_SHARE = 0.6  # of the usual strength, that it has at each of its points
APART_PX = 4.0  # from the walk, at which the far end of it is another line
BESIDE_PX = 2.5  # beyond a thread's edge, from where on it is another line
RETURN_PX = 100.0  # from the tail, after which a walk may pass it again as a thread does
STEP_PX = 2.0
_BENDS = np.linspace(-0.045, 0.045, 7)  # 1/px, of a thread of 250 / m and a little more
_TURNS = np.linspace(-0.25, 0.25, 5)  # rad, that the line's direction may differ from the walk's


def joins_passing_line(points: np.ndarray, ridge: Ridge, origin: tuple[int, int], half_width: float = 0.0) -> bool:
    """Say whether a walk follows a line that does not begin at the tail.

    A thread that leaves the tail is visible from there on as well as later, and does not go on the other way. So a line
    passes if bare floor lies between the tail and it, or if it goes on smoothly backwards from where the walk joins it.

    Args:
        points: vertices of the walk from the tail on, shape (m, 2) [px].
        ridge: that was followed.
        origin: of the ridge in the picture [px].
        half_width: of the thread, as far as it is known [px].
    """
    along = arc_lengths(points)
    if along[-1] < JOINT_PX + ridge.scale * AHEAD_PX:
        return False
    at = np.arange(TAIL_PX, min(NEXT_PX, float(along[-1])), 1.0)
    near = _Near.around(points[0], ridge, origin)
    strengths = near.strengths(_points_at(points, along, at))
    start, following = (part[~np.isnan(part)] for part in np.split(strengths, [int(START_PX)]))
    if len(following) < MIN_VISIBLE:  # as of a pale thread, which looks like the lamp's reflection
        return False
    usual = middle(following)
    if len(start) and np.mean(start < START_SHARE * usual) > MAX_FAINT:
        return True
    scale = float(ridge.scale)
    joints = np.arange(0.0, JOINT_PX, STEP_PX)
    begin, ahead = (_points_at(points, along, joints + beyond) for beyond in (0.0, scale * AHEAD_PX))
    own = np.arange(0.0, float(along[-1]), STEP_PX)
    apart = max(scale * APART_PX, half_width + BESIDE_PX)  # Within a wide thread's edges all is its own.
    return bool(_goes_back(*near.arrays, usual, apart, joints, begin, ahead, own, _points_at(points, along, own)))


def _points_at(points: np.ndarray, along: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the points at lengths of a polyline whose vertices lie at known ones; see `points_at`."""
    return np.column_stack([np.interp(lengths, along, each) for each in points.T])


@dataclass(frozen=True)
class _Near:
    """How strong a ridge is around each pixel near the tail.

    Attributes:
        strength: the greatest within a pixel, shape (rows, columns), uint8.
        hidden: see `Ridge`.
        geometry: the first pixel's column and row in the ridge; its scale and the origin in the picture, the factor of
            what is hidden, and the strength where nothing is, shape (7,).
    """

    strength: np.ndarray
    hidden: np.ndarray
    geometry: np.ndarray

    @classmethod
    def around(cls, tail: np.ndarray, ridge: Ridge, origin: tuple[int, int]) -> _Near:
        """Return the part of a ridge that is looked at around a tail [px]."""
        scale = ridge.scale
        reach = round((NEXT_PX + JOINT_PX) / scale + BACK_LAST_PX + AHEAD_PX)
        at = np.round((tail - origin - 0.5 * (scale - 1)) / scale).astype(int)
        rows, columns = ridge.strength.shape
        left, top = (max(0, min(int(low) - reach, side - 2)) for low, side in zip(at, (columns, rows), strict=True))
        right, bottom = (max(2, int(high) + reach) for high in at)
        part = cv2.dilate(ridge.strength[top:bottom, left:right], np.ones((3, 3), np.uint8))
        geometry = np.array([left, top, scale, *origin, ridge.factor, ridge.noise], np.float64)
        return cls(np.asarray(part), ridge.hidden, geometry)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What compiled code takes."""
        return self.strength, self.hidden, self.geometry

    def strengths(self, points: np.ndarray) -> np.ndarray:
        """Return how strong the ridge is around points of the picture; NaN where it is hidden."""
        values = np.empty(len(points))
        _strengths(*self.arrays, points, values)
        return values


@compiled
def _strength(strength, hidden, geometry, u, v):
    """Return how strong a ridge is around a point of the picture; NaN where it is hidden."""
    scale, factor = geometry[2], int(geometry[5])
    u, v = (u - geometry[3] - 0.5 * (scale - 1.0)) / scale, (v - geometry[4] - 0.5 * (scale - 1.0)) / scale
    column = min(max(int(np.floor(u + 0.5)) // factor, 0), hidden.shape[1] - 1)
    row = min(max(int(np.floor(v + 0.5)) // factor, 0), hidden.shape[0] - 1)
    if hidden[row, column] != 0:
        return np.nan
    return sample(strength, u - geometry[0], v - geometry[1]) - geometry[6]


@compiled
def _strengths(strength, hidden, geometry, points, values):
    """Fill in how strong a ridge is around points of the picture; NaN where it is hidden."""
    for index in range(len(points)):
        values[index] = _strength(strength, hidden, geometry, points[index, 0], points[index, 1])


@compiled
def _goes_back(strength, hidden, geometry, usual, apart, joints, begin, ahead, along, points):
    """Say whether a line goes on backwards from one of the first places of a walk, off the walk itself.

    Arcs are tried from each joint, at `begin`, away from the walk's direction there, towards `ahead`. The walk may turn
    round and come back on the line that it joined: only its way there, and later ones, are its own; `points` are those
    of the walk at the lengths `along`. What is no farther than `apart` from these [px] is the walk's own.
    """
    scale = geometry[2]
    count = round((BACK_LAST_PX - BACK_FIRST_PX) / STEP_PX)
    arc = np.empty((count, 2))
    for joint in range(len(joints)):
        u, v = begin[joint, 0], begin[joint, 1]
        angle = math.atan2(v - ahead[joint, 1], u - ahead[joint, 0])
        for turn in _TURNS:
            for bend in _BENDS:
                visible = True
                for index in range(count):
                    back = BACK_FIRST_PX + STEP_PX * index
                    turned = angle + turn + 0.5 * bend * back
                    arc[index, 0], arc[index, 1] = (
                        u + scale * back * math.cos(turned),
                        v + scale * back * math.sin(turned),
                    )
                    if not _strength(strength, hidden, geometry, arc[index, 0], arc[index, 1]) > BACK_SHARE * usual:
                        visible = False  # also where it is hidden
                        break
                if not visible:
                    continue
                nearest = np.inf
                for place in range(len(along)):
                    if along[place] > joints[joint] and along[place] < RETURN_PX:
                        continue
                    for index in range(count // 2, count):
                        x, y = arc[index, 0] - points[place, 0], arc[index, 1] - points[place, 1]
                        nearest = min(nearest, x * x + y * y)
                if nearest > apart * apart:
                    return True
    return False
