"""The shapes that a scene file knows, and the geometry that each stands for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.scene.refusal import refusal
from magnetosuture_thread.scene.scene import (
    KINDS,
    MAX_COORDINATE,
    MAX_HOLES,
    MAX_NAME_CHARS,
    MAX_VERTICES,
    MIN_RADIUS,
    Dish,
    Scene,
    SceneShape,
    is_name,
)
from magnetosuture_thread.scene.text import is_number

ARC_TOLERANCE = 2e-6  # m; greatest distance of an arc from its chords
MAX_ARC_STEP = math.pi / 18  # rad; of one chord
MAX_CORNER_RADIUS = 0.1  # m
DECIMALS = 12  # of a computed coordinate [m]: what machines compute differently is far below, and scenes stay equal

Ring = tuple[tuple[float, float], ...]


class _Fields:
    """The fields of one shape's description, each taken once; what is left over is refused.

    Args:
        shape: name of the shape, for errors.
        type_name: what it is, for example `disc`.
        values: as the file has them.
        source: the file.
    """

    def __init__(self, shape: str, type_name: str, values: Any, source: str) -> None:
        name = f"{shape}.{type_name}"
        if not isinstance(values, Mapping):
            raise refusal(name, values, "fields by name", source)
        self.shape, self.name, self.source = shape, name, source
        self._left = dict(values)
        self._known: list[str] = []

    def number(self, field: str, low: float, high: float, unit: str, default: float | None = None) -> float:
        """Take a number within bounds."""
        value = self._take(field, default)
        if not is_number(value) or not low <= float(value) <= high:
            raise self.refuse(field, value, f"a number from {low:g} to {high:g} {unit}")
        return float(value)

    def length(self, field: str, default: float | None = None) -> float:
        """Take a positive length [m]; with a default, 0 too."""
        low = 0.0 if default is not None else MIN_RADIUS
        return self.number(field, low, MAX_COORDINATE, "m", default)

    def point(self, field: str) -> tuple[float, float]:
        """Take a point x, y [m]."""
        return _point(self, field, self._take(field))

    def rings(self, field: str, default: Sequence[Any] | None = None) -> list[Ring]:
        """Take a list of rings of points."""
        given = self._take(field, default)
        if not isinstance(given, Sequence) or isinstance(given, str):
            raise self.refuse(field, given, "a list of outlines, each a list of points [m]")
        if len(given) > MAX_HOLES:
            raise self.refuse(field, f"{len(given)} outlines", f"at most {MAX_HOLES}")
        return [_ring(self, f"{field}[{index}]", ring) for index, ring in enumerate(given)]

    def ring(self, field: str) -> Ring:
        """Take a closed outline of points."""
        return _ring(self, field, self._take(field))

    def end(self) -> None:
        """Refuse what nobody took."""
        for field, value in self._left.items():
            raise self.refuse(str(field), value, f"one of {', '.join(self._known)}")

    def refuse_corners(self, radius: float, expectation: str) -> ConfigurationError:
        """Return the error for the corner radius, which stands beside the shape's own fields."""
        return refusal(f"{self.shape}.corner_radius", radius, expectation, self.source)

    def refuse(self, field: str, value: Any, expectation: str) -> ConfigurationError:
        """Return the error for a field."""
        return refusal(f"{self.name}.{field}", value, expectation, self.source)

    def _take(self, field: str, default: Any = None) -> Any:
        self._known.append(field)
        if field not in self._left and default is None:
            given = ", ".join(str(name)[:40] for name in list(self._left)[:10])
            raise self.refuse(field, None, f"a value; what is left of the others is {given}" if given else "a value")
        return self._left.pop(field, default)


def _point(fields: _Fields, field: str, value: Any) -> tuple[float, float]:
    fits = isinstance(value, Sequence) and len(value) == 2 and all(map(is_number, value))
    if not fits or max(abs(part) for part in value) > MAX_COORDINATE:
        raise fields.refuse(field, value, f"two coordinates x, y of at most {MAX_COORDINATE:g}, in metres")
    return float(value[0]), float(value[1])


def _ring(fields: _Fields, field: str, value: Any) -> Ring:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) < 3:
        raise fields.refuse(field, value, "at least 3 points x, y [m]")
    if len(value) > MAX_VERTICES:
        raise fields.refuse(field, f"{len(value)} points", f"at most {MAX_VERTICES}")
    return tuple(_point(fields, f"{field}[{index}]", point) for index, point in enumerate(value))


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
    return [_exact(center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles.tolist()]


def arc_step(radius: float) -> float:
    """Return the angle of a chord that is within `ARC_TOLERANCE` of its arc [rad]."""
    return min(MAX_ARC_STEP, 2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))


def _exact(x: float, y: float) -> tuple[float, float]:
    """Return a computed point with its rounding errors taken off; + 0.0 makes a negative zero a zero."""
    return round(x, DECIMALS) + 0.0, round(y, DECIMALS) + 0.0


