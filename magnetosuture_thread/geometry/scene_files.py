"""Scene files in YAML or GeoJSON: their fields, checked, the geometry that they describe, and their editing.

dish: {diameter: 0.05, depth: 0.004}     # [m]
shapes:
  ring: {annulus: {center: [0.0, 0.005], inner_radius: 0.0045, outer_radius: 0.006}, kind: tissue}

A GeoJSON file, for drawing programs and viewers, is a FeatureCollection in the dish frame, in metres. Its member `dish`
has diameter and depth. A polygon is a Polygon, a disc a Point with the property `radius`; the properties `name`,
`kind`, `friction` and `corner_radius` are those of a scene file. Geometry has its corners rounded already. The property
`definition` keeps how a scene file describes the shape; it counts only while it still describes the geometry, so that
what was moved elsewhere stays moved.
"""

from __future__ import annotations

import difflib
import inspect
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import shapely
import shapely.geometry
import yaml

from magnetosuture_thread.geometry.scene import (
    MAX_COORDINATE,
    MAX_NAME_CHARS,
    MAX_OUTLINES,
    MAX_SHAPES,
    MAX_VERTICES,
    MIN_EDGE,
    Dish,
    Scene,
    SceneShape,
    is_name,
    is_number,
)
from magnetosuture_thread.geometry.shapes import Disc, Polygon, Ring, Vertex, triangulate
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import bounded, errors_of_file, read_yaml, suggest_names
from magnetosuture_thread.settings.errors import BagError, ConfigurationError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, find_file, read_regular, whole_file

GEOJSON_ENDINGS = (".json", ".geojson")
COMMON = ("kind", "corner_radius", "friction")  # fields of all shapes
DISH_FIELDS = tuple(field.name for field in fields(Dish))
PROPERTIES = ("name", *COMMON, "radius", "definition", *DISH_FIELDS)
ARC_TOLERANCE = 2e-6  # m; greatest distance of an arc from its chords


def is_list(value: Any) -> bool:
    """Return whether a value is a list, and no text."""
    return isinstance(value, Sequence) and not isinstance(value, str)


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
    low, high, unit = 0.0 if field == "inset" else 1e-6, MAX_COORDINATE, "m"
    if field.endswith("angle"):
        low, high, unit = -2.0 * math.pi, (2.0 if field == "angle" else 4.0) * math.pi, "rad"
    return bounded(unit, low, high).checked(name, value)


def _point(name: str, value: Any) -> Vertex:
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


def _arc(center: Vertex, radius: float, start: float, end: float) -> list[Vertex]:
    """Return points on an arc from angle to angle [rad], so many that its chords are within `ARC_TOLERANCE` of it."""
    count = max(1, math.ceil(abs(end - start) / _arc_step(radius) - 1e-9))
    return _points_on_circle(center, radius, np.linspace(start, end, count + 1).tolist())


def _circle(center: Vertex, radius: float) -> Ring:
    """Return a circle as a polygon that reaches as far along x and y."""
    count = 4 * math.ceil(math.ceil(2.0 * math.pi / _arc_step(radius) - 1e-9) / 4)
    return tuple(_points_on_circle(center, radius, np.linspace(0.0, 2.0 * math.pi, count + 1)[:-1].tolist()))


