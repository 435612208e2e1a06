"""Shapes of scene files: validated fields of a description, and a function for each shape that builds its geometry."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.obstacles.shapes import Ring
from magnetosuture_thread.scene.scene import (
    MAX_COORDINATE,
    MAX_OUTLINES,
    MAX_VERTICES,
    MIN_RADIUS,
    is_number,
    scene_error,
)


class ShapeFields:
    """Fields of one shape description, each read once; unknown fields are refused.

    Args:
        shape: name of the shape, for errors.
        type_name: what it is, for example `disc`.
        values: as the file has them.
        source: the file.
    """

    def __init__(self, shape: str, type_name: str, values: Any, source: str) -> None:
        name = f"{shape}.{type_name}"
        if not isinstance(values, Mapping):
            raise scene_error(name, values, "fields by name", source)
        self.shape, self.name, self.source = shape, name, source
        self._left = dict(values)
        self._known: list[str] = []

    def number(self, field: str, low: float, high: float, unit: str, default: float | None = None) -> float:
        """Read a number within bounds."""
        value = self._take(field, default)
        if not is_number(value) or not low <= float(value) <= high:
            raise self.error(field, value, f"a number from {low:g} to {high:g} {unit}")
        return float(value)

    def length(self, field: str, default: float | None = None) -> float:
        """Read a positive length [m]; with a default, 0 too."""
        low = 0.0 if default is not None else MIN_RADIUS
        return self.number(field, low, MAX_COORDINATE, "m", default)

    def point(self, field: str) -> tuple[float, float]:
        """Read a point x, y [m]."""
        return _point(self, field, self._take(field))

    def rings(self, field: str, default: Sequence[Any] | None = None) -> list[Ring]:
        """Read a list of rings of points."""
        given = self._take(field, default)
        if not isinstance(given, Sequence) or isinstance(given, str):
            raise self.error(field, given, "a list of outlines, each a list of points [m]")
        if len(given) > MAX_OUTLINES:
            raise self.error(field, f"{len(given)} outlines", f"at most {MAX_OUTLINES}")
        return [_ring(self, f"{field}[{index}]", ring) for index, ring in enumerate(given)]

    def ring(self, field: str) -> Ring:
        """Read a closed outline of points."""
        return _ring(self, field, self._take(field))

    def require_all_used(self) -> None:
        """Refuse fields that were not read."""
        for field, value in self._left.items():
            raise self.error(str(field), value, f"one of {', '.join(self._known)}")

    def corner_error(self, radius: float, expectation: str) -> ConfigurationError:
        """Return the error for the corner radius, which stands beside the shape's own fields."""
        return scene_error(f"{self.shape}.corner_radius", radius, expectation, self.source)

    def error(self, field: str, value: Any, expectation: str) -> ConfigurationError:
        """Return the error for a field."""
        return scene_error(f"{self.name}.{field}", value, expectation, self.source)

    def _take(self, field: str, default: Any = None) -> Any:
        self._known.append(field)
        if field not in self._left and default is None:
            given = ", ".join(str(name)[:40] for name in list(self._left)[:10])
            raise self.error(field, None, f"a value; what is left of the others is {given}" if given else "a value")
        return self._left.pop(field, default)


def _point(fields: ShapeFields, field: str, value: Any) -> tuple[float, float]:
    fits = isinstance(value, Sequence) and len(value) == 2 and all(map(is_number, value))
    if not fits or max(abs(part) for part in value) > MAX_COORDINATE:
        raise fields.error(field, value, f"two coordinates x, y of at most {MAX_COORDINATE:g}, in metres")
    return float(value[0]), float(value[1])


def _ring(fields: ShapeFields, field: str, value: Any) -> Ring:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) < 3:
        raise fields.error(field, value, "at least 3 points x, y [m]")
    if len(value) > MAX_VERTICES:
        raise fields.error(field, f"{len(value)} points", f"at most {MAX_VERTICES}")
    return tuple(_point(fields, f"{field}[{index}]", point) for index, point in enumerate(value))


ARC_TOLERANCE = 2e-6  # m; greatest distance of an arc from its chords
MAX_ARC_STEP = math.pi / 18  # rad; of one chord
DECIMALS = 12  # of a computed coordinate [m]: what machines compute differently is far below, and scenes stay equal


def arc(
    center: tuple[float, float], radius: float, start: float, end: float, *, closed: bool = False
) -> list[tuple[float, float]]:
    """Return points on an arc, close enough for its chords to be within `ARC_TOLERANCE` of it.

    Args:
        center: x, y [m].
        radius: [m]
        start: angle of the first point [rad].
        end: angle of the last one; less than `start` for a clockwise arc [rad].
        closed: whether the last point is left out, as of a full circle.
    """
    count = max(1, math.ceil(abs(end - start) / arc_step(radius) - 1e-9))
    if closed:
        count = 4 * math.ceil(count / 4)  # so that a full circle reaches as far as it does along x and y
    angles = np.linspace(start, end, count + 1)[: count if closed else count + 1]
    return [_rounded_point(center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles.tolist()]


def arc_step(radius: float) -> float:
    """Return the angle of a chord that is within `ARC_TOLERANCE` of its arc [rad]."""
    return min(MAX_ARC_STEP, 2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))


def _rounded_point(x: float, y: float) -> tuple[float, float]:
    """Return a computed point with its rounding errors taken off; + 0.0 makes a negative zero a zero."""
    return round(x, DECIMALS) + 0.0, round(y, DECIMALS) + 0.0


