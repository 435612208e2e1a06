"""What stands where in a scene."""

from __future__ import annotations

import numpy as np
import shapely

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.scene.scene import Scene

WALL = "wall"


def occupant(scene: Scene, points: Points, *, holes: bool = True) -> str:
    """Return the name of what a line through points meets: `wall` at or beyond the dish's wall, a shape, or empty.

    Args:
        scene: dish and shapes.
        points: of the line; of a point alone, shape (1, 2); shape (m, 2) [m].
        holes: whether the holes of a shape are open; else they are taken for part of it.
    """
    if (np.linalg.norm(points, axis=1) >= scene.dish.radius).any():
        return WALL
    line = shapely.LineString(points) if len(points) > 1 else shapely.Point(points[0])
    for shape in scene.shapes:
        solid = shape.solid if holes else shapely.Polygon(shapely.get_exterior_ring(shape.solid))
        if solid.intersects(line):
            return shape.name
    return ""
