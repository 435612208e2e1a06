"""Decides whether a walk from a needle's tail has joined a line that passes there, and not a thread that leaves it."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.vision.thread.ridge import Ridge

TAIL_PX = 3.0  # from the tail, up to which its own edge shows
START_PX = 12.0  # from there on, in which a thread that leaves the tail is visible
NEXT_PX = 50.0  # from the tail, up to which it is compared with
START_SHARE, MAX_FAINT = 0.3, 0.4  # of the strength there; share of the start that may be fainter
JOINT_PX = 24.0  # from the tail, up to which a walk may join a line
# In pixels of the ridge, which is shrunk where the thread is wide:
AHEAD_PX = 8.0  # of the walk beyond a joint, that give the line's direction
BACK_FIRST_PX, BACK_LAST_PX = 4.0, 22.0  # from a joint, between which the line is looked for the other way
BACK_SHARE = 0.6  # of the usual strength, that it has at each of its points
APART_PX = 4.0  # from the walk, at which the far end of it is another line
RETURN_PX = 100.0  # from the tail, after which a walk may pass it again as a thread does
STEP_PX = 2.0
_BENDS = np.linspace(-0.045, 0.045, 7)  # 1/px, of a thread of 250 / m and a little more
_TURNS = np.linspace(-0.25, 0.25, 5)  # rad, that the line's direction may differ from the walk's


def joins_passing_line(points: np.ndarray, ridge: Ridge, origin: tuple[int, int]) -> bool:
    """Say whether a walk follows a line that does not begin at the tail.

    A thread that leaves the tail is visible from there on as well as later, and does not go on the other way. So a line
    passes if bare floor lies between the tail and it, or if it goes on smoothly backwards from where the walk joins it.

    Args:
        points: vertices of the walk from the tail on, shape (m, 2) [px].
        ridge: that was followed.
        origin: of the ridge in the picture [px].
    """
    along = arc_lengths(points)
    if along[-1] < JOINT_PX + ridge.scale * AHEAD_PX:
        return False
    at = np.arange(TAIL_PX, min(NEXT_PX, float(along[-1])), 1.0)
    strengths = _strengths(ridge, points_at(points, at), origin)
    start, following = (part[~np.isnan(part)] for part in np.split(strengths, [int(START_PX)]))
    if not len(following):
        return False
    usual = float(np.median(following))
    if len(start) and np.mean(start < START_SHARE * usual) > MAX_FAINT:
        return True
    return _goes_back(points, float(along[-1]), ridge, origin, usual)


def _goes_back(points: np.ndarray, length: float, ridge: Ridge, origin: tuple[int, int], usual: float) -> bool:
    """Say whether a line goes on backwards from one of the first places of a walk, off the walk itself."""
    scale = float(ridge.scale)
    joints = np.arange(0.0, JOINT_PX, STEP_PX)
    begin, ahead = points_at(points, joints), points_at(points, joints + scale * AHEAD_PX)
    angles = np.arctan2(*(begin - ahead).T[::-1])
    back = np.arange(BACK_FIRST_PX, BACK_LAST_PX, STEP_PX)
    # Arcs from each joint, shape (joints, turns, bends, points).
    turned = angles[:, None, None, None] + _TURNS[:, None, None] + 0.5 * _BENDS[:, None] * back
    way = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
    arcs = begin[:, None, None, None] + scale * back[:, None] * way
    strengths = _strengths(ridge, arcs.reshape(-1, 2), origin).reshape(arcs.shape[:-1])
    visible = np.nan_to_num(strengths, nan=-np.inf).min(axis=-1) > BACK_SHARE * usual
    if not visible.any():
        return False
    # The walk may turn round and come back on the line that it joined: only its way there, and later ones, are its own.
    at = np.arange(0.0, length, STEP_PX)
    own = points_at(points, at)
    ends = arcs[visible][:, len(back) // 2 :]
    others = (at > joints[np.nonzero(visible)[0]][:, None]) & (at < RETURN_PX)
    apart = np.linalg.norm(ends[:, :, None] - own, axis=-1).min(axis=1)
    apart[others] = np.inf
    return bool((apart.min(axis=1) > scale * APART_PX).any())


def _strengths(ridge: Ridge, points: np.ndarray, origin: tuple[int, int]) -> np.ndarray:
    """Return how strong a ridge is around points of the picture; NaN where it is hidden."""
    at = (points - origin - 0.5 * (ridge.scale - 1)) / ridge.scale
    u, v = at.astype(np.float32).T
    near = cv2.dilate(ridge.strength, np.ones((3, 3), np.uint8))
    strengths = cv2.remap(near, u[None], v[None], cv2.INTER_LINEAR)[0].astype(float) - ridge.noise
    rows, columns = ridge.hidden.shape
    column, row = (np.round(each).astype(int) // ridge.factor for each in (u, v))
    hidden = ridge.hidden[row.clip(0, rows - 1), column.clip(0, columns - 1)] > 0
    strengths[hidden] = np.nan
    return strengths
