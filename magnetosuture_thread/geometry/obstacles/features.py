"""Edges of polygons as a flat table for the compiled search, which reads memory in order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles.shapes import Polygon
from magnetosuture_thread.geometry.polyline import Points

EDGE_WIDTH = 14
"""Numbers of an edge: start, end, unit direction (2 each), length, unit direction of the edge before (2),
pseudo-normals at start and end (2 each), and one to fill."""


class Features(NamedTuple):
    """Edges of a polygon.

    Attributes:
        numbers: rows of numbers, shape (f, EDGE_WIDTH).
        corners: start and end of each, shape (f, 2, 2) [m].
    """

    numbers: Points
    corners: NDArray[np.float64]


def edges_of(polygon: Polygon) -> Features:
    """Return the edges of a polygon.

        n = (d_y, -d_x)    outward normal of an edge with direction d, as the solid is to the left

    A vertex's pseudo-normal is the mean of the normals of its two edges.

    Source: J. A. Baerentzen, H. Aanaes 2005, the plane's counterpart of angle-weighted normals.
    """
    tables = []
    for start in polygon.rings:
        end = np.roll(start, -1, axis=0)
        length = np.hypot(*(end - start).T)[:, None]
        along = (end - start) / length
        before = np.roll(along, 1, axis=0)
        pseudo = np.stack([along[:, 1] + before[:, 1], -along[:, 0] - before[:, 0]], axis=1)
        # At a needle's tip the two normals nearly cancel; the way there points out of the tip as well, or
        # at the tip of a needle-shaped notch into it.
        left = before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0] > 0.0
        tip = np.linalg.norm(pseudo, axis=1) < 1e-6
        pseudo[tip] = np.where(left[tip, None], 1.0, -1.0) * (before - along)[tip]
        pseudo /= np.linalg.norm(pseudo, axis=1)[:, None]
        tables.append(np.hstack([start, end, along, length, before, pseudo, np.roll(pseudo, -1, axis=0), 0.0 * length]))
    numbers = np.vstack(tables)
    return Features(numbers, numbers[:, :4].reshape(-1, 2, 2))
