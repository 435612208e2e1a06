"""Shapes of obstacles: discs, which are balls in space, and polygons with holes; polygons cut into triangles."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.validation import explain_validity

from magnetosuture_thread.settings.configuration import bounded, checked_arguments
from magnetosuture_thread.settings.errors import ConfigurationError

MAX_COORDINATE = 10.0
"""A coordinate beyond this is taken for one in another unit [m]."""
MIN_EXTENT = 1e-6
"""A shape smaller than this in every direction is taken for one in another unit [m]."""


@checked_arguments("disc")
@dataclass(frozen=True)
class Disc:
    """A disc in the plane, or a ball in space.

    Attributes:
        centre: coordinates of the centre, two or three values [m].
        radius: radius [m].

    Raises:
        ConfigurationError: a number cannot be metres, or there are not two or three coordinates.
    """

    centre: Annotated[tuple[float, ...], bounded("m", -MAX_COORDINATE, MAX_COORDINATE)]
    radius: Annotated[float, bounded("m", MIN_EXTENT, MAX_COORDINATE)]

    def __post_init__(self) -> None:
        """Check the dimension."""
        if len(self.centre) not in (2, 3):
            raise ConfigurationError("disc.centre", self.centre, "two coordinates, or three in space [m]")

    @property
    def solid(self) -> shapely.Polygon:
        """The same for shapely, as a polygon of 256 vertices."""
        return shapely.Point(self.centre).buffer(self.radius, quad_segs=64)

    @property
    def area(self) -> float:
        """Its area [m^2]."""
        return math.pi * self.radius**2


Vertex = tuple[float, float]
Ring = tuple[Vertex, ...]


@dataclass(frozen=True)
class Polygon:
    """A solid in the plane: the inside of a closed outline, less its holes.

    The outline may be given in either direction and closed or not. It is kept counter-clockwise, its
    holes clockwise, so that the solid is to the left of every edge; without the repeated closing point
    and without consecutive duplicates. Coordinates are kept bit for bit.

    Attributes:
        outline: vertices (x, y), at least three [m].
        holes: outlines of the holes, apart from the outline and from each other [m].

    Raises:
        ConfigurationError: it is not a polygon: too few or not finite points, a crossing, a hole that
            is not inside, no area, or coordinates that cannot be metres.
    """

    outline: Ring
    holes: tuple[Ring, ...] = ()

    def __post_init__(self) -> None:
        """Check outline and holes, and bring them into order."""
        if not isinstance(self.holes, Sequence):
            raise ConfigurationError("polygon.holes", self.holes, "a list of outlines")
        outline = _checked_ring("polygon.outline", self.outline)
        holes = tuple(_checked_ring(f"polygon.holes[{i}]", hole) for i, hole in enumerate(self.holes))
        solid, solids = shapely.Polygon(outline), [shapely.Polygon(hole) for hole in holes]
        for i, hole in enumerate(solids):
            met = [] if solid.contains_properly(hole) else ["the outline"]
            met += [f"holes[{j}]" for j, other in enumerate(solids[:i]) if hole.intersects(other)]
            if met:
                problem = f"a hole that is outside of the outline or meets it or another: {', '.join(met)}"
                raise ConfigurationError(f"polygon.holes[{i}]", problem, "a hole inside the outline, apart from all")
        object.__setattr__(self, "outline", _oriented(outline, counter_clockwise=True))
        object.__setattr__(self, "holes", tuple(_oriented(hole, counter_clockwise=False) for hole in holes))

    @property
    def rings(self) -> list[NDArray[np.float64]]:
        """Outline and holes, each of shape (v, 2), the solid to the left [m]."""
        return [np.array(ring, dtype=np.float64) for ring in (self.outline, *self.holes)]

    @property
    def solid(self) -> shapely.Polygon:
        """The same for shapely."""
        return shapely.Polygon(self.outline, self.holes)

    @property
    def area(self) -> float:
        """Area of the solid, holes taken off [m^2]."""
        return float(self.solid.area)

    def can_contain(self, radius: float) -> bool:
        """Return whether a disc of this radius fits into the solid somewhere, to a thousandth of it [m].

        An offset outline would say it too, but of a comb it takes minutes: each corner meets every other. A circle to
        a tenth tells most shapes, in a hundredth of the time.
        """
        least = (1.0 - 1e-3) * radius
        for tolerance in (0.1 * radius, 1e-3 * radius):
            inscribed = shapely.maximum_inscribed_circle(self.solid, tolerance).length
            if inscribed >= least or inscribed + tolerance < least:
                break
        return bool(inscribed >= least)

    def smoothed(self, radius: float, step: float = math.pi / 18) -> Polygon:
        """Return the polygon with its sharp corners rounded by arcs tangent to both edges.

            t = r tan(turn / 2)    from the corner to where the arc of radius r begins

        A corner is sharp when its edges turn by more than 30 degrees. All other vertices stay bit for bit.
        Where an edge is too short for t at its ends, r is reduced; when an arc would run into another
        part of the shape, r is halved for the whole shape.

        Args:
            radius: r, positive [m].
            step: greatest turn from one chord of an arc to the next [rad].

        Raises:
            ConfigurationError: when the radius is not positive, or none gives a valid polygon.
        """
        if not (math.isfinite(radius) and radius > 0.0):
            raise ConfigurationError("polygon.smoothed.radius", radius, "a positive number")
        problem: ConfigurationError | None = None
        for halvings in range(12):
            rings = (self.outline, *self.holes)
            outline, *holes = (tuple(_round_corners(ring, radius * 0.5**halvings, step)) for ring in rings)
            try:
                return Polygon(outline, tuple(holes))
            except ConfigurationError as error:
                problem = error
        raise ConfigurationError("polygon.smoothed.radius", radius, f"a radius that leaves a polygon ({problem})")


def _checked_ring(name: str, vertices: Sequence[Sequence[float]]) -> Ring:
    """Return a ring without duplicates and closing point, once it is known to bound an area."""
    try:
        points = [(float(x), float(y)) for x, y in vertices]
    except (TypeError, ValueError, OverflowError):
        raise ConfigurationError(name, vertices, "points of two coordinates x, y [m]") from None
    if len(set(points)) < 3:
        raise ConfigurationError(name, f"{len(set(points))} distinct points", "at least 3 points")
    array = np.array(points)
    wrong = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(wrong):
        raise ConfigurationError(f"{name}[{wrong[0]}]", points[wrong[0]], "finite coordinates")
    largest, extent = float(np.abs(array).max()), float(np.ptp(array, axis=0).max())
    if largest > MAX_COORDINATE:
        raise ConfigurationError(name, largest, f"coordinates of at most {MAX_COORDINATE:g} m: is it in metres?")
    if extent < MIN_EXTENT:
        raise ConfigurationError(name, extent, f"an extent of at least {MIN_EXTENT:g} m: is it in metres?")
    offsets = array - array[0]
    farthest = offsets[np.argmax(np.linalg.norm(offsets, axis=1))]
    across = offsets[:, 0] * farthest[1] - offsets[:, 1] * farthest[0]
    if np.abs(across).max() <= 1e-12 * (farthest @ farthest):
        raise ConfigurationError(name, "zero area", "points that are not all on one line")
    shape = shapely.Polygon(array)
    if not shape.is_valid:
        raise ConfigurationError(name, str(explain_validity(shape)), "an outline that does not cross or touch itself")
    ring = tuple(point for i, point in enumerate(points) if point != points[i - 1])
    # Of a closed one this dropped the first of the two; the shape shall begin where it was given to begin.
    return (ring[-1], *ring[:-1]) if points[0] == points[-1] else ring


def _oriented(ring: Ring, counter_clockwise: bool) -> Ring:
    """Return a ring in the wanted direction, with the same first vertex."""
    return ring if shapely.is_ccw(shapely.LinearRing(ring)) == counter_clockwise else (ring[0], *ring[:0:-1])


def _round_corners(ring: Ring, radius: float, step: float) -> Iterator[Vertex]:
    """Yield the vertices of a ring whose sharp corners are arcs of a radius, where the edges are long enough for it.

    See `Polygon.smoothed`. The vertices that are not sharp are the very same values.
    """
    corners = [complex(*vertex) for vertex in ring]
    edges = [after - corner for corner, after in zip(corners, (*corners[1:], corners[0]), strict=True)]
    lengths = [abs(edge) for edge in edges]
    turns = [cmath.phase(edge * edges[i - 1].conjugate()) for i, edge in enumerate(edges)]
    # Of an edge between two sharp corners each arc may use just under half, so that a piece of the edge
    # remains: vertices nearly on top of each other would be an edge without a direction.
    shares = [0.49 if abs(turn) > math.pi / 6 else 0.98 for turn in turns]
    for i, corner in enumerate(corners):
        turn, after = abs(turns[i]), (i + 1) % len(corners)
        if turn <= math.pi / 6:
            yield ring[i]
            continue
        tangent = min(radius * math.tan(0.5 * turn), lengths[i - 1] * shares[i - 1], lengths[i] * shares[after])
        inwards, side = edges[i - 1] / lengths[i - 1], math.copysign(1.0, turns[i])
        arc, pieces = tangent / math.tan(0.5 * turn), max(math.ceil(turn / step - 1e-9), 1)
        for angle in (turn * k / pieces for k in range(pieces)):
            along = complex(arc * math.sin(angle) - tangent, side * arc * (1.0 - math.cos(angle)))
            place = corner + along * inwards
            yield place.real, place.imag
        # The last point from its own edge: rounding in the arc must not bend that edge.
        place = corner + tangent / lengths[i] * edges[i]
        yield place.real, place.imag


Obstacle = Disc | Polygon
"""Any shape that `Workspace` takes."""


def triangulate(polygon: Polygon) -> NDArray[np.float64]:
    """Return the triangles of a polygon's constrained Delaunay triangulation, counter-clockwise, shape (t, 3, 2) [m].

    All corners are the polygon's, there are as many triangles as its vertices and holes ask for, and their areas add
    up to its area: this is checked.

    Raises:
        ConfigurationError: with what the triangulation missed.
    """
    expectation = "a shape that can be cut into triangles"
    try:
        pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon.solid))
    except shapely.errors.GEOSException as error:  # corners apart by less than rounding
        raise ConfigurationError("polygon", str(error), expectation) from error
    corners = shapely.get_coordinates(shapely.orient_polygons(pieces)).reshape(-1, 4, 2)[:, :3]
    vertices = np.vstack(polygon.rings)
    count, area = len(vertices) + 2 * len(polygon.holes) - 2, polygon.area
    total = float(shapely.area(pieces).sum())
    rounding = 1e-9 * area + 1e-14 * float(np.ptp(vertices, axis=0).max()) ** 2
    foreign = {*map(tuple, corners.reshape(-1, 2).tolist())} - {*map(tuple, vertices.tolist())}
    if len(corners) != count or abs(total - area) > rounding or foreign:
        problem = f"{len(corners)} triangles of {total:.9g} m^2 for {count} of {area:.9g} m^2"
        raise ConfigurationError("polygon", problem, expectation)
    return np.ascontiguousarray(corners)
