"""Obstacles from flat lists of numbers, as in ROS parameters."""

from __future__ import annotations

from collections.abc import Sequence

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles.disc import Disc
from magnetosuture_thread.geometry.obstacles.polygon import Polygon
from magnetosuture_thread.geometry.obstacles.triangulation import triangulate


def discs_from(values: Sequence[float]) -> tuple[Disc, ...]:
    """Return discs from x, y and radius of each in turn [m]."""
    return tuple(Disc((values[k], values[k + 1]), values[k + 2]) for k in range(0, len(values), 3))


def polygons_from(
    group: str, corners: Sequence[float], sizes: Sequence[int], corner_radius: float = 0.0, corner_angle: float = 1.0
) -> tuple[Polygon, ...]:
    """Return polygons from the corners of all outlines in turn.

    Args:
        group: section of the settings, for the errors; the lists are its polygon_obstacles and polygon_sizes.
        corners: x and y of each corner [m].
        sizes: number of corners of each outline; negative for a hole in the polygon before it.
        corner_radius: sharp corners are rounded by this; 0 leaves them [m].
        corner_angle: a corner is sharp where the outline turns by more than this [rad].

    Raises:
        ConfigurationError: the lists do not fit together, or an outline bounds no polygon.
    """
    name, count = f"{group}.polygon_sizes", len(corners) // 2
    if sum(abs(size) for size in sizes) != count:
        raise ConfigurationError(name, list(sizes), f"the corners of each outline, {count} in all without their signs")
    shapes: list[list[tuple[tuple[float, float], ...]]] = []
    begin = 0
    for size in sizes:
        end = begin + 2 * abs(size)
        values = corners[begin:end]
        ring = tuple(zip(values[::2], values[1::2], strict=True))
        if size > 0:
            shapes.append([ring])
        elif shapes:
            shapes[-1].append(ring)
        else:
            raise ConfigurationError(name, list(sizes), "an outline before its holes")
        begin = end
    polygons = []
    for index, rings in enumerate(shapes):
        try:
            polygon = Polygon(rings[0], tuple(rings[1:]))
            if corner_radius > 0.0:
                polygon = polygon.smoothed(corner_radius, corner_angle)
            triangulate(polygon)
        except ConfigurationError as error:
            where = f"{group}.polygon_obstacles, {error.name.replace('polygon', f'polygon {index}', 1)}"
            raise ConfigurationError(where, error.value, error.expectation) from None
        polygons.append(polygon)
    return tuple(polygons)