def _disc(fields: ShapeFields, corner_radius: float) -> Disc:
    return Disc(fields.point("center"), fields.length("radius"))


def _annulus(fields: ShapeFields, corner_radius: float) -> Polygon:
    center, inner, outer = fields.point("center"), fields.length("inner_radius"), fields.length("outer_radius")
    if inner >= outer:
        raise fields.error("inner_radius", inner, f"less than outer_radius, {outer:g} m")
    turn = 2.0 * math.pi
    return Polygon(
        tuple(arc(center, outer, 0.0, turn, closed=True)), (tuple(arc(center, inner, 0.0, turn, closed=True)),)
    )


def _annular_sector(fields: ShapeFields, corner_radius: float) -> Polygon:
    """Return the part of an annulus between two angles, less a strip of width `inset` along both straight sides."""
    center, inner, outer = fields.point("center"), fields.length("inner_radius"), fields.length("outer_radius")
    start = fields.number("start_angle", -2.0 * math.pi, 4.0 * math.pi, "rad")
    end = fields.number("end_angle", -2.0 * math.pi, 4.0 * math.pi, "rad")
    inset = fields.length("inset", 0.0)
    if inner >= outer:
        raise fields.error("inner_radius", inner, f"less than outer_radius, {outer:g} m")
    if not 0.0 < end - start < 2.0 * math.pi:
        raise fields.error("end_angle", end, "more than start_angle by less than a turn [rad]")
    if inset >= inner:
        raise fields.error("inset", inset, f"less than inner_radius, {inner:g} m")
    trim = [math.asin(inset / radius) for radius in (inner, outer)]
    if end - start <= 2.0 * trim[0]:
        raise fields.error("inset", inset, "less than half of the gap between both straight sides")
    outline = [
        *arc(center, outer, start + trim[1], end - trim[1]),
        *arc(center, inner, end - trim[0], start + trim[0]),
    ]
    if corner_radius > 0.0:
        return _rounded_convex(fields, shapely.Polygon(outline), corner_radius)
    return Polygon(tuple(outline))


def _capsule(fields: ShapeFields, corner_radius: float) -> Polygon:
    start, end, radius = fields.point("start"), fields.point("end"), fields.length("radius")
    if start == end:
        raise fields.error("end", list(end), "another point than start; else it is a disc")
    along = math.atan2(end[1] - start[1], end[0] - start[0])
    quarter = 0.5 * math.pi
    return Polygon(
        (
            *arc(end, radius, along - quarter, along + quarter),
            *arc(start, radius, along + quarter, along + 3.0 * quarter),
        )
    )


def _rectangle(fields: ShapeFields, corner_radius: float) -> Polygon:
    center, width, height = fields.point("center"), fields.length("width"), fields.length("height")
    angle = fields.number("angle", -2.0 * math.pi, 2.0 * math.pi, "rad", 0.0)
    greatest = 0.49 * min(width, height)
    if corner_radius > greatest:
        raise fields.corner_error(corner_radius, f"at most 0.49 of the shorter side, {greatest:.4g} m")
    c, s = math.cos(angle), math.sin(angle)
    corners = [(0.5 * width * x, 0.5 * height * y) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    outline = tuple(_rounded_point(center[0] + c * x - s * y, center[1] + s * x + c * y) for x, y in corners)
    return _rounded(Polygon(outline), corner_radius)


def _polygon(fields: ShapeFields, corner_radius: float) -> Polygon:
    """Return a polygon; a corner at an edge too short for the corner radius gets a smaller one."""
    polygon = Polygon(fields.ring("outline"), tuple(fields.rings("holes", ())))
    if corner_radius > 0.0 and not Polygon(polygon.outline).can_contain(corner_radius):
        raise fields.corner_error(corner_radius, "a radius of which a disc fits into the outline [m]")
    return _rounded(polygon, corner_radius)


def _rounded(polygon: Polygon, corner_radius: float) -> Polygon:
    """Return a polygon with arcs in the place of its corners; its other vertices stay as they are."""
    if corner_radius == 0.0:
        return polygon
    given = {vertex for ring in (polygon.outline, *polygon.holes) for vertex in ring}
    smooth = polygon.smoothed(corner_radius, step=arc_step(corner_radius))
    rings = [
        tuple(vertex if vertex in given else _rounded_point(*vertex) for vertex in ring)
        for ring in (smooth.outline, *smooth.holes)
    ]
    return Polygon(rings[0], tuple(rings[1:]))


def _rounded_convex(fields: ShapeFields, solid: shapely.Polygon, radius: float) -> Polygon:
    """Return a shape with its convex corners rounded: the union of all discs of a radius that fit into it."""
    segments = max(8, math.ceil(0.25 * 2.0 * math.pi / (2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))))
    opened = solid.buffer(-radius, quad_segs=segments).buffer(radius, quad_segs=segments)
    if not isinstance(opened, shapely.Polygon) or opened.is_empty:
        raise fields.corner_error(radius, "a radius with which the shape stays in one piece [m]")
    return Polygon(tuple(_rounded_point(x, y) for x, y in opened.simplify(0.1 * ARC_TOLERANCE).exterior.coords))


SHAPES: dict[str, Callable[[ShapeFields, float], Disc | Polygon]] = {
    "disc": _disc,
    "annulus": _annulus,
    "annular_sector": _annular_sector,
    "capsule": _capsule,
    "rectangle": _rectangle,
    "polygon": _polygon,
}
"""The shapes that a scene file may name, and what makes the geometry of each."""

ROUNDABLE = ("annular_sector", "rectangle", "polygon")