def _points_on_circle(center: Vertex, radius: float, angles: list[float]) -> list[Vertex]:
    return [_rounded_point(center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles]


def _arc_step(radius: float) -> float:
    """Return the angle of a chord that is within `ARC_TOLERANCE` of its arc, at most 10 degrees [rad]."""
    return min(math.pi / 18, 2.0 * math.acos(max(0.0, 1.0 - ARC_TOLERANCE / radius)))


def _rounded_point(x: float, y: float) -> Vertex:
    """Return a computed point to 1e-12 m: what machines compute differently is far below, and scenes stay equal."""
    return round(x, 12) + 0.0, round(y, 12) + 0.0  # + 0.0 makes a negative zero a zero


# One function a shape, which a scene file names; its arguments are the fields, each with one meaning in all shapes.


def disc(center: Vertex, radius: float) -> Disc:
    """Return a disc."""
    return Disc(center, radius)


def annulus(center: Vertex, inner_radius: float, outer_radius: float) -> Polygon:
    """Return a disc with a round hole in its middle."""
    _require_order("annulus", inner_radius, outer_radius)
    return Polygon(_circle(center, outer_radius), (_circle(center, inner_radius),))


def annular_sector(
    center: Vertex,
    inner_radius: float,
    outer_radius: float,
    start_angle: float,
    end_angle: float,
    inset: float = 0.0,
    corner_radius: float = 0.0,
) -> Polygon:
    """Return the part of an annulus between two angles, less a strip of width `inset` along both straight sides."""
    _require_order("annular_sector", inner_radius, outer_radius)
    if not 0.0 < end_angle - start_angle < 2.0 * math.pi:
        expectation = "more than start_angle by less than a turn [rad]"
        raise ConfigurationError("annular_sector.end_angle", end_angle, expectation)
    if inset >= inner_radius:
        raise ConfigurationError("annular_sector.inset", inset, f"less than inner_radius, {inner_radius:g} m")
    inner_trim, outer_trim = math.asin(inset / inner_radius), math.asin(inset / outer_radius)
    if end_angle - start_angle <= 2.0 * inner_trim:
        raise ConfigurationError("annular_sector.inset", inset, "less than half of the gap between both straight sides")
    outline = [
        *_arc(center, outer_radius, start_angle + outer_trim, end_angle - outer_trim),
        *_arc(center, inner_radius, end_angle - inner_trim, start_angle + inner_trim),
    ]
    if corner_radius == 0.0:
        return Polygon(tuple(outline))
    # Its convex corners rounded: the union of all discs of the radius that fit into it.
    segments = max(8, math.ceil(0.25 * math.pi / math.acos(max(0.0, 1.0 - ARC_TOLERANCE / corner_radius))))
    inner = shapely.Polygon(outline).buffer(-corner_radius, quad_segs=segments)
    opened = inner.buffer(corner_radius, quad_segs=segments)
    if not isinstance(opened, shapely.Polygon) or opened.is_empty:
        raise ConfigurationError("corner_radius", corner_radius, "a radius with which the shape stays in one piece [m]")
    # Two arcs may end a hair apart; what is removed is shorter than what contacts resolve.
    drawn = shapely.remove_repeated_points(opened.simplify(0.1 * ARC_TOLERANCE), MIN_EDGE)
    return Polygon(tuple(_rounded_point(x, y) for x, y in drawn.exterior.coords))


def _require_order(name: str, inner_radius: float, outer_radius: float) -> None:
    if inner_radius >= outer_radius:
        raise ConfigurationError(f"{name}.inner_radius", inner_radius, f"less than outer_radius, {outer_radius:g} m")


def capsule(start: Vertex, end: Vertex, radius: float) -> Polygon:
    """Return all points that are no farther than a radius from a segment."""
    if start == end:
        raise ConfigurationError("capsule.end", list(end), "another point than start; else it is a disc")
    along, quarter = math.atan2(end[1] - start[1], end[0] - start[0]), 0.5 * math.pi
    front = _arc(end, radius, along - quarter, along + quarter)
    return Polygon((*front, *_arc(start, radius, along + quarter, along + 3.0 * quarter)))


def rectangle(center: Vertex, width: float, height: float, angle: float = 0.0, corner_radius: float = 0.0) -> Polygon:
    """Return a rectangle, turned by an angle counter-clockwise."""
    greatest = 0.49 * min(width, height)
    if corner_radius > greatest:
        expectation = f"at most 0.49 of the shorter side, {greatest:.4g} m"
        raise ConfigurationError("corner_radius", corner_radius, expectation)
    c, s = math.cos(angle), math.sin(angle)
    corners = [(0.5 * width * x, 0.5 * height * y) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    outline = tuple(_rounded_point(center[0] + c * x - s * y, center[1] + s * x + c * y) for x, y in corners)
    return _rounded(Polygon(outline), corner_radius)


def polygon(outline: Ring, holes: tuple[Ring, ...] = (), corner_radius: float = 0.0) -> Polygon:
    """Return a polygon; a corner at an edge too short for the corner radius gets a smaller one."""
    sharp = Polygon(outline, holes)
    if corner_radius > 0.0 and not Polygon(sharp.outline).can_contain(corner_radius):
        expectation = "a radius of which a disc fits into the outline [m]"
        raise ConfigurationError("corner_radius", corner_radius, expectation)
    return _rounded(sharp, corner_radius)


def _rounded(sharp: Polygon, corner_radius: float) -> Polygon:
    """Return a polygon with arcs in the place of its corners; its other vertices stay as they are."""
    if corner_radius == 0.0:
        return sharp
    smooth = sharp.smoothed(corner_radius, step=_arc_step(corner_radius))
    kept = {vertex for ring in (sharp.outline, *sharp.holes) for vertex in ring}
    outline, *holes = (
        tuple(vertex if vertex in kept else _rounded_point(*vertex) for vertex in ring)
        for ring in (smooth.outline, *smooth.holes)
    )
    return Polygon(outline, tuple(holes))


SHAPES: dict[str, Callable[..., Disc | Polygon]] = {
    shape.__name__: shape for shape in (disc, annulus, annular_sector, capsule, rectangle, polygon)
}


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
    with errors_of_file(source, f"{name}."):
        geometry = _geometry(types[0], description[types[0]], description.get("corner_radius", 0.0))
    # A copy in the types that YAML and JSON can write, whatever numbers and lists it has.
    definition = {key: value for key, value in description.items() if key not in ("kind", "friction")}
    kind, friction = description.get("kind", "tissue"), description.get("friction", 0.0)
    with errors_of_file(source):
        return SceneShape(name, kind, geometry, json.loads(json.dumps(definition)), friction)


def _geometry(type_name: str, values: Any, corner_radius: Any) -> Disc | Polygon:
    """Return the geometry of a shape's fields, checked; those with a default may be left out."""
    defaults = {name: argument.default for name, argument in inspect.signature(SHAPES[type_name]).parameters.items()}
    if not is_number(corner_radius) or not 0.0 <= corner_radius <= 0.1:
        raise ConfigurationError("corner_radius", corner_radius, "a number from 0 to 0.1 m")
    rounded = {"corner_radius": float(corner_radius)} if defaults.pop("corner_radius", None) is not None else {}
    if corner_radius > 0.0 and not rounded:
        raise ConfigurationError("corner_radius", corner_radius, f"0 m: a {type_name} has no corners")
    if not isinstance(values, Mapping):
        raise ConfigurationError(type_name, values, "fields by name")
    for field, value in values.items():
        if field not in defaults:
            raise ConfigurationError(f"{type_name}.{field}", value, suggest_names(str(field), list(defaults)))
    missing = {field: None if default is inspect.Parameter.empty else default for field, default in defaults.items()}
    checked = {field: _read_field(f"{type_name}.{field}", field, {**missing, **values}[field]) for field in defaults}
    geometry = SHAPES[type_name](**checked, **rounded)
    if isinstance(geometry, Polygon):
        triangulate(geometry)
    return geometry


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
    with errors_of_file(source):
        return Dish(**values)


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
    named = tuple(shape_from_mapping(name, description, source) for name, description in shapes.items())
    with errors_of_file(source):
        return Scene(dish, named)


def _dish_to_mapping(dish: Dish) -> dict[str, float | bool]:
    defaults = {"wall_friction": 0.0, "self_contact": None}
    return {name: value for name, value in asdict(dish).items() if name not in defaults or value != defaults[name]}


def _shape_to_mapping(shape: SceneShape) -> dict[str, Any]:
    common: dict[str, Any] = {"kind": shape.kind, **({"friction": shape.friction} if shape.friction else {})}
    if shape.definition:
        return {**deepcopy(dict(shape.definition)), **common}  # a copy, as YAML would write aliases
    geometry = shape.geometry
    if isinstance(geometry, Disc):
        return {"disc": {"center": list(geometry.centre), "radius": geometry.radius}, **common}
    outline, *holes = ([list(point) for point in ring] for ring in (geometry.outline, *geometry.holes))
    return {"polygon": {"outline": outline, **({"holes": holes} if holes else {})}, **common}


def scene_to_mapping(scene: Scene) -> dict[str, Any]:
    """Return what a scene file holds for a scene; a shape without a definition as disc or polygon."""
    shapes = {shape.name: _shape_to_mapping(shape) for shape in scene.shapes}
    return {"dish": _dish_to_mapping(scene.dish), "shapes": shapes}


def scene_to_geojson(scene: Scene) -> dict[str, Any]:
    """Return a scene as a FeatureCollection."""
    features = [_feature(shape) for shape in scene.shapes]
    return {"type": "FeatureCollection", "dish": _dish_to_mapping(scene.dish), "features": features}


def _feature(shape: SceneShape) -> dict[str, Any]:
    geometry = shape.geometry
    properties = {
        "name": shape.name,
        "kind": shape.kind,
        "friction": shape.friction or None,
        "corner_radius": shape.definition.get("corner_radius"),
        "radius": geometry.radius if isinstance(geometry, Disc) else None,
        "definition": dict(shape.definition) or None,
    }
    drawn = shapely.Point(geometry.centre) if isinstance(geometry, Disc) else geometry.solid
    return {
        "type": "Feature",
        "properties": {name: value for name, value in properties.items() if value is not None},
        "geometry": shapely.geometry.mapping(drawn),
    }


def scene_from_geojson(content: Any, source: str = "") -> Scene:
    """Return a scene from a FeatureCollection.

    The dish is the member `dish`, or a feature of kind `dish`: a Point at the origin with the property `diameter`,
    and `depth` if it is known. Of a MultiPolygon with several parts each becomes a shape, named `name_1`, `name_2`
    and so on. Other geometry is refused. Unknown properties belong to other programs and are ignored.

    Args:
        content: what the file holds.
        source: its name, for errors.

    Raises:
        ConfigurationError: anything in it is missing or out of bounds.
    """
    kind = content.get("type") if isinstance(content, Mapping) else content
    if kind != "FeatureCollection":
        raise ConfigurationError("type", kind, "FeatureCollection, in metres in the dish frame", source)
    features = content.get("features")
    if not is_list(features) or len(features) > MAX_SHAPES + 1:
        value = f"{len(features)} features" if is_list(features) else features
        raise ConfigurationError("features", value, f"a list of at most {MAX_SHAPES} features and the dish", source)
    dishes = [dish_from_mapping(content["dish"], source)] if "dish" in content else []
    shapes: list[SceneShape] = []
    for index, feature in enumerate(features):
        where = f"features[{index}]"
        properties, solid = _checked_feature(where, feature, source)
        if properties.get("kind") == "dish":
            dishes.append(_dish(properties, solid, source))
        elif isinstance(name := properties.get("name"), str):
            # One too many is refused below; 40,000 would take 15 s to make.
            shapes += islice(_shapes(name, properties, solid, source), MAX_SHAPES + 1 - len(shapes))
        else:
            raise ConfigurationError(f"{where}.properties.name", name, "a name", source)
    if len(dishes) != 1:
        count = f"{len(dishes)} dishes" if dishes else "no dish"
        raise ConfigurationError("dish", count, "one: the member dish, or a feature of kind dish", source)
    with errors_of_file(source):
        return Scene(dishes[0], tuple(shapes))


def _checked_feature(where: str, feature: Any, source: str) -> tuple[Mapping[str, Any], shapely.Geometry]:
    """Return properties and geometry of a feature, whose names of properties are those of ours or far from them."""
    properties = feature.get("properties") if isinstance(feature, Mapping) else None
    if not isinstance(properties, Mapping) or feature.get("type") != "Feature":
        raise ConfigurationError(where, feature, "a Feature with properties, of which name is needed", source)
    for name in properties:
        close = difflib.get_close_matches(name[:40], PROPERTIES, n=1, cutoff=0.85)
        if name not in PROPERTIES and close:  # a spelling error; others may belong to any program
            expectation = f"no such property: {close[0]}?"
            raise ConfigurationError(f"{where}.properties.{name}", properties[name], expectation, source)
    solid = None
    try:
        if _holds_numbers(feature["geometry"]["coordinates"]):
            solid = shapely.force_2d(shapely.geometry.shape(feature["geometry"]))
    except Exception:  # shapely raises whatever the content makes it stumble over.
        pass
    if solid is None or solid.is_empty or solid.geom_type not in ("Point", "Polygon", "MultiPolygon"):
        expectation = "a Point, Polygon or MultiPolygon"
        raise ConfigurationError(f"{where}.geometry", feature.get("geometry"), expectation, source)
    return properties, solid


def _holds_numbers(coordinates: Any) -> bool:
    """Return whether coordinates are numbers throughout: shapely takes texts and booleans for numbers too."""
    return all(map(_holds_numbers, coordinates)) if is_list(coordinates) else is_number(coordinates)


def _dish(properties: Mapping[str, Any], solid: shapely.Geometry, source: str) -> Dish:
    if solid != shapely.Point(0.0, 0.0):
        raise ConfigurationError("dish.geometry", solid.wkt, "a Point at 0, 0, the dish's centre", source)
    if properties.get("diameter") is None and properties.get("radius") is not None:
        raise ConfigurationError("dish.properties.radius", properties["radius"], "diameter, for a dish", source)
    return dish_from_mapping(_set(properties, DISH_FIELDS), source)


def _set(properties: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return those properties of some names that are not null."""
    return {name: properties[name] for name in names if properties.get(name) is not None}


def _shapes(name: str, properties: Mapping[str, Any], solid: shapely.Geometry, source: str) -> Iterator[SceneShape]:
    """Yield the shapes of a feature: one, or one for each part of a MultiPolygon."""
    common = {"kind": properties.get("kind") or "tissue", **_set(properties, ("friction", "corner_radius"))}
    if solid.geom_type == "Point":
        common.pop("corner_radius", None)
        values = {"center": [solid.x, solid.y], "radius": properties.get("radius")}
        yield _defined(shape_from_mapping(name, {**common, "disc": values}, source), properties, source)
        return
    parts = getattr(solid, "geoms", [solid])
    for number, part in enumerate(parts, 1):
        outline, *holes = ([list(point) for point in ring.coords] for ring in (part.exterior, *part.interiors))
        part_name = name if len(parts) == 1 else f"{name}_{number}"
        description = {**common, "polygon": {"outline": outline, "holes": holes}}
        shape = shape_from_mapping(part_name, description, source)
        yield _defined(shape, properties, source) if len(parts) == 1 else shape


def _defined(shape: SceneShape, properties: Mapping[str, Any], source: str) -> SceneShape:
    """Return the shape of the property `definition`, where it still matches the geometry."""
    definition = properties.get("definition")
    if definition is None:
        return shape
    if not isinstance(definition, Mapping):
        expectation = "a shape as in a scene file"
        raise ConfigurationError(f"{shape.name}.properties.definition", definition, expectation, source)
    defined = shape_from_mapping(shape.name, {**definition, "kind": shape.kind, "friction": shape.friction}, source)
    apart = defined.solid.symmetric_difference(shape.solid).area
    # 1e-7 m: drawing programs round coordinates to no less.
    same = type(defined.geometry) is type(shape.geometry) and apart <= 1e-7 * shape.solid.length
    return defined if same else shape


def read_scene(name: str) -> Scene:
    """Read a scene, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file, it is no regular file of at most 4 MB, or it holds anything
            invalid.
    """
    path = find_file("scene", name)
    source = str(path)
    if path.suffix not in GEOJSON_ENDINGS:
        return scene_from_mapping(read_yaml(path, "scene file", plain=True), source)
    try:
        text = read_regular(path, MAX_TEXT_BYTES).decode("utf-8-sig")
        return scene_from_geojson(json.loads(text, object_pairs_hook=_once), source)
    except OSError as error:
        problem = error.strerror or str(error)
        raise ConfigurationError("scene file", problem, "a readable GeoJSON file", source) from None
    except (ValueError, RecursionError) as error:  # no text, no JSON, a number of thousands of digits, lists too deep
        raise ConfigurationError("scene file", str(error), "valid JSON", source) from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a mapping of JSON, each of whose names is given once."""
    mapping: dict[str, Any] = {}
    for name, value in pairs:
        if name in mapping:
            raise ValueError(f"{name} is given twice")
        mapping[name] = value
    return mapping


def write_scene(scene: Scene, path: Path) -> None:
    """Write a scene file: GeoJSON where its name ends in .json or .geojson, else YAML. It is whole or not there.

    Raises:
        ConfigurationError: it cannot be written.
    """
    if path.suffix in GEOJSON_ENDINGS:
        text = json.dumps(scene_to_geojson(scene), indent=1, allow_nan=False) + "\n"
    else:
        text = yaml.safe_dump(scene_to_mapping(scene), sort_keys=False, default_flow_style=None, width=120)
    try:
        with whole_file(path) as partial:
            partial.write_text(text, encoding="utf-8")
    except BagError as error:
        raise ConfigurationError("scene file", error.problem, "a file that can be written", str(path)) from None


@dataclass(frozen=True)
class SceneServerSettings(shared.LifecycleSettings, shared.SceneName):
    """The scene that is published first."""

    GROUP: ClassVar[str] = "scene_server"
