"""Triangulations: a polygon as triangles that keep its edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles.shapes import Polygon
from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True, eq=False)
class Triangulation:
    """A polygon cut into triangles.

    Attributes:
        vertices: those of the polygon, outline first, then hole by hole, shape (v, 2) [m].
        triangles: indices of vertices, counter-clockwise, shape (t, 3).
        boundary: edges of the polygon in order, the solid to their left, shape (v, 2).
    """

    vertices: Points
    triangles: NDArray[np.int64]
    boundary: NDArray[np.int64]

    @property
    def areas(self) -> NDArray[np.float64]:
        """Area of each triangle, shape (t,) [m^2]."""
        a, b, c = np.moveaxis(self.vertices[self.triangles], 1, 0)
        areas: NDArray[np.float64] = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        return areas


def triangulate(polygon: Polygon) -> Triangulation:
    """Return the constrained Delaunay triangulation of a polygon, without vertices of its own.

    Every edge of the polygon is an edge of exactly one triangle, every other edge of exactly two, and
    the areas add up to the polygon's: this is checked.

    Raises:
        ConfigurationError: with what the triangulation missed.
    """
    rings = polygon.rings
    vertices = np.vstack(rings)
    firsts = np.cumsum([0, *(len(ring) for ring in rings)])
    boundary = np.vstack(
        [
            np.stack([np.arange(len(ring)), np.roll(np.arange(len(ring)), -1)], axis=1) + first
            for ring, first in zip(rings, firsts[:-1], strict=True)
        ]
    )
    shape = shapely.Polygon(polygon.outline, polygon.holes)
    try:
        pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(shape))
    except shapely.errors.GEOSException as error:  # corners apart by less than rounding
        raise _refusal(polygon, str(error)) from error
    index = {tuple(vertex): i for i, vertex in enumerate(vertices.tolist())}
    try:
        triangles = np.array(
            [[index[corner] for corner in piece.exterior.coords[:3]] for piece in pieces], dtype=np.int64
        ).reshape(-1, 3)
    except KeyError as error:
        raise _refusal(polygon, f"a triangle's corner {error} that is none of the polygon") from error
    found = Triangulation(vertices, triangles, boundary)
    clockwise = found.areas < 0.0
    triangles[clockwise] = triangles[clockwise][:, ::-1]
    _check(polygon, found)
    for array in (vertices, triangles, boundary):
        array.setflags(write=False)
    return found


def _refusal(polygon: Polygon, problem: str) -> ConfigurationError:
    return ConfigurationError("polygon", problem, "a shape that can be cut into triangles", polygon.source)


def _check(polygon: Polygon, found: Triangulation) -> None:
    """Refuse a triangulation that does not conform to its polygon."""
    # As one number per directed edge: tail * v + head.
    v = len(found.vertices)
    tails, heads = found.triangles.ravel(), np.roll(found.triangles, -1, axis=1).ravel()
    edges, counts = np.unique(tails * v + heads, return_counts=True)
    if (counts > 1).any():
        raise _refusal(polygon, f"triangles that overlap at vertex {edges[counts > 1][0] // v}")
    wanted = found.boundary[:, 0] * v + found.boundary[:, 1]
    missing = ~np.isin(wanted, edges)
    if missing.any():
        tail, head = found.boundary[np.flatnonzero(missing)[0]].tolist()
        raise _refusal(polygon, f"the edge from vertex {tail} to {head} lost")
    inner = np.setdiff1d(edges, wanted)
    if not np.isin(inner % v * v + inner // v, inner).all():
        raise _refusal(polygon, "an edge inside that belongs to one triangle only")
    total, area = float(found.areas.sum()), polygon.area
    if abs(total - area) > 1e-9 * area + 1e-14 * float(np.ptp(found.vertices, axis=0).max()) ** 2:
        raise _refusal(polygon, f"triangles of {total:.9g} m^2 in a shape of {area:.9g} m^2")