def _disc(fields: _Fields, corner_radius: float) -> Disc:
    return Disc(fields.point("center"), fields.length("radius"))


def _annulus(fields: _Fields, corner_radius: float) -> Polygon:
    center, inner, outer = fields.point("center"), fields.length("inner_radius"), fields.length("outer_radius")
    if inner >= outer:
        raise fields.refuse("inner_radius", inner, f"less than outer_radius, {outer:g} m")
    turn = 2.0 * math.pi
    return Polygon(
        tuple(arc(center, outer, 0.0, turn, closed=True)), (tuple(arc(center, inner, 0.0, turn, closed=True)),)
    )


def _annular_sector(fields: _Fields, corner_radius: float) -> Polygon:
    """Return the part of an annulus between two angles, less a strip of width `inset` along both straight sides."""
    center, inner, outer = fields.point("center"), fields.length("inner_radius"), fields.length("outer_radius")
    start = fields.number("start_angle", -2.0 * math.pi, 4.0 * math.pi, "rad")
    end = fields.number("end_angle", -2.0 * math.pi, 4.0 * math.pi, "rad")
    inset = fields.length("inset", 0.0)
    if inner >= outer:
        raise fields.refuse("inner_radius", inner, f"less than outer_radius, {outer:g} m")
    if not 0.0 < end - start < 2.0 * math.pi:
        raise fields.refuse("end_angle", end, "more than start_angle by less than a turn [rad]")
    if inset >= inner:
        raise fields.refuse("inset", inset, f"less than inner_radius, {inner:g} m")
    trim = [math.asin(inset / radius) for radius in (inner, outer)]
    if end - start <= 2.0 * trim[0]:
        raise fields.refuse("inset", inset, "less than half of the gap between both straight sides")
    outline = [
        *arc(center, outer, start + trim[1], end - trim[1]),
        *arc(center, inner, end - trim[0], start + trim[0]),
    ]
    if corner_radius > 0.0:
        return _opened(fields, shapely.Polygon(outline), corner_radius)
    return Polygon(tuple(outline))


def _capsule(fields: _Fields, corner_radius: float) -> Polygon:
    start, end, radius = fields.point("start"), fields.point("end"), fields.length("radius")
    if start == end:
        raise fields.refuse("end", list(end), "another point than start; else it is a disc")
    along = math.atan2(end[1] - start[1], end[0] - start[0])
    quarter = 0.5 * math.pi
    return Polygon(
        (
            *arc(end, radius, along - quarter, along + quarter),
            *arc(start, radius, along + quarter, along + 3.0 * quarter),
        )
    )


def _rectangle(fields: _Fields, corner_radius: float) -> Polygon:
    center, width, height = fields.point("center"), fields.length("width"), fields.length("height")
    angle = fields.number("angle", -2.0 * math.pi, 2.0 * math.pi, "rad", 0.0)
    greatest = 0.49 * min(width, height)
    if corner_radius > greatest:
        raise fields.refuse_corners(corner_radius, f"at most 0.49 of the shorter side, {greatest:.4g} m")
    c, s = math.cos(angle), math.sin(angle)
    corners = [(0.5 * width * x, 0.5 * height * y) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    outline = tuple(_exact(center[0] + c * x - s * y, center[1] + s * x + c * y) for x, y in corners)
    return _rounded(Polygon(outline), corner_radius)


def _polygon(fields: _Fields, corner_radius: float) -> Polygon:
    """Return a polygon; a corner at an edge too short for the corner radius gets a smaller one."""
    polygon = Polygon(fields.ring("outline"), tuple(fields.rings("holes", ())))
    if corner_radius > 0.0 and not Polygon(polygon.outline).has_room_for(corner_radius):
        raise fields.refuse_corners(corner_radius, "a radius of which a disc fits into the outline [m]")
    return _rounded(polygon, corner_radius)


def _rounded(polygon: Polygon, corner_radius: float) -> Polygon:
    """Return a polygon with arcs in the place of its corners; its other vertices stay as they are."""
    if corner_radius == 0.0:
        return polygon
    given = {vertex for ring in (polygon.outline, *polygon.holes) for vertex in ring}
    smooth = polygon.smoothed(corner_radius, step=arc_step(corner_radius))
    rings = [
        tuple(vertex if vertex in given else _exact(*vertex) for vertex in ring)
        for ring in (smooth.outline, *smooth.holes)
    ]
    return Polygon(rings[0], tuple(rings[1:]))


def _opened(fields: _Fields, solid: shapely.Polygon, radius: float) -> Polygon:
    """Return a shape with its convex corners rounded: the union of all discs of a radius that fit into it."""
    segments = max(8, math.ceil(0.25 * 2.0 * math.pi / (2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))))
    opened = solid.buffer(-radius, quad_segs=segments).buffer(radius, quad_segs=segments)
    if not isinstance(opened, shapely.Polygon) or opened.is_empty:
        raise fields.refuse_corners(radius, "a radius with which the shape stays in one piece [m]")
    return Polygon(tuple(_exact(x, y) for x, y in opened.simplify(0.1 * ARC_TOLERANCE).exterior.coords))


