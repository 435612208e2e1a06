"""Polygons: flat obstacles with an outline and holes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.validation import explain_validity

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles.smoothing import rounded

LARGEST_COORDINATE = 10.0
"""A coordinate beyond this is taken for one in another unit [m]."""
SMALLEST_EXTENT = 1e-6
"""A shape smaller than this in every direction is taken for one in another unit [m]."""

Ring = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Polygon:
    """A solid in the plane: the inside of a closed outline, less its holes.

    The outline may be given in either direction and closed or not. It is kept counter-clockwise, its
    holes clockwise, so that the solid is to the left of every edge; without the repeated closing point
    and without consecutive duplicates. Coordinates are kept bit for bit.

    Attributes:
        outline: vertices (x, y), at least three [m].
        holes: outlines of the holes, apart from the outline and from each other [m].
        source: the file that the shape came from, for the error.

    Raises:
        ConfigurationError: when it is no polygon: too few or not finite points, a crossing, a hole that
            is not inside, no area, or coordinates that cannot be metres.
    """

    outline: Ring
    holes: tuple[Ring, ...] = ()
    source: str = field(default="", compare=False, repr=False)

    def __post_init__(self) -> None:
        """Check and normalise what was given."""
        outline = _checked_ring("polygon.outline", self.outline, self.source)
        holes = tuple(_checked_ring(f"polygon.holes[{i}]", hole, self.source) for i, hole in enumerate(self.holes))
        _check_holes(outline, holes, self.source)
        object.__setattr__(self, "outline", _directed(outline, counter_clockwise=True))
        object.__setattr__(self, "holes", tuple(_directed(hole, counter_clockwise=False) for hole in holes))

    @property
    def rings(self) -> list[NDArray[np.float64]]:
        """Outline and holes, each of shape (v, 2), the solid to the left [m]."""
        return [np.array(ring, dtype=np.float64) for ring in (self.outline, *self.holes)]

    @property
    def area(self) -> float:
        """Area of the solid, holes taken off [m^2]."""
        return sum(_signed_area(ring) for ring in (self.outline, *self.holes))

    def has_room_for(self, radius: float) -> bool:
        """Return whether a disc of this radius fits into the solid somewhere [m]."""
        solid = shapely.Polygon(self.outline, self.holes)
        return not solid.buffer(-radius).is_empty

    def smoothed(self, radius: float, angle: float = math.pi / 6, step: float = math.pi / 18) -> Polygon:
        """Return the polygon with its sharp corners rounded by arcs tangent to both edges.

            t = r tan(turn / 2)    from the corner to where the arc of radius r begins

        A corner is sharp when its edges turn by more than `angle`. All other vertices stay bit for bit.
        Where an edge is too short for t at its ends, r is reduced; when an arc would run into another
        part of the shape, r is halved for the whole shape.

        Args:
            radius: r, positive [m].
            angle: greatest turn that is left alone [rad].
            step: greatest turn from one chord of an arc to the next [rad].

        Raises:
            ConfigurationError: when a number is not positive, or no radius gives a valid polygon.
        """
        for name, value in (("radius", radius), ("angle", angle), ("step", step)):
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigurationError(f"polygon.smoothed.{name}", value, "a positive number", source=self.source)
        problem: ConfigurationError | None = None
        for halvings in range(12):
            smaller = radius * 0.5**halvings
            rings = [tuple(rounded(ring, smaller, angle, step)) for ring in (self.outline, *self.holes)]
            try:
                return Polygon(rings[0], tuple(rings[1:]), self.source)
            except ConfigurationError as error:
                problem = error
        raise ConfigurationError(
            "polygon.smoothed.radius", radius, f"a radius that leaves a polygon ({problem})", source=self.source
        )


def check_metres(name: str, points: NDArray[np.float64], source: str) -> None:
    """Refuse coordinates that are not finite or that cannot be metres.

    Args:
        name: what the points are, for the error.
        points: shape (v, d) [m].
        source: the file they came from.

    Raises:
        ConfigurationError: with the vertex or the extent at fault.
    """
    wrong = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(wrong):
        raise ConfigurationError(
            f"{name}[{wrong[0]}]", tuple(points[wrong[0]].tolist()), "finite coordinates", source=source
        )
    largest = float(np.abs(points).max(initial=0.0))
    if largest > LARGEST_COORDINATE:
        raise ConfigurationError(
            name, largest, f"coordinates of at most {LARGEST_COORDINATE:g} m: is it in metres?", source=source
        )
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if extent < SMALLEST_EXTENT:
        raise ConfigurationError(
            name, extent, f"an extent of at least {SMALLEST_EXTENT:g} m: is it in metres?", source=source
        )


def _checked_ring(name: str, given: Sequence[Sequence[float]], source: str) -> Ring:
    """Return a ring without duplicates and closing point, once it is known to bound an area."""
    for i, point in enumerate(given):
        if len(point) != 2:
            raise ConfigurationError(f"{name}[{i}]", tuple(point), "two coordinates x, y [m]", source=source)
    points = [(float(x), float(y)) for x, y in given]
    if len(set(points)) < 3:
        raise ConfigurationError(name, f"{len(set(points))} distinct points", "at least 3 points", source=source)
    array = np.array(points)
    check_metres(name, array, source)
    ring = tuple(point for i, point in enumerate(points) if point != points[i - 1])
    if points[0] == points[-1]:
        # The loop above dropped the first of the two; the shape shall begin where it was given to begin.
        ring = (ring[-1], *ring[:-1])
    if _is_flat(array):
        raise ConfigurationError(name, "zero area", "points that are not all on one line", source=source)
    shape = shapely.Polygon(ring)
    if not shape.is_valid:
        raise ConfigurationError(
            name, str(explain_validity(shape)), "an outline that does not cross or touch itself", source=source
        )
    return ring


def _is_flat(points: NDArray[np.float64]) -> bool:
    """Return whether all points are on one line, to rounding."""
    offsets = points - points[0]
    furthest = offsets[np.argmax(np.linalg.norm(offsets, axis=1))]
    across = offsets[:, 0] * furthest[1] - offsets[:, 1] * furthest[0]
    return bool(np.abs(across).max() <= 1e-12 * (furthest @ furthest))


def _check_holes(outline: Ring, holes: tuple[Ring, ...], source: str) -> None:
    """Refuse a hole that is not wholly inside of the outline, or that meets another hole."""
    solid = shapely.Polygon(outline)
    shapes = [shapely.Polygon(hole) for hole in holes]
    for i, shape in enumerate(shapes):
        name = f"polygon.holes[{i}]"
        if not solid.intersects(shape):
            raise ConfigurationError(name, "a hole outside the outline", "a hole inside the outline", source=source)
        if not solid.contains_properly(shape):
            where = solid.exterior.intersection(shape.exterior)
            value = (
                "a hole around the outline" if where.is_empty else f"a hole that meets the outline at {_place(where)}"
            )
            raise ConfigurationError(name, value, "a hole inside the outline, apart from it", source=source)
        for j, other in enumerate(shapes[:i]):
            if shape.intersects(other):
                where = shape.intersection(other)
                raise ConfigurationError(
                    name,
                    f"a hole that meets holes[{j}] at {_place(where)}",
                    "holes apart from each other",
                    source=source,
                )


def _place(shape: shapely.Geometry) -> str:
    """Return a point of a shape as text [m]."""
    point = shape.representative_point()
    return f"({point.x:.6g}, {point.y:.6g})"


def _signed_area(ring: Ring) -> float:
    """Return the area of a ring, positive when counter-clockwise [m^2]."""
    x, y = (np.array(ring) - ring[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _directed(ring: Ring, counter_clockwise: bool) -> Ring:
    """Return a ring in the wanted direction, with the same first vertex."""
    return ring if (_signed_area(ring) > 0.0) == counter_clockwise else (ring[0], *ring[:0:-1])
