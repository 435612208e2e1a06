"""Workspace: the dish wall and all obstacles, and the contacts of points with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles.contacts import find_contacts
from magnetosuture_thread.geometry.obstacles.packing import Obstacle, pack_obstacles
from magnetosuture_thread.geometry.obstacles.shapes import Disc, Mesh, Polygon
from magnetosuture_thread.geometry.polyline import Points

_INITIAL_ROWS = 256  # contacts that `near` has room for at first


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where points are near obstacles or the dish wall: k rows, in the order of nodes, then obstacles.

    Attributes:
        node: index of the point, shape (k,).
        obstacle: index of the obstacle, `WALL` for the dish wall, shape (k,).
        distance: signed distance, negative inside of an obstacle and beyond the wall, shape (k,) [m].
        normal: gradient of the signed distance, unit vectors, shape (k, d).
        nearest: whether the row is the nearest of its point and obstacle, one for each pair, shape (k,).
    """

    node: NDArray[np.int64]
    obstacle: NDArray[np.int64]
    distance: NDArray[np.float64]
    normal: Points
    nearest: NDArray[np.bool_]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.node)


class Workspace:
    """Obstacles that do not move and the round wall of the dish about the origin, and what of them is near.

    Args:
        shapes: the obstacles: discs, polygons (in the plane only) and meshes (in space only).
        reach: greatest distance at which a boundary is near, not negative [m].
        dimension: 2 or 3.
        wall_radius: inner radius of the wall, in space a cylinder along z; inf without a wall [m].

    Attributes:
        shapes: the obstacles.
        reach: greatest distance at which a boundary is near [m].
        dimension: 2 or 3.
        wall_radius: inner radius of the wall [m].
        data: the same for compiled code, see `find_contacts`.

    Raises:
        ConfigurationError: when a shape is not of this dimension, or a number is not in its bounds.
    """

    def __init__(
        self, shapes: Sequence[Obstacle], reach: float, dimension: int = 2, wall_radius: float = math.inf
    ) -> None:
        if dimension not in (2, 3):
            raise ConfigurationError("workspace.dimension", dimension, "2 or 3")
        if not (math.isfinite(reach) and reach >= 0.0):
            raise ConfigurationError("workspace.reach", reach, "a number of at least 0 m")
        if not wall_radius > 0.0:
            raise ConfigurationError("workspace.wall_radius", wall_radius, "a number above 0 m, or inf")
        self.shapes = tuple(shapes)
        self.reach = float(reach)
        self.dimension = dimension
        self.wall_radius = float(wall_radius)
        for i, shape in enumerate(self.shapes):
            _check(f"workspace.shapes[{i}]", shape, dimension)
        self.data = pack_obstacles(self.shapes, self.reach, dimension, self.wall_radius)
        self._max_rows = _INITIAL_ROWS

    def near(self, points: Points) -> Contacts:
        """Return the contacts of points: every local minimum of the distance to an obstacle's boundary.

            outward = grad sd(x),    closest point = x - sd(x) outward

        A point outside has a row for every boundary point that is closer to it than the boundary around,
        within reach: one at a straight wall of many edges, two in a corner that reaches around it. A point
        inside has one row, the nearest, however deep it is. Exactly on the boundary the distance is 0 and
        the direction the normal. A point that is not a number has no row.

        The wall has one row for each point within reach, and for each beyond it, before those of the obstacles.

        Args:
            points: shape (m, d) [m].

        Raises:
            ValueError: when points are not of this dimension.

        Source: J. A. Baerentzen, H. Aanaes 2005, sign by pseudo-normals.
        """
        points = np.array(points, dtype=np.float64, order="C")
        if points.ndim != 2 or points.shape[1] != self.dimension:
            raise ValueError(f"points of shape {points.shape}, expected (m, {self.dimension})")
        while True:
            node, obstacle = np.empty(self._max_rows, np.int64), np.empty(self._max_rows, np.int64)
            distance, normal = np.empty(self._max_rows), np.empty((self._max_rows, self.dimension))
            nearest = np.empty(self._max_rows, np.bool_)
            count = find_contacts(points, self.data, node, obstacle, distance, normal, nearest)
            if count >= 0:
                break
            self._max_rows *= 2
        found = [array[:count].copy() for array in (node, obstacle, distance, normal, nearest)]
        for array in found:
            array.setflags(write=False)
        return Contacts(*found)


def _check(name: str, shape: Obstacle, dimension: int) -> None:
    if isinstance(shape, Disc):
        if len(shape.centre) != dimension or not np.isfinite(shape.centre).all():
            raise ConfigurationError(f"{name}.centre", shape.centre, f"{dimension} finite coordinates [m]")
        if not (math.isfinite(shape.radius) and shape.radius >= 0.0):
            raise ConfigurationError(f"{name}.radius", shape.radius, "a number of at least 0 m")
    elif isinstance(shape, Polygon) and dimension != 2:
        raise ConfigurationError(name, "a polygon", "a disc or a mesh in space")
    elif isinstance(shape, Mesh) and dimension != 3:
        raise ConfigurationError(name, "a mesh", "a disc or a polygon in the plane; a mesh needs dimension=3")
