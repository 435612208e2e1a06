"""Scenes as the content of scene files: fields of each shape, checked, and the geometry that they describe."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import shapely

from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.geometry.scene import (
    MAX_COORDINATE,
    MAX_NAME_CHARS,
    MAX_OUTLINES,
    MAX_SHAPES,
    MAX_VERTICES,
    MIN_EDGE,
    MIN_RADIUS,
    Dish,
    Scene,
    SceneShape,
    is_name,
    is_number,
)
from magnetosuture_thread.geometry.shapes import Ring, Vertex
from magnetosuture_thread.settings.configuration import suggest_names
from magnetosuture_thread.settings.errors import ConfigurationError


@contextmanager
def located(source: str, prefix: str = "") -> Iterator[None]:
    """Name the file, and the shape if there is one, in errors that come from within."""
    try:
        yield
    except ConfigurationError as error:
        raise ConfigurationError(f"{prefix}{error.name}", error.value, error.expectation, source) from None


def _read_fields(type_name: str, values: Any) -> dict[str, Any]:
    """Return the fields of a shape, checked; those with a default may be left out."""
    if not isinstance(values, Mapping):
        raise ConfigurationError(type_name, values, "fields by name")
    wanted = SHAPES[type_name].fields
    for field, value in values.items():
        if field not in wanted:
            raise ConfigurationError(f"{type_name}.{field}", value, suggest_names(str(field), list(wanted)))
    given = {**{field: DEFAULTS.get(field) for field in wanted}, **values}
    return {field: _read_field(f"{type_name}.{field}", field, given[field]) for field in wanted}


def _read_field(name: str, field: str, value: Any) -> Any:
    """Return the value of a field in its type: by its name a point, an outline, outlines, an angle or a length."""
    if field in ("center", "start", "end"):
        return _point(name, value)
    if field == "outline":
        return _ring(name, value)
    if field == "holes":
        if not is_list(value):
            raise ConfigurationError(name, value, "a list of outlines, each a list of points [m]")
        if len(value) > MAX_OUTLINES:
            raise ConfigurationError(name, f"{len(value)} outlines", f"at most {MAX_OUTLINES}")
        return tuple(_ring(f"{name}[{index}]", ring) for index, ring in enumerate(value))
    low, high, unit = 0.0 if field == "inset" else MIN_RADIUS, MAX_COORDINATE, "m"
    if field.endswith("angle"):
        low, high, unit = -2.0 * math.pi, (2.0 if field == "angle" else 4.0) * math.pi, "rad"
    if not is_number(value) or not low <= value <= high:
        raise ConfigurationError(name, value, f"a number from {low:g} to {high:g} {unit}")
    return float(value)


def is_list(value: Any) -> bool:
    """Return whether a value is a list, and no text."""
    return isinstance(value, Sequence) and not isinstance(value, str)


def _point(name: str, value: Any) -> tuple[float, float]:
    fits = isinstance(value, Sequence) and len(value) == 2 and all(map(is_number, value))
    if not fits or max(abs(part) for part in value) > MAX_COORDINATE:
        raise ConfigurationError(name, value, f"two coordinates x, y of at most {MAX_COORDINATE:g}, in metres")
    return float(value[0]), float(value[1])


def _ring(name: str, value: Any) -> Ring:
    if not is_list(value) or len(value) < 3:
        raise ConfigurationError(name, value, "at least 3 points x, y [m]")
    if len(value) > MAX_VERTICES:
        raise ConfigurationError(name, f"{len(value)} points", f"at most {MAX_VERTICES}")
    return tuple(_point(f"{name}[{index}]", point) for index, point in enumerate(value))


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


def _annulus(corner_radius: float, center: Vertex, inner_radius: float, outer_radius: float) -> Polygon:
    _require_order("annulus", inner_radius, outer_radius)
    outline, hole = (arc(center, radius, 0.0, 2.0 * math.pi, closed=True) for radius in (outer_radius, inner_radius))
    return Polygon(tuple(outline), (tuple(hole),))


def _annular_sector(
    corner_radius: float,
    center: Vertex,
    inner_radius: float,
    outer_radius: float,
    start_angle: float,
    end_angle: float,
    inset: float,
) -> Polygon:
    """Return the part of an annulus between two angles, less a strip of width `inset` along both straight sides."""
    _require_order("annular_sector", inner_radius, outer_radius)
    if not 0.0 < end_angle - start_angle < 2.0 * math.pi:
        raise ConfigurationError(
            "annular_sector.end_angle", end_angle, "more than start_angle by less than a turn [rad]"
        )
    if inset >= inner_radius:
        raise ConfigurationError("annular_sector.inset", inset, f"less than inner_radius, {inner_radius:g} m")
    inner_trim, outer_trim = math.asin(inset / inner_radius), math.asin(inset / outer_radius)
    if end_angle - start_angle <= 2.0 * inner_trim:
        raise ConfigurationError("annular_sector.inset", inset, "less than half of the gap between both straight sides")
    outline = [
        *arc(center, outer_radius, start_angle + outer_trim, end_angle - outer_trim),
        *arc(center, inner_radius, end_angle - inner_trim, start_angle + inner_trim),
    ]
    if corner_radius > 0.0:
        return _rounded_convex(shapely.Polygon(outline), corner_radius)
    return Polygon(tuple(outline))


def _require_order(name: str, inner_radius: float, outer_radius: float) -> None:
    if inner_radius >= outer_radius:
        raise ConfigurationError(f"{name}.inner_radius", inner_radius, f"less than outer_radius, {outer_radius:g} m")


def _capsule(corner_radius: float, start: Vertex, end: Vertex, radius: float) -> Polygon:
    if start == end:
        raise ConfigurationError("capsule.end", list(end), "another point than start; else it is a disc")
    along = math.atan2(end[1] - start[1], end[0] - start[0])
    quarter = 0.5 * math.pi
    return Polygon(
        (
            *arc(end, radius, along - quarter, along + quarter),
            *arc(start, radius, along + quarter, along + 3.0 * quarter),
        )
    )


def _rectangle(corner_radius: float, center: Vertex, width: float, height: float, angle: float) -> Polygon:
    greatest = 0.49 * min(width, height)
    if corner_radius > greatest:
        expectation = f"at most 0.49 of the shorter side, {greatest:.4g} m"
        raise ConfigurationError("corner_radius", corner_radius, expectation)
    c, s = math.cos(angle), math.sin(angle)
    corners = [(0.5 * width * x, 0.5 * height * y) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    outline = tuple(_rounded_point(center[0] + c * x - s * y, center[1] + s * x + c * y) for x, y in corners)
    return _rounded(Polygon(outline), corner_radius)


def _polygon(corner_radius: float, outline: Ring, holes: tuple[Ring, ...]) -> Polygon:
    """Return a polygon; a corner at an edge too short for the corner radius gets a smaller one."""
    polygon = Polygon(outline, holes)
    if corner_radius > 0.0 and not Polygon(polygon.outline).can_contain(corner_radius):
        expectation = "a radius of which a disc fits into the outline [m]"
        raise ConfigurationError("corner_radius", corner_radius, expectation)
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


def _rounded_convex(solid: shapely.Polygon, radius: float) -> Polygon:
    """Return a shape with its convex corners rounded: the union of all discs of a radius that fit into it."""
    segments = max(8, math.ceil(0.25 * 2.0 * math.pi / (2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))))
    opened = solid.buffer(-radius, quad_segs=segments).buffer(radius, quad_segs=segments)
    if not isinstance(opened, shapely.Polygon) or opened.is_empty:
        raise ConfigurationError("corner_radius", radius, "a radius with which the shape stays in one piece [m]")
    # Two arcs may end a hair apart; what is removed is shorter than what contacts resolve.
    drawn = shapely.remove_repeated_points(opened.simplify(0.1 * ARC_TOLERANCE), MIN_EDGE)
    return Polygon(tuple(_rounded_point(x, y) for x, y in drawn.exterior.coords))


@dataclass(frozen=True)
class ShapeType:
    """A shape that a scene file may name.

    Attributes:
        make: called with the corner radius [m] and the fields, returns the geometry.
        fields: names, each with one meaning in all shapes.
        has_corners: whether a corner radius may be given.
    """

    make: Callable[..., Disc | Polygon]
    fields: tuple[str, ...]
    has_corners: bool = False


_RADII = ("center", "inner_radius", "outer_radius")
SHAPES = {
    "disc": ShapeType(lambda corner_radius, center, radius: Disc(center, radius), ("center", "radius")),
    "annulus": ShapeType(_annulus, _RADII),
    "annular_sector": ShapeType(_annular_sector, (*_RADII, "start_angle", "end_angle", "inset"), True),
    "capsule": ShapeType(_capsule, ("start", "end", "radius")),
    "rectangle": ShapeType(_rectangle, ("center", "width", "height", "angle"), True),
    "polygon": ShapeType(_polygon, ("outline", "holes"), True),
}
DEFAULTS: dict[str, Any] = {"inset": 0.0, "angle": 0.0, "holes": ()}
COMMON = ("kind", "corner_radius", "friction")  # fields of all shapes
DISH_FIELDS = tuple(field.name for field in fields(Dish))
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
    if not is_name(name):
        raise ConfigurationError("shapes", name, f"names of 1 to {MAX_NAME_CHARS} printable characters", source)
    if not isinstance(description, Mapping):
        raise ConfigurationError(name, description, f"a shape, one of {', '.join(SHAPES)}", source)
    types = [key for key in description if key in SHAPES]
    unknown = [key for key in description if key not in (*SHAPES, *COMMON)]
    if unknown or len(types) != 1:
        value = unknown[0] if unknown else types or "no shape"
        raise ConfigurationError(name, value, f"{', '.join(COMMON)} and one of {', '.join(SHAPES)}", source)
    with located(source, f"{name}."):
        radius = description.get("corner_radius", 0.0)
        if not is_number(radius) or not 0.0 <= radius <= MAX_CORNER_RADIUS:
            raise ConfigurationError("corner_radius", radius, f"a number from 0 to {MAX_CORNER_RADIUS:g} m")
        if radius > 0.0 and not SHAPES[types[0]].has_corners:
            raise ConfigurationError("corner_radius", radius, f"0 m: a {types[0]} has no corners")
        geometry = SHAPES[types[0]].make(float(radius), **_read_fields(types[0], description[types[0]]))
        if isinstance(geometry, Polygon):
            triangulate(geometry)
    # A copy in the types that YAML and JSON can write, whatever numbers and lists it has.
    definition = json.loads(
        json.dumps({key: description[key] for key in description if key not in ("kind", "friction")})
    )
    with located(source):
        return SceneShape(
            name, description.get("kind", "tissue"), geometry, definition, description.get("friction", 0.0)
        )


def dish_from_mapping(values: Any, source: str = "") -> Dish:
    """Return a dish from its fields; all but the diameter may be left out.

    Raises:
        ConfigurationError: a field is missing, unknown or out of its bounds.
    """
    if not isinstance(values, Mapping) or "diameter" not in values:
        raise ConfigurationError("dish", values, "diameter and depth [m]", source)
    for field, value in values.items():
        if field not in DISH_FIELDS:
            raise ConfigurationError(f"dish.{field}", value, suggest_names(str(field), list(DISH_FIELDS)), source)
    with located(source):
        return Dish(**values)


def dish_to_mapping(dish: Dish) -> dict[str, float | bool]:
    """Return a dish as a scene file describes it."""
    given = asdict(dish)
    if not dish.wall_friction:
        del given["wall_friction"]
    if dish.self_contact is None:
        del given["self_contact"]
    return given


def shape_to_mapping(shape: SceneShape) -> dict[str, Any]:
    """Return a shape as a scene file describes it; one without a definition as disc or polygon."""
    common: dict[str, Any] = {"kind": shape.kind, **({"friction": shape.friction} if shape.friction else {})}
    if shape.definition:
        return {**deepcopy(dict(shape.definition)), **common}  # a copy, as YAML would write aliases
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
        raise ConfigurationError("scene", content, "dish, and shapes by name", source)
    for name, value in content.items():
        if name not in ("dish", "shapes"):
            raise ConfigurationError(str(name), value, "dish and shapes, nothing else", source)
    dish, shapes = dish_from_mapping(content["dish"], source), content.get("shapes")
    shapes = {} if shapes is None else shapes
    if not isinstance(shapes, Mapping):
        raise ConfigurationError("shapes", shapes, "shapes by name", source)
    if len(shapes) > MAX_SHAPES:
        raise ConfigurationError("shapes", f"{len(shapes)} shapes", f"at most {MAX_SHAPES}", source)
    made = tuple(shape_from_mapping(name, description, source) for name, description in shapes.items())
    with located(source):
        return Scene(dish, made)


def scene_to_mapping(scene: Scene) -> dict[str, Any]:
    """Return what a scene file holds for a scene; a shape without a definition as disc or polygon."""
    return {
        "dish": dish_to_mapping(scene.dish),
        "shapes": {shape.name: shape_to_mapping(shape) for shape in scene.shapes},
    }
