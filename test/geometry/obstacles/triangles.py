"""Closest points on all triangles of a mesh, one by one: what the search in grids is compared with."""

from __future__ import annotations

import numba
import numpy as np

from magnetosuture_thread.geometry.obstacles.search import closest_in_space


@numba.njit
def closest_on_triangles(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return for each of m points the closest point on each of t triangles, shape (m, t, 3)."""
    closest = np.empty((len(points), len(triangles), 3))
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        for j in range(len(triangles)):
            k, n, m = triangles[j]
            a = (vertices[k, 0], vertices[k, 1], vertices[k, 2])
            b = (vertices[n, 0], vertices[n, 1], vertices[n, 2])
            c = (vertices[m, 0], vertices[m, 1], vertices[m, 2])
            closest[i, j, 0], closest[i, j, 1], closest[i, j, 2], _ = closest_in_space(p, a, b, c)
    return closest
