"""Shapes of obstacles: discs, which are balls in space, and polygons with holes; polygons cut into triangles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.validation import explain_validity

from magnetosuture_thread.geometry.polyline import Points
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

    def signed_distance(self, points: Points) -> tuple[NDArray[np.float64], Points]:
        """Return the signed distance of points from the surface, and the outward direction.

        Args:
            points: shape (m, d) [m].

        Returns:
            Distance, shape (m,), negative inside [m]; its gradient, unit vectors, shape (m, d). At the
            very centre, where every direction is as good, the first axis.
        """
        offset = points - np.asarray(self.centre)
        distance = np.linalg.norm(offset, axis=1)
        first_axis = np.zeros_like(offset)
        first_axis[:, 0] = 1.0
        safe = np.where(distance > 0.0, distance, 1.0)[:, None]
        normal = np.where(distance[:, None] > 0.0, offset / safe, first_axis)
        return distance - self.radius, normal


Vertex = tuple[float, float]
Ring = tuple[Vertex, ...]

_FIT_TOLERANCE = 1e-3  # of the radius of a disc that fits into a solid

# Of an edge between two sharp corners each arc may use just under half, so that a piece of the edge
# remains: vertices nearly on top of each other would be an edge without a direction.
_EDGE_SHARE = 0.49


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
        if not isinstance(self.holes, Sequence):
            raise ConfigurationError("polygon.holes", self.holes, "a list of outlines", self.source)
        outline = _checked_ring("polygon.outline", self.outline, self.source)
        holes = tuple(_checked_ring(f"polygon.holes[{i}]", hole, self.source) for i, hole in enumerate(self.holes))
        if holes:
            _check_holes(outline, holes, self.source)
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
        """Return whether a disc of this radius fits into the solid somewhere, to `_FIT_TOLERANCE` of it [m].

        An offset outline would say it too, but of a comb it takes minutes: each corner meets every other.
        """
        tolerance = _FIT_TOLERANCE * radius
        return bool(shapely.maximum_inscribed_circle(self.solid, tolerance).length >= radius - tolerance)

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
                raise ConfigurationError(f"polygon.smoothed.{name}", value, "a positive number", self.source)
        problem: ConfigurationError | None = None
        for halvings in range(12):
            smaller = radius * 0.5**halvings
            rings = [tuple(_round_corners(ring, smaller, angle, step)) for ring in (self.outline, *self.holes)]
            try:
                return Polygon(rings[0], tuple(rings[1:]), self.source)
            except ConfigurationError as error:
                problem = error
        raise ConfigurationError(
            "polygon.smoothed.radius", radius, f"a radius that leaves a polygon ({problem})", self.source
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
        raise ConfigurationError(f"{name}[{wrong[0]}]", tuple(points[wrong[0]].tolist()), "finite coordinates", source)
    largest = float(np.abs(points).max(initial=0.0))
    if largest > MAX_COORDINATE:
        raise ConfigurationError(
            name, largest, f"coordinates of at most {MAX_COORDINATE:g} m: is it in metres?", source
        )
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if extent < MIN_EXTENT:
        raise ConfigurationError(name, extent, f"an extent of at least {MIN_EXTENT:g} m: is it in metres?", source)


def _checked_ring(name: str, given: Sequence[Sequence[float]], source: str) -> Ring:
    """Return a ring without duplicates and closing point, once it is known to bound an area."""
    try:
        points = [(float(x), float(y)) for x, y in given]
    except (TypeError, ValueError, OverflowError):
        raise ConfigurationError(name, given, "points of two coordinates x, y [m]", source) from None
    if len(set(points)) < 3:
        raise ConfigurationError(name, f"{len(set(points))} distinct points", "at least 3 points", source)
    array = np.array(points)
    check_metres(name, array, source)
    ring = tuple(point for i, point in enumerate(points) if point != points[i - 1])
    if points[0] == points[-1]:
        # The loop above dropped the first of the two; the shape shall begin where it was given to begin.
        ring = (ring[-1], *ring[:-1])
    if _is_flat(array):
        raise ConfigurationError(name, "zero area", "points that are not all on one line", source)
    shape = shapely.Polygon(array)
    if not shape.is_valid:
        raise ConfigurationError(
            name, str(explain_validity(shape)), "an outline that does not cross or touch itself", source
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
        met = [f"holes[{j}]" for j, other in enumerate(shapes[:i]) if shape.intersects(other)]
        if not solid.contains_properly(shape):
            met.insert(0, "the outline")
        if met:
            problem = f"a hole that is outside of the outline or meets it or another: {', '.join(met)}"
            raise ConfigurationError(
                f"polygon.holes[{i}]", problem, "a hole inside the outline, apart from all", source
            )


def _oriented(ring: Ring, counter_clockwise: bool) -> Ring:
    """Return a ring in the wanted direction, with the same first vertex."""
    return ring if shapely.is_ccw(shapely.LinearRing(ring)) == counter_clockwise else (ring[0], *ring[:0:-1])


def _turn(before: Vertex, corner: Vertex, after: Vertex) -> float:
    """Return by how much the way turns at a corner, in (-pi, pi], positive to the left [rad]."""
    ax, ay = corner[0] - before[0], corner[1] - before[1]
    bx, by = after[0] - corner[0], after[1] - corner[1]
    return math.atan2(ax * by - ay * bx, ax * bx + ay * by)


def _round_corners(ring: Sequence[Vertex], radius: float, angle: float, step: float) -> Iterator[Vertex]:
    """Yield the vertices of a ring whose corners sharper than an angle are arcs.

        t = r tan(turn / 2)

    Args:
        ring: vertices in order, not closed [m].
        radius: r of the arcs, where the edges are long enough for t [m].
        angle: greatest turn that is left alone [rad].
        step: greatest turn between two chords [rad].

    Yields:
        The vertices; those that are not sharp are the very same values.
    """
    n = len(ring)
    turns = [_turn(ring[i - 1], ring[i], ring[(i + 1) % n]) for i in range(n)]
    sharp = [abs(value) > angle for value in turns]
    lengths = [math.dist(ring[i], ring[(i + 1) % n]) for i in range(n)]
    for i, corner in enumerate(ring):
        if not sharp[i]:
            yield corner
            continue
        before = lengths[i - 1] * (_EDGE_SHARE if sharp[i - 1] else 2.0 * _EDGE_SHARE)
        after = lengths[i] * (_EDGE_SHARE if sharp[(i + 1) % n] else 2.0 * _EDGE_SHARE)
        tangent = min(radius * math.tan(0.5 * abs(turns[i])), before, after)
        yield from _arc(ring[i - 1], corner, ring[(i + 1) % n], turns[i], tangent, step)


def _arc(before: Vertex, corner: Vertex, after: Vertex, turned: float, tangent: float, step: float) -> Iterator[Vertex]:
    """Yield points on the arc that leaves both edges at the tangent length from their corner."""
    length = math.dist(before, corner)
    ux, uy = (corner[0] - before[0]) / length, (corner[1] - before[1]) / length
    radius = tangent / math.tan(0.5 * abs(turned))
    side = math.copysign(1.0, turned)
    x, y = corner[0] - tangent * ux, corner[1] - tangent * uy
    pieces = max(math.ceil(abs(turned) / step - 1e-9), 1)
    for k in range(pieces):
        along = radius * math.sin(abs(turned) * k / pieces)
        across = side * radius * (1.0 - math.cos(abs(turned) * k / pieces))
        yield x + along * ux - across * uy, y + along * uy + across * ux
    # The last point from its own edge: rounding in the arc must not bend that edge.
    length = math.dist(corner, after)
    yield (
        corner[0] + tangent * (after[0] - corner[0]) / length,
        corner[1] + tangent * (after[1] - corner[1]) / length,
    )


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
        raise ConfigurationError("polygon", str(error), expectation, polygon.source) from error
    corners = shapely.get_coordinates(shapely.orient_polygons(pieces)).reshape(-1, 4, 2)[:, :3]
    vertices = np.vstack(polygon.rings)
    count, area = len(vertices) + 2 * len(polygon.holes) - 2, polygon.area
    total = float(shapely.area(pieces).sum())
    rounding = 1e-9 * area + 1e-14 * float(np.ptp(vertices, axis=0).max()) ** 2
    own = {tuple(vertex) for vertex in vertices.tolist()}
    if (
        len(corners) != count
        or abs(total - area) > rounding
        or not own.issuperset(map(tuple, corners.reshape(-1, 2).tolist()))
    ):
        problem = f"{len(corners)} triangles of {total:.9g} m^2 for {count} of {area:.9g} m^2"
        raise ConfigurationError("polygon", problem, expectation, polygon.source)
    return np.ascontiguousarray(corners)
