"""Scene files in YAML or GeoJSON, and their editing.

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
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import shapely
import shapely.geometry
import yaml

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import MAX_SHAPES, Dish, Scene, SceneShape, is_number
from magnetosuture_thread.geometry.scene_shapes import (
    DISH_FIELDS,
    dish_from_mapping,
    dish_to_mapping,
    is_list,
    located,
    scene_from_mapping,
    scene_to_mapping,
    shape_from_mapping,
)
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import read_yaml
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, find_file, output_problem, read_regular

GEOJSON_ENDINGS = (".json", ".geojson")
DISH = "dish"  # kind of the feature that is the dish
GEOMETRY_TOLERANCE = 1e-7  # m; drawing programs round coordinates to no less
PROPERTIES = ("name", "kind", "corner_radius", "friction", "radius", "definition", *DISH_FIELDS)


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
    problem = output_problem(path)
    if not problem:
        partial = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            partial.write_text(text, encoding="utf-8")
            partial.replace(path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            problem = error.strerror or str(error)
    if problem:
        raise ConfigurationError("scene file", problem, "a file that can be written", str(path))


def scene_to_geojson(scene: Scene) -> dict[str, Any]:
    """Return a scene as a FeatureCollection."""
    return {
        "type": "FeatureCollection",
        "dish": dish_to_mapping(scene.dish),
        "features": [_feature(shape) for shape in scene.shapes],
    }


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
        solid = geometry.solid
    if shape.definition:
        properties["definition"] = dict(shape.definition)
    return {"type": "Feature", "properties": properties, "geometry": shapely.geometry.mapping(solid)}


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
        given = f"{len(features)} features" if is_list(features) else features
        raise ConfigurationError("features", given, f"a list of at most {MAX_SHAPES} features and the dish", source)
    dishes = [dish_from_mapping(content[DISH], source)] if DISH in content else []
    shapes: list[SceneShape] = []
    for index, feature in enumerate(features):
        where = f"features[{index}]"
        properties, solid = _checked_feature(where, feature, source)
        if properties.get("kind") == DISH:
            dishes.append(_dish(properties, solid, source))
        elif isinstance(name := properties.get("name"), str):
            # One too many is refused below; 40,000 would take 15 s to make.
            shapes += islice(_shapes(name, properties, solid, source), MAX_SHAPES + 1 - len(shapes))
        else:
            raise ConfigurationError(f"{where}.properties.name", name, "a name", source)
    if len(dishes) != 1:
        expectation = f"one: the member {DISH}, or a feature of kind {DISH}"
        raise ConfigurationError(DISH, f"{len(dishes)} dishes" if dishes else "no dish", expectation, source)
    with located(source):
        return Scene(dishes[0], tuple(shapes))


def _checked_feature(where: str, feature: Any, source: str) -> tuple[Mapping[str, Any], shapely.Geometry]:
    """Return properties and geometry of a feature, whose names of properties are those of ours or far from them."""
    properties = feature.get("properties") if isinstance(feature, Mapping) else None
    if not isinstance(properties, Mapping) or feature.get("type") != "Feature":
        raise ConfigurationError(where, feature, "a Feature with properties, of which name is needed", source)
    for given in properties:
        close = difflib.get_close_matches(given[:40], PROPERTIES, n=1, cutoff=0.85)
        if given not in PROPERTIES and close:  # a spelling error; others may belong to any program
            expectation = f"no such property: {close[0]}?"
            raise ConfigurationError(f"{where}.properties.{given}", properties[given], expectation, source)
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
        raise ConfigurationError(f"{DISH}.geometry", solid.wkt, "a Point at 0, 0, the dish's centre", source)
    if properties.get("diameter") is None and properties.get("radius") is not None:
        raise ConfigurationError(f"{DISH}.properties.radius", properties["radius"], "diameter, for a dish", source)
    given = {name: properties[name] for name in DISH_FIELDS if properties.get(name) is not None}
    return dish_from_mapping(given, source)


def _shapes(name: str, properties: Mapping[str, Any], solid: shapely.Geometry, source: str) -> Iterator[SceneShape]:
    """Yield the shapes of a feature: one, or one for each part of a MultiPolygon."""
    common = {"kind": properties.get("kind") or "tissue"}
    common |= {key: properties[key] for key in ("friction", "corner_radius") if properties.get(key) is not None}
    if solid.geom_type == "Point":
        common.pop("corner_radius", None)
        fields = {"center": [solid.x, solid.y], "radius": properties.get("radius")}
        yield _defined(shape_from_mapping(name, {**common, "disc": fields}, source), properties, source)
        return
    parts = getattr(solid, "geoms", [solid])
    for number, part in enumerate(parts, 1):
        outline, *holes = ([list(point) for point in ring.coords] for ring in (part.exterior, *part.interiors))
        own = name if len(parts) == 1 else f"{name}_{number}"
        shape = shape_from_mapping(own, {**common, "polygon": {"outline": outline, "holes": holes}}, source)
        yield _defined(shape, properties, source) if len(parts) == 1 else shape


def _defined(shape: SceneShape, properties: Mapping[str, Any], source: str) -> SceneShape:
    """Return the shape of the property `definition`, where it still matches the geometry."""
    definition = properties.get("definition")
    if definition is None:
        return shape
    if not isinstance(definition, Mapping):
        raise ConfigurationError(
            f"{shape.name}.properties.definition", definition, "a shape as in a scene file", source
        )
    defined = shape_from_mapping(shape.name, {**definition, "kind": shape.kind, "friction": shape.friction}, source)
    # Equal to the rounding of drawing programs.
    apart = defined.solid.symmetric_difference(shape.solid).area
    same = type(defined.geometry) is type(shape.geometry) and apart <= GEOMETRY_TOLERANCE * shape.solid.length
    return defined if same else shape


@dataclass(frozen=True)
class SceneServerSettings(shared.LifecycleSettings, shared.SceneName):
    """The scene that is published first."""

    GROUP: ClassVar[str] = "scene_server"


class SceneEditor:
    """Holds the active scene and edits it; an invalid edit leaves it unchanged.

    Args:
        scene: the initial scene; None until one is loaded.

    Attributes:
        scene: the active scene.

    Each edit raises `ConfigurationError` where it is invalid, whatever the text.
    """

    def __init__(self, scene: Scene | None = None) -> None:
        self.scene = scene

    def load(self, file: str) -> None:
        """Load the scene of a file, given as a path or as the name of one that ships with the package."""
        if len(file) > 4096:
            raise ConfigurationError("file", f"{len(file)} characters", "at most 4096")
        self.scene = read_scene(file)

    def add(self, shape: SceneShape) -> None:
        """Append a shape."""
        self.scene = self._require_scene().add(shape)

    def replace(self, shape: SceneShape) -> None:
        """Replace the shape of the same name."""
        self.scene = self._require_scene().replace(shape)

    def remove(self, name: str) -> None:
        """Remove a shape."""
        self.scene = self._require_scene().remove(name)

    def _require_scene(self) -> Scene:
        if self.scene is None:
            expectation = "a scene that is loaded first, of which the dish is known"
            raise ConfigurationError("scene", "a change of a shape", expectation)
        return self.scene
