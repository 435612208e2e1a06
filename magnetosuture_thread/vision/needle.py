"""Finds the needle: the one dark, slender thing in the dish."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView

DARK = 0.55  # of the floor's brightness
SAMPLE_PX = 0.5
BEYOND_PX = 9.0  # looked at beyond both ends of the dark component
SHADOW = 0.35  # of the needle's darkness; anything fainter may be its shadow
FULL_LEVEL = 0.85  # of the body's darkness: from here outwards an end fades ...
EDGE_LEVEL = 0.4  # ... down to here, above what the thread leaves behind the tail
POINTEDNESS = 1.5  # how much longer the tip must take to fade than the tail
TAIL_LEVEL = 0.5  # of the body's darkness above the shadow
TIP_LEVEL = 0.2  # of the body's darkness; a point blunter than this ends abruptly in the image
INSIDE = 0.97  # part of the dish's radius that is looked at, to stay off the rim


@dataclass(frozen=True)
class SeenNeedle:
    """The needle in the image.

    Attributes:
        tail_px: the blunt end, shape (2,) [px].
        tip_px: the pointed end, shape (2,) [px].
        direction_px: unit vector from tail to tip, u right and v down, shape (2,).
        width_px: mean width of the body [px].
    """

    tail_px: np.ndarray
    tip_px: np.ndarray
    direction_px: np.ndarray
    width_px: float


def find_needle(gray: np.ndarray, view: DishView, dish_radius: float, length: float, width: float) -> SeenNeedle | None:
    """Find a straight needle.

    Dark pixels in the dish form components; the needle is the one whose length and width fit. Its
    axis is the line through its darkness, its ends are where the darkness summed across the axis
    crosses half of the body's. The end that narrows is the tip.

    Args:
        gray: image, shape (rows, columns), uint8.
        view: where the dish is.
        dish_radius: [m]
        length: of the needle [m].
        width: of the needle's body [m].

    Returns:
        The needle, or None when no component or more than one fits, or both ends look alike.
    """
    expected, thickness = length / view.metres_per_pixel, width / view.metres_per_pixel
    mask = np.zeros(gray.shape, np.uint8)
    centre = tuple(round(c) for c in view.centre_px)
    cv2.circle(mask, centre, int(INSIDE * dish_radius / view.metres_per_pixel), 255, -1)
    counts = np.cumsum(cv2.calcHist([gray], [0], mask, [256], [0, 256]))
    bright = float(np.searchsorted(counts, 0.5 * counts[-1]))  # the median
    dark = cv2.bitwise_and(cv2.inRange(gray, 0, int(DARK * bright)), mask)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(dark, connectivity=8)
    fitting = []
    for label in range(1, count):
        left, top, width_px, height_px, area = (int(value) for value in stats[label])
        if area < 0.3 * expected * thickness:
            continue
        rows, columns = np.nonzero(labels[top : top + height_px, left : left + width_px] == label)
        found = _measure(gray, rows + top, columns + left, bright)
        if (
            found is not None
            and 0.7 < np.linalg.norm(found.tip_px - found.tail_px) / expected < 1.3
            and found.width_px < 3.0 * thickness + 3.0
        ):
            fitting.append(found)
    return fitting[0] if len(fitting) == 1 else None


def _measure(gray: np.ndarray, rows: np.ndarray, columns: np.ndarray, bright: float) -> SeenNeedle | None:
    """Measure axis, ends and direction of one dark component, given by its pixels."""
    weight = bright - gray[rows, columns].astype(float)
    points = np.column_stack([columns, rows]).astype(float)
    centre = np.average(points, axis=0, weights=weight)
    offset = points - centre
    _, axes = np.linalg.eigh((offset * weight[:, None]).T @ offset)
    axis = axes[:, 1]
    across = np.array([-axis[1], axis[0]])
    along = np.arange((offset @ axis).min() - BEYOND_PX, (offset @ axis).max() + BEYOND_PX, SAMPLE_PX)
    half_width = np.abs(offset @ across).max() + 3.0
    aside = np.arange(-half_width, half_width + SAMPLE_PX, SAMPLE_PX)
    u = centre[0] + along[:, None] * axis[0] + aside * across[0]
    v = centre[1] + along[:, None] * axis[1] + aside * across[1]
    patch = cv2.remap(
        gray, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    patch = patch.astype(float)
    ground = np.minimum(np.percentile(patch, 80), 0.5 * (patch[:, 0] + patch[:, -1]))
    darkness = np.clip(ground[:, None] - patch, 0.0, None)
    total = darkness.sum(axis=1)
    span = (along > along[0] + BEYOND_PX) & (along < along[-1] - BEYOND_PX)
    body = float(np.median(total[span]))
    first, last = _longest_run(np.flatnonzero(total > FULL_LEVEL * body)) if body > 0.0 else (0, 0)
    faint = total < EDGE_LEVEL * body
    # How far each end takes to fade: at the blunt tail no more than the lens blurs, at the tip the taper.
    low = int(np.argmax(faint[first::-1]))
    high = int(np.argmax(faint[last:]))
    if last - first < 4 or max(low, high) < POINTEDNESS * min(low, high):
        return None
    if low > high:  # Turn everything so that the tail comes first.
        total, along, darkness, span = total[::-1], -along[::-1], darkness[::-1], span[::-1]
        first, last = len(along) - 1 - last, len(along) - 1 - first
        axis = -axis
    # Only what is much darker than the ground counts for tail and axis, or the shadow pulls them aside.
    steel = np.clip(darkness - SHADOW * np.percentile(darkness[span], 95), 0.0, None)
    solid = steel.sum(axis=1)
    tail = -_falls_below(-along[::-1], solid[::-1], len(along) - 1 - first, TAIL_LEVEL * float(np.median(solid[span])))
    tip = _falls_below(along, total, last, TIP_LEVEL * body)
    middle = (along > tail + 1.0) & (along < tail + 0.7 * (tip - tail))
    ridge = (steel @ aside) / np.maximum(solid, 1e-9)
    slope, shift = np.polyfit(along[middle], ridge[middle], 1, w=np.sqrt(solid[middle]))
    direction = axis + slope * across
    direction /= np.linalg.norm(direction)

    def at(length: float) -> np.ndarray:
        return np.asarray(centre + length * axis + (shift + slope * length) * across)

    body_dark = float(np.percentile(darkness[span], 95))
    return SeenNeedle(at(tail), at(tip), direction, body / max(body_dark, 1.0) * SAMPLE_PX)


def _longest_run(indices: np.ndarray) -> tuple[int, int]:
    """Return the first and last of the longest run of consecutive indices, small breaks bridged."""
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 4) + 1)
    run = max(runs, key=len)
    return int(run[0]), int(run[-1])


def _falls_below(along: np.ndarray, total: np.ndarray, last: int, level: float) -> float:
    """Return where a profile falls below a level after an index, interpolated."""
    below = np.flatnonzero(total[last:] < level)
    if len(below) == 0:
        return float(along[-1])
    after = last + int(below[0])
    part = (total[after - 1] - level) / max(total[after - 1] - total[after], 1e-9)
    return float(along[after - 1] + part * (along[after] - along[after - 1]))