SHAPES: dict[str, Callable[[_Fields, float], Disc | Polygon]] = {
    "disc": _disc,
    "annulus": _annulus,
    "annular_sector": _annular_sector,
    "capsule": _capsule,
    "rectangle": _rectangle,
    "polygon": _polygon,
}
"""The shapes that a scene file may name, and what makes the geometry of each."""

ROUNDABLE = ("annular_sector", "rectangle", "polygon")


def shape_from_mapping(name: str, description: Any, source: str = "") -> SceneShape:
    """Return a shape from its description: its fields under the name of a shape, its kind and corner radius.

    Args:
        name: of the shape.
        description: for example `{"disc": {"center": [0.0, 0.0], "radius": 0.001}, "kind": "instrument"}`. SI units
            and radians throughout.
        source: the file that it comes from, for errors.

    Raises:
        ConfigurationError: a field is missing, unknown or out of its bounds, or the shape bounds no area.
    """
    if not isinstance(name, str) or not is_name(name):
        raise refusal("shapes", name, f"names of 1 to {MAX_NAME_CHARS} printable characters", source)
    if not isinstance(description, Mapping):
        raise refusal(name, description, f"a shape, one of {', '.join(SHAPES)}", source)
    types = [key for key in description if key in SHAPES]
    unknown = [key for key in description if key not in (*SHAPES, "kind", "corner_radius")]
    if unknown or len(types) != 1:
        value = unknown[0] if unknown else types or "no shape"
        raise refusal(name, value, f"kind, corner_radius and one of {', '.join(SHAPES)}", source)
    type_name = types[0]
    radius = description.get("corner_radius", 0.0)
    if not is_number(radius) or not 0.0 <= radius <= MAX_CORNER_RADIUS:
        raise refusal(f"{name}.corner_radius", radius, f"a number from 0 to {MAX_CORNER_RADIUS:g} m", source)
    if radius > 0.0 and type_name not in ROUNDABLE:
        raise refusal(f"{name}.corner_radius", radius, f"0 m: a {type_name} has no corners", source)
    fields = _Fields(name, type_name, description[type_name], source)
    kind = description.get("kind", "tissue")
    if kind not in KINDS:
        raise refusal(f"{name}.kind", kind, f"one of {', '.join(KINDS)}", source)
    try:
        geometry = SHAPES[type_name](fields, float(radius))
        fields.end()
        if isinstance(geometry, Polygon):
            triangulate(geometry)
        definition = {field: value for field, value in _plain(description).items() if field != "kind"}
        return SceneShape(name, kind, geometry, definition)
    except ConfigurationError as error:
        if error.source or error.name.startswith(f"{name}."):
            raise
        raise refusal(f"{name}.{error.name}", error.value, error.expectation, source) from None


def _plain(value: Any) -> Any:
    """Return a copy of a description in types that YAML and JSON can write, whatever numbers and lists it has."""
    if isinstance(value, Mapping):
        return {str(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(value)
    return value


def dish_from_mapping(values: Any, source: str = "") -> Dish:
    """Return a dish from its fields, diameter and depth [m]; the depth may be left out.

    Raises:
        ConfigurationError: a field is missing, unknown or out of its bounds.
    """
    if not isinstance(values, Mapping) or "diameter" not in values:
        raise refusal("dish", values, "diameter and depth [m]", source)
    for field in values:
        if field not in ("diameter", "depth"):
            raise refusal(f"dish.{field}", values[field], "one of diameter, depth", source)
    for field, value in values.items():
        if not is_number(value):
            raise refusal(f"dish.{field}", value, "a number [m]", source)
    try:
        return Dish(**{field: float(value) for field, value in values.items()})
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def scene_of_parts(dish: Dish, shapes: tuple[SceneShape, ...], source: str = "") -> Scene:
    """Return a scene; an error names the file.

    Raises:
        ConfigurationError: the shapes do not fit together, or not into the dish.
    """
    try:
        return Scene(dish, shapes)
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def description_of(shape: SceneShape) -> dict[str, Any]:
    """Return a shape as a scene file describes it; one without a definition as disc or polygon."""
    if shape.definition:
        return {**_plain(shape.definition), "kind": shape.kind}
    geometry = shape.geometry
    if isinstance(geometry, Disc):
        return {"disc": {"center": list(geometry.centre), "radius": geometry.radius}, "kind": shape.kind}
    fields: dict[str, Any] = {"outline": [list(point) for point in geometry.outline]}
    if geometry.holes:
        fields["holes"] = [[list(point) for point in hole] for hole in geometry.holes]
    return {"polygon": fields, "kind": shape.kind}
