"""The shapes that a scene file knows, and the geometry that each stands for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.scene.scene import SceneShape

ARC_TOLERANCE = 2e-6  # m; greatest distance of an arc from its chords
MAX_ARC_STEP = math.pi / 18  # rad; of one chord
MAX_COORDINATE = 1.0  # m

Ring = tuple[tuple[float, float], ...]


class _Fields:
    """The fields of one shape's description, each taken once; what is left over is refused.

    Args:
        name: of the shape, for errors.
        values: as the file has them.
        source: the file.
    """

    def __init__(self, name: str, values: Any, source: str) -> None:
        if not isinstance(values, Mapping):
            raise ConfigurationError(name, values, "fields by name", source)
        self.name, self.source = name, source
        self._left = dict(values)
        self._known: list[str] = []

    def number(self, field: str, low: float, high: float, default: float | None = None) -> float:
        """Take a number within bounds."""
        value = self._take(field, default)
        if not _is_number(value) or not low <= float(value) <= high:
            raise self.refuse(field, value, f"a number from {low:g} to {high:g}")
        return float(value)

    def length(self, field: str, default: float | None = None) -> float:
        """Take a positive length [m]; with a default, 0 too."""
        low = 0.0 if default is not None else 1e-6
        return self.number(field, low, MAX_COORDINATE, default)

    def point(self, field: str) -> tuple[float, float]:
        """Take a point x, y [m]."""
        return _point(self, field, self._take(field))

    def rings(self, field: str, default: Sequence[Any] | None = None) -> list[Ring]:
        """Take a list of rings of points."""
        given = self._take(field, default)
        if not isinstance(given, Sequence) or isinstance(given, str):
            raise self.refuse(field, given, "a list of outlines, each a list of points [m]")
        return [_ring(self, f"{field}[{index}]", ring) for index, ring in enumerate(given)]

    def ring(self, field: str) -> Ring:
        """Take a closed outline of points."""
        return _ring(self, field, self._take(field))

    def end(self) -> None:
        """Refuse what nobody took."""
        for field, value in self._left.items():
            raise self.refuse(str(field), value, f"one of {', '.join(self._known)}")

    def refuse(self, field: str, value: Any, expectation: str) -> ConfigurationError:
        """Return the error for a field."""
        return ConfigurationError(f"{self.name}.{field}", value, expectation, self.source)

    def _take(self, field: str, default: Any = None) -> Any:
        self._known.append(field)
        if field not in self._left and default is None:
            raise self.refuse(field, None, "a value")
        return self._left.pop(field, default)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _point(fields: _Fields, field: str, value: Any) -> tuple[float, float]:
    fits = isinstance(value, Sequence) and len(value) == 2 and all(map(_is_number, value))
    if not fits or max(abs(part) for part in value) > MAX_COORDINATE:
        raise fields.refuse(field, value, f"two coordinates x, y of at most {MAX_COORDINATE:g} m")
    return float(value[0]), float(value[1])


def _ring(fields: _Fields, field: str, value: Any) -> Ring:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) < 3:
        raise fields.refuse(field, value, "at least 3 points x, y [m]")
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
    step = min(MAX_ARC_STEP, 2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))
    count = max(1, math.ceil(abs(end - start) / step - 1e-9))
    angles = np.linspace(start, end, count + 1)[: count if closed else count + 1]
    return [(center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles.tolist()]


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
    start = fields.number("start_angle", -2.0 * math.pi, 4.0 * math.pi)
    end = fields.number("end_angle", -2.0 * math.pi, 4.0 * math.pi)
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
    angle = fields.number("angle", -2.0 * math.pi, 2.0 * math.pi, 0.0)
    c, s = math.cos(angle), math.sin(angle)
    corners = [(0.5 * width * x, 0.5 * height * y) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return _rounded(
        Polygon(tuple((center[0] + c * x - s * y, center[1] + s * x + c * y) for x, y in corners)), corner_radius
    )


def _polygon(fields: _Fields, corner_radius: float) -> Polygon:
    return _rounded(Polygon(fields.ring("outline"), tuple(fields.rings("holes", ()))), corner_radius)


def _rounded(polygon: Polygon, corner_radius: float) -> Polygon:
    return polygon.smoothed(corner_radius) if corner_radius > 0.0 else polygon


def _opened(fields: _Fields, solid: shapely.Polygon, radius: float) -> Polygon:
    """Return a shape with its convex corners rounded: the union of all discs of a radius that fit into it."""
    segments = max(8, math.ceil(0.25 * 2.0 * math.pi / (2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))))
    opened = solid.buffer(-radius, quad_segs=segments).buffer(radius, quad_segs=segments)
    if not isinstance(opened, shapely.Polygon) or opened.is_empty:
        raise fields.refuse("corner_radius", radius, "a radius with which the shape stays in one piece [m]")
    return Polygon(tuple(opened.simplify(0.1 * ARC_TOLERANCE).exterior.coords))


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
    if not isinstance(description, Mapping):
        raise ConfigurationError(name, description, f"a shape, one of {', '.join(SHAPES)}", source)
    types = [key for key in description if key in SHAPES]
    unknown = [key for key in description if key not in (*SHAPES, "kind", "corner_radius")]
    if unknown or len(types) != 1:
        value = unknown[0] if unknown else types
        raise ConfigurationError(name, value, f"kind, corner_radius and one of {', '.join(SHAPES)}", source)
    type_name = types[0]
    radius = description.get("corner_radius", 0.0)
    if not _is_number(radius) or not 0.0 <= radius <= 0.1:
        raise ConfigurationError(f"{name}.corner_radius", radius, "a number from 0 to 0.1 m", source)
    if radius > 0.0 and type_name not in ROUNDABLE:
        raise ConfigurationError(f"{name}.corner_radius", radius, f"0: a {type_name} has no corners", source)
    fields = _Fields(f"{name}.{type_name}", description[type_name], source)
    kind = description.get("kind", "tissue")
    try:
        geometry = SHAPES[type_name](fields, float(radius))
        fields.end()
        if isinstance(geometry, Polygon):
            triangulate(geometry)
        return SceneShape(name, kind, geometry, dict(description))
    except ConfigurationError as error:
        if error.source or error.name.startswith(name):
            raise
        raise ConfigurationError(f"{name}.{error.name}", error.value, error.expectation, source) from None
