"""Scenes as GeoJSON, for drawing programs and viewers.

A FeatureCollection in the dish frame, in metres. Its member `dish` has diameter and depth. A polygon is a Polygon, a
disc a Point with the property `radius`; the properties `name`, `kind` and `corner_radius` are those of a scene file.
Geometry has its corners rounded already. The property `definition` keeps how a scene file describes the shape; it
counts only while it still describes the geometry, so that what was moved elsewhere stays moved.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import shapely
import shapely.geometry

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.scene.scene import MAX_SHAPES, Dish, Scene, SceneShape, scene_error
from magnetosuture_thread.scene.shapes import (
    DISH_FIELDS,
    dish_from_mapping,
    dish_to_mapping,
    make_scene,
    shape_from_mapping,
)

DISH = "dish"  # kind of the feature that is the dish
GEOMETRY_TOLERANCE = 1e-7  # m; drawing programs round coordinates to no less
PROPERTIES = ("name", "kind", "corner_radius", "friction", "radius", "definition", *DISH_FIELDS)


def scene_to_geojson(scene: Scene) -> dict[str, Any]:
    """Return a scene as a FeatureCollection."""
    return {
        "type": "FeatureCollection",
        "dish": dish_to_mapping(scene.dish),
        "features": [_feature(shape) for shape in scene.shapes],
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
    if not isinstance(content, Mapping) or content.get("type") != "FeatureCollection":
        given = content.get("type") if isinstance(content, Mapping) else content
        raise scene_error("type", given, "FeatureCollection, in metres in the dish frame", source)
    features = content.get("features")
    if not isinstance(features, Sequence) or isinstance(features, str):
        raise scene_error("features", features, "a list of features", source)
    if len(features) > MAX_SHAPES + 1:
        raise scene_error("features", f"{len(features)} features", f"at most {MAX_SHAPES} and the dish", source)
    dishes = [dish_from_mapping(content[DISH], source)] if DISH in content else []
    shapes: list[SceneShape] = []
    for index, feature in enumerate(features):
        where = f"features[{index}]"
        if not isinstance(feature, Mapping) or feature.get("type") != "Feature":
            raise scene_error(where, feature, "a Feature", source)
        properties, geometry = feature.get("properties"), feature.get("geometry")
        if not isinstance(properties, Mapping):
            raise scene_error(f"{where}.properties", properties, "properties, of which name is needed", source)
        for given in properties:
            close = difflib.get_close_matches(given[:40], PROPERTIES, n=1, cutoff=0.85)
            if given not in PROPERTIES and close:  # a spelling error; others may belong to any program
                expectation = f"no such property: {close[0]}?"
                raise scene_error(f"{where}.properties.{given}", properties[given], expectation, source)
        if not isinstance(geometry, Mapping):
            raise scene_error(f"{where}.geometry", geometry, "a Point, Polygon or MultiPolygon", source)
        if properties.get("kind") == DISH:
            dishes.append(_dish(properties, geometry, source))
        elif isinstance(name := properties.get("name"), str):
            shapes += _shapes(name, properties, geometry, source)
        else:
            raise scene_error(f"{where}.properties.name", name, "a name", source)
    if len(dishes) != 1:
        expectation = f"one: the member {DISH}, or a feature of kind {DISH}"
        raise scene_error(DISH, f"{len(dishes)} dishes" if dishes else "no dish", expectation, source)
    return make_scene(dishes[0], tuple(shapes), source)


def _feature(shape: SceneShape) -> dict[str, Any]:
    properties: dict[str, Any] = {"name": shape.name, "kind": shape.kind}
    if shape.friction:
        properties["friction"] = shape.friction
    if "corner_radius" in shape.definition:
        properties["corner_radius"] = shape.definition["corner_radius"]
    geometry = shape.geometry
    if isinstance(geometry, Disc):
        properties["radius"] = geometry.radius
        solid = shapely.Point(geometry.centre)
    else:
        solid = shapely.Polygon(geometry.outline, geometry.holes)
    if shape.definition:
        properties["definition"] = dict(shape.definition)
    return {"type": "Feature", "properties": properties, "geometry": shapely.geometry.mapping(solid)}


def _dish(properties: Mapping[str, Any], geometry: Mapping[str, Any], source: str) -> Dish:
    if geometry.get("type") != "Point" or _planar(geometry.get("coordinates")) != [0.0, 0.0]:
        raise scene_error(f"{DISH}.geometry", geometry, "a Point at 0, 0, the dish's centre", source)
    if properties.get("diameter") is None and properties.get("radius") is not None:
        raise scene_error(f"{DISH}.properties.radius", properties["radius"], "diameter, for a dish", source)
    return dish_from_mapping(
        {name: properties[name] for name in DISH_FIELDS if properties.get(name) is not None}, source
    )


def _shapes(name: str, properties: Mapping[str, Any], geometry: Mapping[str, Any], source: str) -> Iterator[SceneShape]:
    """Yield the shapes of a feature: one, or one for each part of a MultiPolygon."""
    kind, coordinates = geometry.get("type"), geometry.get("coordinates")
    common = {"kind": properties.get("kind") or "tissue"}
    common |= {key: properties[key] for key in ("friction", "corner_radius") if properties.get(key) is not None}
    if kind == "Point":
        common.pop("corner_radius", None)
        fields = {"center": _planar(coordinates), "radius": properties.get("radius")}
        yield _defined(shape_from_mapping(name, {**common, "disc": fields}, source), properties, source)
        return
    if kind not in ("Polygon", "MultiPolygon"):
        raise scene_error(f"{name}.geometry.type", kind, "Point, Polygon or MultiPolygon", source)
    parts: Any = [coordinates] if kind == "Polygon" else coordinates
    if not (_is_list(parts) and 0 < len(parts) <= MAX_SHAPES and all(_is_list(part) and part for part in parts)):
        raise scene_error(f"{name}.geometry.coordinates", parts, "lists of rings of points", source)
    for number, rings in enumerate(parts, 1):
        outline, *holes = ([_planar(p) for p in ring] if _is_list(ring) else ring for ring in rings)
        own = name if len(parts) == 1 else f"{name}_{number}"
        shape = shape_from_mapping(own, {**common, "polygon": {"outline": outline, "holes": holes}}, source)
        yield _defined(shape, properties, source) if len(parts) == 1 else shape


def _defined(shape: SceneShape, properties: Mapping[str, Any], source: str) -> SceneShape:
    """Return the shape of the property `definition`, where it still matches the geometry."""
    definition = properties.get("definition")
    if definition is None:
        return shape
    if not isinstance(definition, Mapping):
        raise scene_error(f"{shape.name}.properties.definition", definition, "a shape as in a scene file", source)
    defined = shape_from_mapping(shape.name, {**definition, "kind": shape.kind, "friction": shape.friction}, source)
    # Equal to the rounding of drawing programs.
    apart = defined.solid.symmetric_difference(shape.solid).area
    same = type(defined.geometry) is type(shape.geometry) and apart <= GEOMETRY_TOLERANCE * shape.solid.length
    return defined if same else shape


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _planar(position: Any) -> Any:
    """Return a position without its height; anything else unchanged, to be refused."""
    return list(position[:2]) if _is_list(position) and len(position) in (2, 3) else position
