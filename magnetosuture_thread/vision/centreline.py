"""Finds the thread's centreline: a walk along the dark ridge that starts at the needle's tail."""

from __future__ import annotations

import math

import cv2
import numpy as np

from magnetosuture_thread.vision.needle import SeenNeedle

STEP_PX = 2.0
GAP_PX = 10.0  # the walk goes straight on over a gap of this length
WEAK = 0.3  # of the ridge's usual strength: below, there is no thread
FAINTEST = 6.0  # grey levels; a ridge fainter than this is noise
START_PX = 9.0  # radius of the circle around the tail on which the thread is looked for
STRAIGHT_STEPS = 4  # whose mean direction is kept over a gap
MEMORY = 0.05  # weight of the newest strength in the usual one

_TURNS = np.radians(np.arange(-50.0, 51.0, 10.0))  # directions tried at each step
_TURN_COSTS = 0.35 * (_TURNS / _TURNS[-1]) ** 2  # of the ridge's strength
# Each direction at one and at two steps' distance, turned: for a walk along x, and along y.
_COSINES, _SINES = (
    np.outer([STEP_PX, 2.0 * STEP_PX], np.cos(_TURNS)).ravel(),
    np.outer([STEP_PX, 2.0 * STEP_PX], np.sin(_TURNS)).ravel(),
)
_ALONG_X, _ALONG_Y = np.column_stack([_COSINES, _SINES]), np.column_stack([-_SINES, _COSINES])
_ASIDE_PX = np.arange(-2.0, 2.25, 0.5)


def find_centreline(
    gray: np.ndarray, needle: SeenNeedle, longest: float, centre: tuple[float, float], reach: float
) -> np.ndarray:
    """Follow the thread from the needle's tail to its end.

    The ridge strength is the black-hat transform, how much darker a pixel is than the brightest
    background within a few pixels. The walk leaves the tail where the ridge is strongest on a small
    circle around it, goes by steps in the direction that has the strongest ridge, straight ahead
    preferred, which takes it through crossings, and centres each vertex on the ridge's cross-section.

    Args:
        gray: image, shape (rows, columns), uint8.
        needle: the needle in the same image.
        longest: the walk stops at this length [px].
        centre: the dish's centre [px].
        reach: the walk stops this far from the centre, before the wall [px].

    Returns:
        Vertices from the tail on, shape (m, 2) [px], m = 1 if no thread is seen.
    """
    ridge = _ridge(gray, needle)
    tail = needle.tail_px
    start = _leave(ridge, needle)
    if start is None:
        return tail[None, :].copy()
    points = [tail, start]
    direction = (start - tail) / math.hypot(*(start - tail))
    usual = max(FAINTEST, float(_sample(ridge, start[None])[0]))
    length, weak = START_PX, 0
    while length < longest and weak * STEP_PX < GAP_PX:
        here = points[-1]
        around = direction[0] * _ALONG_X + direction[1] * _ALONG_Y
        ahead = _sample(ridge, here + around)
        near, far = ahead[: len(_TURNS)], ahead[len(_TURNS) :]
        best = int(((near + far) / (2.0 * usual) - _TURN_COSTS).argmax())
        # In a gap the walk looks two steps ahead: beyond it the ridge may begin a little aside.
        strength = float(max(near[best], far[best]) if weak else near[best])
        if strength < max(WEAK * usual, FAINTEST):
            weak += 1
            if weak == 1 and len(points) > STRAIGHT_STEPS:  # the last steps saw less and less of the ridge
                direction = here - points[-1 - STRAIGHT_STEPS]
                direction = direction / math.hypot(*direction)
            point = here + STEP_PX * direction
        else:
            weak = 0
            usual = max(FAINTEST, (1.0 - MEMORY) * usual + MEMORY * strength)
            point = _centre(ridge, here + around[best], around[best] / STEP_PX)
        if math.hypot(point[0] - centre[0], point[1] - centre[1]) > reach:
            break
        taken = point - here
        step = math.hypot(*taken)
        length += step
        mixed = direction + taken / max(step, 1e-9)
        direction = mixed / math.hypot(*mixed)
        points.append(point)
    return np.asarray(points[: len(points) - weak])


def _ridge(gray: np.ndarray, needle: SeenNeedle) -> np.ndarray:
    """Return the ridge strength in grey levels, with the needle itself taken out."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    hat = cv2.morphologyEx(cv2.GaussianBlur(gray, (0, 0), 0.6), cv2.MORPH_BLACKHAT, kernel).astype(np.float32)
    from_px = needle.tail_px + needle.direction_px * 2.0
    to_px = needle.tip_px + needle.direction_px * 6.0
    ends = [tuple(round(float(c) * 16) for c in end) for end in (from_px, to_px)]
    cv2.line(hat, ends[0], ends[1], 0.0, int(np.ceil(needle.width_px)) + 8, cv2.LINE_8, 4)
    return hat


def _leave(ridge: np.ndarray, needle: SeenNeedle) -> np.ndarray | None:
    """Return where the thread leaves a small circle around the tail; None if nowhere."""
    angles = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    ways = np.column_stack([np.cos(angles), np.sin(angles)])
    ways = ways[ways @ needle.direction_px < np.cos(np.radians(40.0))]
    rings = [_sample(ridge, needle.tail_px + radius * ways) for radius in (START_PX - 2.0, START_PX, START_PX + 2.0)]
    strength = np.mean(rings, axis=0)
    best = int(np.argmax(strength))
    if strength[best] < 2.0 * FAINTEST:
        return None
    return _centre(ridge, needle.tail_px + START_PX * ways[best], ways[best])


def _centre(ridge: np.ndarray, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Move a point across a direction to the centre of the ridge there, by at most 1 px."""
    across = np.array([-direction[1], direction[0]])
    strength = _sample(ridge, point + _ASIDE_PX[:, None] * across)
    weight = np.maximum(strength - 0.3 * strength.max(), 0.0)
    total = float(weight.sum())
    if total <= 0.0:
        return point
    return np.asarray(point + min(1.0, max(-1.0, float(weight @ _ASIDE_PX) / total)) * across)


def _sample(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the image at points (u, v), bilinear, shape (m,); outside of the image it is 0."""
    at = points.astype(np.float32)[:, None, :]
    return np.asarray(
        cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)[:, 0]
    )
