"""The image along a needle, straightened, and what is steel in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.images import middle, sample_grid
from magnetosuture_thread.vision.needle.arc import Arc

BEYOND_PX = 15.0  # looked at beyond both ends of the dark component
ASIDE_PX = 7.0  # and beyond both edges of the body
STEP_ASIDE_PX = 0.5
FAINTEST = 0.3  # of the floor's brightness: a needle is darker than it by at least this
SHADOW, STEEL = 0.25, 0.65  # of the body's darkness: up to here shadow, from here on steel
OUTER_COLUMNS = 4  # on each side, that show the ground
GROUND_ROWS = 15  # of the running median along the ground on either side
TAPER = 0.2  # of the length, towards the tip


@dataclass(frozen=True)
class Strip:
    """The image along an axis, straightened, as darkness."""

    arc: Arc
    along: np.ndarray
    aside: np.ndarray
    dark: np.ndarray  # share of the ground's brightness that is missing, shape (along, aside)
    ground: np.ndarray  # brightness on either side, shape (along, 2)
    depth: float  # darkness of the body
    steel: np.ndarray  # 0 for ground and shadow to 1 for steel, shape (along, aside)
    width: np.ndarray  # of the steel in each row [px]


def straight_strip(gray: np.ndarray, arc: Arc, last: float, width: float) -> Strip | None:
    """Straighten the image along an axis; None if nothing dark lies along it."""
    along = np.arange(-BEYOND_PX, last + BEYOND_PX + 0.5)
    half = 0.5 * width + ASIDE_PX
    aside = np.arange(-half, half + 0.1, STEP_ASIDE_PX)
    strip = sample_grid(gray, arc.at(along[:, None], aside)).astype(np.float32)
    ground = np.empty((len(along), 2), np.float32)
    ground_beside(strip, OUTER_COLUMNS, GROUND_ROWS, ground)
    part = np.linspace(0.0, 1.0, len(aside), dtype=np.float32)
    dark = 1.0 - strip / np.maximum(ground[:, :1] * (1.0 - part) + ground[:, 1:] * part, 1.0)
    inner = (along > 0.2 * last) & (along < 0.8 * last)
    core = np.abs(aside) < 0.5 * width + 1.5
    depth = middle(dark[np.ix_(inner, core)].max(axis=1)) if inner.any() else 0.0
    if depth < FAINTEST:
        return None
    steel = np.clip((dark / depth - SHADOW) / (STEEL - SHADOW), 0.0, 1.0)
    steel[:, np.abs(aside) > 0.5 * width + 4.0] = 0.0
    return Strip(arc, along, aside, dark, ground, depth, steel, steel.sum(axis=1) * STEP_ASIDE_PX)


def measure_body_width(strip: Strip, last: float) -> float:
    """Return the body's width, a median over its middle."""
    return middle(strip.width[(strip.along > 0.3 * last) & (strip.along < 0.7 * last)])


@compiled
def ground_beside(strip, outer, window, ground):
    """Fill in the ground on either side of a strip: medians of its outer columns, a running median along them.

    Args:
        strip: shape (n, m).
        outer: columns on each side.
        window: odd number of rows of the running median.
        ground: filled, shape (n, 2).
    """
    rows, columns = strip.shape
    rough = np.empty((rows, 2))
    for row in range(rows):
        rough[row, 0] = np.median(strip[row, :outer])
        rough[row, 1] = np.median(strip[row, columns - outer :])
    for row in range(rows):
        first, last = max(0, row - window // 2), min(rows, row + window // 2 + 1)
        for side in range(2):
            ground[row, side] = np.median(rough[first:last, side])
