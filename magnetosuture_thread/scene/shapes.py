"""Scenes as the content of scene files: fields of each shape, checked, and the geometry that they describe."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.geometry.obstacles.shapes import Ring
from magnetosuture_thread.scene.scene import (
    KINDS,
    MAX_COORDINATE,
    MAX_NAME_CHARS,
    MAX_OUTLINES,
    MAX_SHAPES,
    MAX_VERTICES,
    MIN_RADIUS,
    Dish,
    Scene,
    SceneShape,
    is_name,
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
    # A chord spans at most 10 degrees.
    return min(math.pi / 18, 2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))


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


DISH_FIELDS = ("diameter", "depth", "wall_friction", "self_contact")
MAX_CORNER_RADIUS = 0.1  # m


def shape_from_mapping(name: str, description: Any, source: str = "") -> SceneShape:
    """Return a shape from its description: its fields under the name of a shape, its kind, corner radius and friction.

    Args:
        name: of the shape.
        description: for example `{"disc": {"center": [0.0, 0.0], "radius": 0.001}, "kind": "instrument"}`. SI units
            and radians throughout.
        source: the file that it comes from, for errors.

    Raises:
        ConfigurationError: a field is missing, unknown or out of its bounds, or the shape bounds no area.
    """
    if not isinstance(name, str) or not is_name(name):
        raise scene_error("shapes", name, f"names of 1 to {MAX_NAME_CHARS} printable characters", source)
    if not isinstance(description, Mapping):
        raise scene_error(name, description, f"a shape, one of {', '.join(SHAPES)}", source)
    types = [key for key in description if key in SHAPES]
    unknown = [key for key in description if key not in (*SHAPES, "kind", "corner_radius", "friction")]
    if unknown or len(types) != 1:
        value = unknown[0] if unknown else types or "no shape"
        raise scene_error(name, value, f"kind, corner_radius, friction and one of {', '.join(SHAPES)}", source)
    type_name = types[0]
    radius = description.get("corner_radius", 0.0)
    if not is_number(radius) or not 0.0 <= radius <= MAX_CORNER_RADIUS:
        raise scene_error(f"{name}.corner_radius", radius, f"a number from 0 to {MAX_CORNER_RADIUS:g} m", source)
    if radius > 0.0 and type_name not in ("annular_sector", "rectangle", "polygon"):
        raise scene_error(f"{name}.corner_radius", radius, f"0 m: a {type_name} has no corners", source)
    fields = ShapeFields(name, type_name, description[type_name], source)
    kind = description.get("kind", "tissue")
    if kind not in KINDS:
        raise scene_error(f"{name}.kind", kind, f"one of {', '.join(KINDS)}", source)
    try:
        geometry = SHAPES[type_name](fields, float(radius))
        fields.require_all_used()
        if isinstance(geometry, Polygon):
            triangulate(geometry)
        apart = ("kind", "friction")
        definition = {field: value for field, value in _to_builtin(description).items() if field not in apart}
        return SceneShape(name, kind, geometry, definition, _number_or_given(description.get("friction", 0.0)))
    except ConfigurationError as error:
        if error.source or error.name.startswith(f"{name}."):
            raise
        raise scene_error(f"{name}.{error.name}", error.value, error.expectation, source) from None


def _number_or_given(value: Any) -> Any:
    """Return a number as a float; anything else unchanged, to be refused."""
    return float(value) if is_number(value) else value


def _to_builtin(value: Any) -> Any:
    """Return a copy of a description in types that YAML and JSON can write, whatever numbers and lists it has."""
    if isinstance(value, Mapping):
        return {str(name): _to_builtin(entry) for name, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_to_builtin(entry) for entry in value]
    if isinstance(value, float):
        return float(value)
    return value


def dish_from_mapping(values: Any, source: str = "") -> Dish:
    """Return a dish from its fields; all but the diameter may be left out.

    Raises:
        ConfigurationError: a field is missing, unknown or out of its bounds.
    """
    if not isinstance(values, Mapping) or "diameter" not in values:
        raise scene_error("dish", values, "diameter and depth [m]", source)
    for field in values:
        if field not in DISH_FIELDS:
            raise scene_error(f"dish.{field}", values[field], f"one of {', '.join(DISH_FIELDS)}", source)
    numbers = {field: value for field, value in values.items() if field != "self_contact"}
    for field, value in numbers.items():
        if not is_number(value):
            unit = "" if field == "wall_friction" else " [m]"
            raise scene_error(f"dish.{field}", value, f"a number{unit}", source)
    try:
        given = {field: float(value) for field, value in numbers.items()}
        return Dish(**given, self_contact=values.get("self_contact"))
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def dish_to_mapping(dish: Dish) -> dict[str, float | bool]:
    """Return a dish as a scene file describes it."""
    fields: dict[str, float | bool] = {"diameter": dish.diameter, "depth": dish.depth}
    if dish.wall_friction:
        fields["wall_friction"] = dish.wall_friction
    if dish.self_contact is not None:
        fields["self_contact"] = dish.self_contact
    return fields


def make_scene(dish: Dish, shapes: tuple[SceneShape, ...], source: str = "") -> Scene:
    """Return a scene; an error names the file.

    Raises:
        ConfigurationError: the shapes do not fit together, or not into the dish.
    """
    try:
        return Scene(dish, shapes)
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def shape_to_mapping(shape: SceneShape) -> dict[str, Any]:
    """Return a shape as a scene file describes it; one without a definition as disc or polygon."""
    common: dict[str, Any] = {"kind": shape.kind, **({"friction": shape.friction} if shape.friction else {})}
    if shape.definition:
        return {**_to_builtin(shape.definition), **common}
    geometry = shape.geometry
    if isinstance(geometry, Disc):
        return {"disc": {"center": list(geometry.centre), "radius": geometry.radius}, **common}
    fields: dict[str, Any] = {"outline": [list(point) for point in geometry.outline]}
    if geometry.holes:
        fields["holes"] = [[list(point) for point in hole] for hole in geometry.holes]
    return {"polygon": fields, **common}


def scene_from_mapping(content: Any, source: str = "") -> Scene:
    """Return a scene from what a scene file holds.

    Args:
        content: the file's content.
        source: its name, for errors.

    Raises:
        ConfigurationError: anything in it is missing, unknown or out of bounds.
    """
    if not isinstance(content, Mapping) or "dish" not in content:
        raise scene_error("scene", content, "dish, and shapes by name", source)
    for name, value in content.items():
        if name not in ("dish", "shapes"):
            raise scene_error(str(name), value, "dish and shapes, nothing else", source)
    dish, shapes = dish_from_mapping(content["dish"], source), content.get("shapes")
    if shapes is None:
        shapes = {}
    if not isinstance(shapes, Mapping):
        raise scene_error("shapes", shapes, "shapes by name", source)
    if len(shapes) > MAX_SHAPES:
        raise scene_error("shapes", f"{len(shapes)} shapes", f"at most {MAX_SHAPES}", source)
    made = tuple(shape_from_mapping(name, description, source) for name, description in shapes.items())
    return make_scene(dish, made, source)


def scene_to_mapping(scene: Scene) -> dict[str, Any]:
    """Return what a scene file holds for a scene; a shape without a definition as disc or polygon."""
    return {
        "dish": dish_to_mapping(scene.dish),
        "shapes": {shape.name: shape_to_mapping(shape) for shape in scene.shapes},
    }
