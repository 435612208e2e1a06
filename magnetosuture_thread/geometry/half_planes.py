"""Projection of a point onto an intersection of half planes, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points

ROUNDING = 1e-12
"""Tolerance of a result beyond a line, relative to the size of the projected point."""
SLACK = 1e-14
"""Tolerance of intermediate results: without it, rounding would make two nearly equal lines exclude each other."""


@compiled
def project_onto_half_planes(
    point: NDArray[np.float64], given: Points, bounds: NDArray[np.float64], work: Points, found: NDArray[np.float64]
) -> bool:
    """Write the nearest point; `work` (k, 3) has room for rows of length one; return whether there is one."""
    # Of size one, so that the tolerance means something however small or large the point is.
    size = math.hypot(point[0], point[1])
    if size == 0.0:
        size = max(1e-300, np.abs(bounds).max())
    x, y = point[0] / size, point[1] / size
    for i in range(len(given)):
        length = math.hypot(given[i, 0], given[i, 1])
        work[i, 2] = bounds[i] / length / size if length > 0.0 else -np.inf
        work[i, 0] = given[i, 0] / length if length > 0.0 else 0.0
        work[i, 1] = given[i, 1] / length if length > 0.0 else 0.0
    best, inside = np.inf, True
    for i in range(len(work)):
        nx, ny, least = work[i, 0], work[i, 1], work[i, 2]
        if nx * x + ny * y >= least:
            continue
        inside = False
        # Along the line i, from its point nearest to the origin: where all the others let it be.
        px, py, low, high = least * nx, least * ny, -np.inf, np.inf
        for j in range(len(work)):
            slope = work[j, 1] * nx - work[j, 0] * ny
            missing = work[j, 2] - work[j, 0] * px - work[j, 1] * py - SLACK
            if slope > 0.0:
                low = max(low, missing / slope)
            elif slope < 0.0:
                high = min(high, missing / slope)
        along = min(max(y * nx - x * ny, low), high)
        qx, qy = px - along * ny, py + along * nx
        square = (qx - x) ** 2 + (qy - y) ** 2
        if not square < best:
            continue
        holds = True
        for j in range(len(work)):
            if work[j, 0] * qx + work[j, 1] * qy < work[j, 2] - ROUNDING:
                holds = False
                break
        if holds:
            best, found[0], found[1] = square, size * qx, size * qy
    if inside:
        found[0], found[1] = point[0], point[1]
    return inside or best < np.inf
