"""How far every place of the dish is from wall and shapes, on a grid that compiled code looks up."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.safety.packed_scene import measure, pack_scene
from magnetosuture_thread.scene import Scene

CELLS = 400  # of the grid across the dish


class ClearanceMap(NamedTuple):
    """The signed distance to the nearest of wall and shapes, at the points of a square grid over the dish.

    Attributes:
        origin: x and y of the first point [m].
        step: between points [m].
        distance: shape (m, m), rows along y [m].
    """

    origin: float
    step: float
    distance: NDArray[np.float64]


@lru_cache(maxsize=16)  # a plan asks for each of a few maps many times
def map_clearance(scene: Scene, shapes: tuple[str, ...] | None = None) -> ClearanceMap:
    """Return the distances from the wall and all shapes of a scene; from some shapes alone, if they are named.

    It is computed once for each scene and shapes, and not to be changed.

    Args:
        scene: dish and shapes.
        shapes: names of the shapes to measure from, without the wall; None for wall and all shapes.
    """
    packed = pack_scene(scene)
    radius = scene.dish.radius
    at = np.linspace(-radius, radius, CELLS + 1)
    wanted = [k for k in range(len(packed.shapes)) if shapes is None or scene.names[packed.shapes[k]] in shapes]
    distance = np.full((len(at), len(at)), np.inf)
    found, normal = np.empty((len(at), len(packed.shapes))), np.empty((len(at), len(packed.shapes), 2))
    for row, y in enumerate(at):
        points = np.column_stack([at, np.full(len(at), y)])
        measure(points, packed, found, normal)
        distance[row] = found[:, wanted].min(axis=1, initial=np.inf)
        if shapes is None:
            distance[row] = np.minimum(distance[row], radius - np.hypot(points[:, 0], points[:, 1]))
    return ClearanceMap(-radius, float(at[1] - at[0]), distance)


@compiled
def clearance_at(x: float, y: float, near: ClearanceMap) -> float:
    """Return the distance at a point, interpolated between the four around it; negative outside of the grid [m]."""
    count = len(near.distance)
    u, v = (x - near.origin) / near.step, (y - near.origin) / near.step
    i, j = math.floor(u), math.floor(v)
    if i < 0 or j < 0 or i >= count - 1 or j >= count - 1:
        return -1.0
    p, q = u - i, v - j
    low = (1.0 - p) * near.distance[j, i] + p * near.distance[j, i + 1]
    high = (1.0 - p) * near.distance[j + 1, i] + p * near.distance[j + 1, i + 1]
    return float((1.0 - q) * low + q * high)


@compiled
def body_clearance(x: float, y: float, angle: float, body: Points, near: ClearanceMap) -> float:
    """Return the least distance of the needle's points from wall and shapes [m].

    Args:
        x: of the middle of its chord [m].
        y: of the same [m].
        angle: of its chord against the x axis [rad].
        body: points of the needle's axis about the middle of its chord, the chord along x, shape (m, 2) [m].
        near: the distances.
    """
    c, s = math.cos(angle), math.sin(angle)
    least = np.inf
    for k in range(len(body)):
        px, py = body[k, 0], body[k, 1]
        least = min(least, clearance_at(x + c * px - s * py, y + s * px + c * py, near))
    return float(least)
