"""Guesses where a needle's axis lies in a dark component, which may hold a thread as dark as the needle too."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.needle.arc import Arc, fit_arc
from magnetosuture_thread.vision.sampling import middle

CORE = 0.33  # of the body's width: what lies deeper in the dark than this is no thin thread
MAX_WIDTH = 2.6  # of the body's: what is wider is neither needle nor thread, nor both
MIN_CORE = 0.25  # of the needle's area
MAX_CORES, MAX_ENDS = 3, 5
LONG = 1.35  # of the needle's length: a longer core holds thread


def axis_guesses(dark: np.ndarray, length: float, width: float) -> list[Arc]:
    """Return axes, from the tail on, that a needle may have in a dark component.

    What lies as deep in the dark as the middle of the body is followed: it is either about as long as the needle, which
    then lies along it, or holds a thread too, and the needle begins or ends at one of its ends.

    Args:
        dark: where the image is dark, shape (rows, columns), bool.
        length: of the needle [px].
        width: of its body [px].
    """
    deep = cv2.distanceTransform(dark.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    if deep.max() > 0.5 * MAX_WIDTH * width + 1.0:
        return []
    inset = CORE * width
    core = (deep > inset).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    result: list[Arc] = []
    areas = stats[1:, cv2.CC_STAT_AREA]
    for label in 1 + np.argsort(-areas)[:MAX_CORES]:
        if stats[label, cv2.CC_STAT_AREA] < MIN_CORE * (1.0 - 2.0 * CORE) * length * width:
            continue
        own = (labels == label).astype(np.uint8)
        rows, columns = np.nonzero(own)
        guess = _axis_of(np.column_stack([columns, rows]).astype(float), width)
        if guess is None:
            continue
        arc, first, last = guess
        if last - first < 0.5 * length:
            continue
        if last - first < LONG * length:
            result += _both(arc, first - inset, last + inset, length)
        else:
            result += _from_ends(own, length, width)
    return result


def _both(arc: Arc, first: float, last: float, length: float) -> list[Arc]:
    """Return an axis in both directions, its tail where the dark begins, and if that goes on for too long, its tip."""
    forward, backward = arc.moved(first, 0.0, 0.0, 0.0), arc.reversed_at(last)
    if last - first < length:
        return [forward, backward]
    return [forward, backward, forward.reversed_at(length), backward.reversed_at(length)]


def _from_ends(own: np.ndarray, length: float, width: float) -> list[Arc]:
    """Return axes that begin or end at the ends of a long, winding core."""
    result: list[Arc] = []
    rows, columns = np.nonzero(own)
    steps = np.empty(own.shape, np.int32)
    _walk(own, _pixel(own, rows[0], columns[0]), steps)
    last = int(np.argmax(steps))
    _walk(own, _pixel(own, last // own.shape[1], last % own.shape[1]), steps)
    size = 2 * int(0.5 * width + 2.0) + 1
    highest = cv2.dilate(steps.astype(np.float32), np.ones((size, size), np.uint8))
    at = np.argwhere((steps == highest) & (own > 0))
    ends = [np.array([last // own.shape[1], last % own.shape[1]])]
    for place in at[np.argsort(-steps[at[:, 0], at[:, 1]])]:
        if len(ends) < MAX_ENDS and min(np.abs(place - other).max() for other in ends) > size:
            ends.append(place)
    for row, column in ends:
        _walk(own, _pixel(own, row, column), steps)
        rows, columns = np.nonzero((steps >= 0) & (steps < 0.8 * length))
        guess = _axis_of(np.column_stack([columns, rows]).astype(float), width)
        if guess is None:
            continue
        arc, first, final = guess
        end = float(arc.coordinates(np.array([[column, row]], float))[0][0])
        # From the end inwards; a point reaches farther than its core, by the part that is too thin for it.
        inwards = arc.moved(first, 0.0, 0.0, 0.0) if end - first < final - end else arc.reversed_at(final)
        for beyond in (0.1 * length, 0.03 * length):
            result.append(inwards.moved(-beyond, 0.0, 0.0, 0.0).reversed_at(length))
        result.append(inwards.moved(-CORE * width, 0.0, 0.0, 0.0))
    return result


def _pixel(own: np.ndarray, row: int, column: int) -> np.ndarray:
    """Return an image of one pixel."""
    result = np.zeros_like(own)
    result[row, column] = 1
    return result


def _axis_of(points: np.ndarray, width: float) -> tuple[Arc, float, float] | None:
    """Return an arc through most of the points, and the lengths along it between which these lie."""
    kept = points
    for _ in range(4):
        if len(kept) < 8:
            return None
        arc = fit_arc(kept)
        along, aside = arc.coordinates(points)
        near = np.abs(aside) < max(0.5 * width, 1.5 * middle(np.abs(aside)))
        if near.sum() == len(kept):
            break
        kept = points[near]
    return arc, float(along[near].min()), float(along[near].max())


@compiled
def _walk(own, start, steps):
    """Fill in how many steps from the nearest pixel of a start each pixel of its components is, -1 elsewhere."""
    steps[:] = -1
    rows, columns = own.shape
    queue = np.empty((rows * columns, 2), np.int32)
    head, tail = 0, 0
    for y in range(rows):
        for x in range(columns):
            if start[y, x] != 0:
                steps[y, x] = 0
                queue[tail, 0], queue[tail, 1] = y, x
                tail += 1
    while head < tail:
        r, c = queue[head]
        head += 1
        for i in range(-1, 2):
            for j in range(-1, 2):
                y, x = r + i, c + j
                if 0 <= y < rows and 0 <= x < columns and own[y, x] != 0 and steps[y, x] < 0:
                    steps[y, x] = steps[r, c] + 1
                    queue[tail, 0], queue[tail, 1] = y, x
                    tail += 1
