"""Checks of a scene: collisions, and warnings on overlaps, narrow gaps and shapes across the wall."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene, SceneShape

WALL_NAME = "wall"


def find_collision(scene: Scene, points: Points, depth: float = 0.0, *, holes: bool = True) -> str:
    """Return the name of what a line through points collides with: `wall`, a shape, or empty for nothing.

    It collides with the wall at or beyond it.

    Args:
        scene: dish and shapes.
        points: of the line; of a point alone, shape (1, 2); shape (m, 2) [m].
        depth: by which it may lie in the wall or a shape [m].
        holes: whether the holes of a shape are open; else they are taken for part of it.
    """
    if (np.linalg.norm(points, axis=1) >= scene.dish.radius + depth).any():
        return WALL_NAME
    line = shapely.LineString(points) if len(points) > 1 else shapely.Point(points[0])
    for shape in scene.shapes:
        solid = shape.solid if holes else shapely.Polygon(shapely.get_exterior_ring(shape.solid))
        if (solid.buffer(-depth) if depth else solid).intersects(line):
            return shape.name
    return ""


@dataclass(frozen=True)
class SceneWarning:
    """A warning on a scene that is valid but may be a mistake.

    Attributes:
        what: overlap, gap, hole or wall.
        shapes: names of the shapes that it is about.
        value: the gap's width, or how far a shape reaches beyond the wall [m]; of an overlap its area [m^2].
        place: where [m].
        text: the same in words.
    """

    what: str
    shapes: tuple[str, ...]
    value: float
    place: tuple[float, float]
    text: str


def scene_warnings(scene: Scene, needle_width: float) -> list[SceneWarning]:
    """Return the warnings on a scene, shape by shape, then pair by pair.

    Args:
        scene: to look through.
        needle_width: a gap or a hole narrower than this lets no needle pass [m].
    """
    found = [warning for shape in scene.shapes for warning in _shape_warnings(shape, scene.dish.radius, needle_width)]
    for first, second in combinations(scene.shapes, 2):
        if shapely.box(*first.solid.bounds).distance(shapely.box(*second.solid.bounds)) < needle_width:
            found += _pair_warnings(first, second, needle_width)
    return found


def _shape_warnings(shape: SceneShape, dish_radius: float, needle_width: float) -> Iterator[SceneWarning]:
    outline = shapely.get_coordinates(shape.solid.exterior)
    x, y = outline[np.argmax(np.hypot(*outline.T))].tolist()  # the point that is farthest from the dish's centre
    room = dish_radius - math.hypot(x, y)
    if room < 0.0:
        text = f"{shape.name} lies across the wall: it reaches {_mm(-room)} mm beyond"
        yield SceneWarning("wall", (shape.name,), -room, (x, y), text)
    elif room < needle_width:
        yield SceneWarning("gap", (shape.name,), room, (x, y), _gap(f"{shape.name} and the wall", room, (x, y)))
    for hole in map(shapely.Polygon, shape.solid.interiors):
        tolerance = 0.01 * needle_width
        circle = shapely.maximum_inscribed_circle(hole, tolerance)
        x, y = circle.coords[0]
        width = 2.0 * circle.length
        if width < needle_width - tolerance:
            text = f"a hole of {shape.name} at {_at((x, y))} is {_mm(width)} mm wide: narrower than the needle"
            yield SceneWarning("hole", (shape.name,), width, (x, y), text)


def _pair_warnings(first: SceneShape, second: SceneShape, needle_width: float) -> Iterator[SceneWarning]:
    names = (first.name, second.name)
    common = first.solid.intersection(second.solid)
    gap = float(first.solid.distance(second.solid))
    # Shapes that share a boundary do not overlap.
    if common.area > 1e-12:
        inside = common.representative_point()
        place = float(inside.x), float(inside.y)
        text = f"{first.name} and {second.name} overlap by {1e6 * common.area:.3g} mm^2 at {_at(place)}"
        yield SceneWarning("overlap", names, float(common.area), place, text)
    elif gap < needle_width:
        middle = shapely.shortest_line(first.solid, second.solid).interpolate(0.5, normalized=True)
        place = float(middle.x), float(middle.y)
        yield SceneWarning("gap", names, gap, place, _gap(f"{first.name} and {second.name}", gap, place))


def _gap(between: str, width: float, place: tuple[float, float]) -> str:
    return f"the gap between {between} at {_at(place)} is {_mm(width)} mm wide: narrower than the needle"


def _mm(length: float) -> str:
    return f"{1e3 * length:.3g}"


def _at(place: tuple[float, float]) -> str:
    return f"({1e3 * place[0]:.2f}, {1e3 * place[1]:.2f}) mm"
