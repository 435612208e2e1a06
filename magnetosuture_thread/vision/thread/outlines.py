"""Where a thread ends that was followed onto a shape's outline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.scene_mask import SceneMask

MIN_RUN = 5  # vertices along an outline, below which nothing is judged
MIN_SAMPLES = 8  # of the outline away from the thread
STRONGER = 1.3  # than the bare outline must a ridge be to show a thread on it


def count_off_outline(
    points: Points, ridge: NDArray[np.uint8], mask: SceneMask, origin: tuple[int, int], faintest: float
) -> int:
    """Return how many vertices of a walk show the thread, where it may have gone on along a bare outline.

    A walk ends before it enters a shape. A ridge along an outline is the thread's or the shape's own edge. The last
    vertices along an outline count only as long as their ridge is stronger than that of the same outline away from
    the walk, or that one shows none.

    Args:
        points: vertices of the walk in the ridge's pixels, shape (m, 2) [px].
        ridge: ridge strength in grey levels, uint8.
        mask: of the picture.
        origin: (u, v) of the ridge's first pixel in the picture [px].
        faintest: a strength that is no noise.
    """
    depths = mask.depths(points + origin)
    inside = depths > mask.tolerance_px
    if inside.any():  # Whatever was followed from here on, it is no thread.
        first = max(1, int(np.argmax(inside)))
        points, depths = points[:first], depths[:first]
    near = np.abs(depths) <= mask.band_px
    run = len(near) if near.all() else int(np.argmin(near[::-1]))
    if run < MIN_RUN or not len(mask.rim):
        return len(points)
    rim = mask.rim[:, :2] - origin
    last = mask.rim[np.argmin(((rim - points[-1]) ** 2).sum(axis=1)), 2]
    rim = rim[mask.rim[:, 2] == last]
    apart = ((rim[:, None] - points[None, ::3]) ** 2).sum(axis=2).min(axis=1)
    rows, columns = ridge.shape
    reach = int(mask.band_px) + 1
    seen = (apart > (2.0 * mask.band_px) ** 2) & (rim.min(axis=1) > reach)
    seen &= (rim < (columns - 1 - reach, rows - 1 - reach)).all(axis=1)
    if seen.sum() < MIN_SAMPLES:
        return len(points)
    bare = middle(_strongest(ridge, rim[seen], reach))
    if bare < faintest:
        return len(points)
    # The thread ends where the sum of what speaks for it and against it is greatest: single strong pixels count little.
    surplus = np.cumsum(np.minimum(_strongest(ridge, points[-run:], 1) / (STRONGER * bare) - 1.0, 0.5))
    shown = int(np.argmax(surplus)) + 1 if surplus.max() > 0.0 else 0
    return max(1, len(points) - run + shown)


def _strongest(ridge: NDArray[np.uint8], points: Points, reach: int) -> NDArray[np.uint8]:
    """Return the strongest ridge in a square around each point, shape (m,)."""
    step = np.arange(-reach, reach + 1)
    at = np.round(points).astype(np.intp)
    rows = np.clip(at[:, 1, None] + step, 0, ridge.shape[0] - 1)
    columns = np.clip(at[:, 0, None] + step, 0, ridge.shape[1] - 1)
    return np.asarray(ridge[rows[:, :, None], columns[:, None, :]].max(axis=(1, 2)), dtype=np.uint8)
