"""Placement of the names of shapes in a drawing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import shapely

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.scene.scene import Scene, SceneShape

LABEL_DIRECTIONS = 16  # in which a name can stand beside its shape
LABEL_DISTANCES = (1.0, 1.6, 2.4)  # times the name's height, from the shape


@dataclass(frozen=True)
class LabelPosition:
    """Position of a name.

    Attributes:
        middle: of the name [m].
        line: from the name to its shape, where it stands beside it; else empty [m].
    """

    middle: tuple[float, float]
    line: tuple[tuple[float, float], ...] = ()


def label_positions(scene: Scene, sizes: Sequence[tuple[float, float]]) -> list[LabelPosition]:
    """Return a position for the name of each shape: in the shape, in a hole of it, or beside it without overlap.

    Where no position is free, the name is placed in its shape.

    Args:
        scene: that is drawn.
        sizes: width and height of each name [m].
    """
    solids = [shape.solid for shape in scene.shapes]
    dish = shapely.Point(0.0, 0.0).buffer(scene.dish.radius)
    taken: list[shapely.Geometry] = []
    places: list[LabelPosition] = []
    for shape, solid, (width, height) in zip(scene.shapes, solids, sizes, strict=True):
        place = LabelPosition(shape.label_point)
        if not solid.contains(_box(place.middle, width, height)):
            for candidate in _candidates(shape, solid, width, height):
                box = _box(candidate, 1.1 * width, 1.2 * height)
                if dish.contains(box) and not any(box.intersects(other) for other in (*solids, *taken)):
                    start, end = shapely.shortest_line(_box(candidate, width, height), solid).coords
                    place = LabelPosition(candidate, (start, end))
                    break
        taken.append(_box(place.middle, width, height))
        places.append(place)
    return places


def _box(place: tuple[float, float], width: float, height: float) -> shapely.Polygon:
    x, y = place
    return shapely.box(x - 0.5 * width, y - 0.5 * height, x + 0.5 * width, y + 0.5 * height)


def _candidates(
    shape: SceneShape, solid: shapely.Geometry, width: float, height: float
) -> Iterator[tuple[float, float]]:
    if not isinstance(shape.geometry, Disc):
        for hole in shape.geometry.holes:
            middle = shapely.Polygon(hole).centroid
            yield middle.x, middle.y
    left, bottom, right, top = solid.bounds
    x, y = 0.5 * (left + right), 0.5 * (bottom + top)
    for step in LABEL_DISTANCES:
        for index in range(LABEL_DIRECTIONS):
            # Right and left first, then above and below, then between.
            angle = math.pi * (index % 2) + 2.0 * math.pi * (index // 2) / LABEL_DIRECTIONS
            across = 0.5 * (right - left + width) + step * height
            upward = 0.5 * (top - bottom + height) + step * height
            yield x + across * math.cos(angle), y + upward * math.sin(angle)
