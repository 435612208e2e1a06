"""GeoJSON: what other programs draw is read, and what we write is what they expect."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import shapely
import shapely.geometry

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.geometry.scene_files import read_scene, scene_from_geojson, scene_to_geojson
from magnetosuture_thread.settings.errors import ConfigurationError
from test.geometry.scene.scenes import every_shape
from test.shared import check_refused

SQUARE = [[0.0, 0.0], [0.01, 0.0], [0.01, 0.01], [0.0, 0.01], [0.0, 0.0]]
DISH = {"diameter": 0.05, "depth": 0.004}


def collection(*features: Any, **members: Any) -> dict[str, Any]:
    """Return a FeatureCollection."""
    return {"type": "FeatureCollection", "dish": DISH, "features": list(features), **members}


def feature(geometry: Any, **properties: Any) -> dict[str, Any]:
    """Return a feature; of a geometry, or of a ring."""
    geometry = geometry if isinstance(geometry, dict) else {"type": "Polygon", "coordinates": [geometry]}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def test_what_is_written_is_geojson_that_any_program_can_draw():
    scene = every_shape()
    written = json.loads(json.dumps(scene_to_geojson(scene), allow_nan=False))
    assert written["type"] == "FeatureCollection"
    assert written["dish"] == DISH
    for shape, entry in zip(scene.shapes, written["features"], strict=True):
        drawn = shapely.geometry.shape(entry["geometry"])
        assert entry["type"] == "Feature"
        assert entry["properties"]["name"] == shape.name
        assert entry["properties"]["kind"] == shape.kind
        if isinstance(shape.geometry, Disc):
            assert (drawn.geom_type, entry["properties"]["radius"]) == ("Point", 0.0015)
            continue
        assert drawn.is_valid
        assert drawn.area == pytest.approx(shape.geometry.area, rel=1e-12)
        assert drawn.exterior.is_closed
        assert drawn.exterior.is_ccw  # as RFC 7946 has it
        assert not any(ring.is_ccw for ring in drawn.interiors)
    corner_radii = [entry["properties"].get("corner_radius") for entry in written["features"]]
    assert corner_radii == [None, None, 0.0006, None, None, 0.0001]


def test_a_file_drawn_elsewhere_is_read():
    content = collection(
        feature([[*point, 0.7] for point in SQUARE], name="left", fid=3, fill="#ff0000"),
        feature({"type": "Point", "coordinates": [0.001, -0.002, 0.0]}, name="post", radius=0.002, kind="instrument"),
        name="my layer",
        crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
        bbox=[0, 0, 1, 1],
    )
    scene = scene_from_geojson(content)
    assert scene.dish == Dish(0.05, 0.004)
    assert scene.names == ("left", "post")
    assert [shape.kind for shape in scene.shapes] == ["tissue", "instrument"]
    assert scene.obstacles == (Polygon(tuple((x, y) for x, y in SQUARE)), Disc((0.001, -0.002), 0.002))
    soft = scene_from_geojson(collection(feature(SQUARE, name="left", corner_radius=0.001)))
    geometry = soft.obstacles[0]
    assert isinstance(geometry, Polygon)
    assert geometry.area == pytest.approx(1e-4 - (4.0 - math.pi) * 1e-6, rel=1e-4)


def test_the_dish_may_be_a_feature():
    dish = feature({"type": "Point", "coordinates": [0.0, 0.0]}, kind="dish", diameter=0.05, depth=0.004)
    content = collection(dish, feature(SQUARE, name="left"))
    del content["dish"]
    assert scene_from_geojson(content) == scene_from_geojson(collection(feature(SQUARE, name="left")))


def test_a_multipolygon_of_one_is_a_polygon_and_of_several_several():
    other = [[-x, -y] for x, y in SQUARE]
    one = feature({"type": "MultiPolygon", "coordinates": [[SQUARE]]}, name="left")
    two = feature({"type": "MultiPolygon", "coordinates": [[SQUARE], [other]]}, name="side", kind="wall")
    scene = scene_from_geojson(collection(one, two))
    assert scene.names == ("left", "side_1", "side_2")
    assert [shape.kind for shape in scene.shapes] == ["tissue", "wall", "wall"]
    assert scene.obstacles[0] == scene.obstacles[1]
    assert scene.obstacles[2] == Polygon(tuple((x, y) for x, y in other))


def test_a_definition_counts_until_the_geometry_is_moved():
    """Who edits the file elsewhere moves points and knows nothing of the definition."""
    scene = every_shape()
    content = scene_to_geojson(scene)
    rounded = json.loads(json.dumps(content), parse_float=lambda digits: round(float(digits), 7))
    again = scene_from_geojson(rounded)
    assert [bool(shape.definition) for shape in again.shapes] == [True] * 6
    assert again.shapes[1].definition == scene.shapes[1].definition
    moved = json.loads(json.dumps(content))
    for entry in moved["features"]:
        geometry = shapely.affinity.translate(shapely.geometry.shape(entry["geometry"]), 0.0005, 0.0)
        entry["geometry"] = shapely.geometry.mapping(geometry)
    for before, after in zip(scene.shapes, scene_from_geojson(moved).shapes, strict=True):
        shifted = shapely.affinity.translate(before.solid, 0.0005, 0.0)
        assert shifted.symmetric_difference(after.solid).area < 1e-9 * shifted.length
        assert not set(after.definition) - {"disc", "polygon", "corner_radius"}


POINT = {"type": "Point", "coordinates": [0, 0]}
BAD: list[tuple[Any, str]] = [
    (feature(SQUARE, name="a"), "type: got 'Feature', expected FeatureCollection"),
    (collection(feature(SQUARE)), "features[0].properties.name: got None"),
    (collection(feature({"type": "LineString"}, name="a")), "features[0].geometry: got {'type': 'LineString'}, "),
    *[
        (collection(feature([[x, 0.0], *SQUARE[1:4], [x, 0.0]], name="a")), "features[0].geometry: got {")
        for x in ("0.0", True, None, 10**400, math.inf)
    ],
    (collection(feature([[10.2, 47.1]] * 4, name="a")), "a.polygon.outline[0]: got [10.2, 47.1]"),
    (collection(dish={"diameter": math.nan}), "dish.diameter: got nan"),
    ({"type": "FeatureCollection", "features": []}, "dish: got 'no dish'"),
    (collection(feature(POINT, kind="dish", radius=0.05)), "dish.properties.radius: got 0.05, expected diameter"),
]
NO_JSON = [
    ('{"type": 1, "type": "FeatureCollection"}', "scene file: got 'type is given twice', expected valid JSON"),
    ("9" * 5000, "scene file: got 'Exceeds the limit"),
    ("[" * 100_000, "scene file: got 'maximum recursion depth exceeded"),
]


@pytest.mark.parametrize(
    ("text", "words"), [*((json.dumps(content), words) for content, words in BAD), *NO_JSON], ids=lambda text: text[:40]
)
def test_bad_geojson_is_refused_in_one_line_that_names_file_feature_and_field(tmp_path: Path, text: str, words: str):
    path = tmp_path / "bad.geojson"
    path.write_text(text)
    check_refused(ConfigurationError, lambda: read_scene(str(path)), f"{path}: {words}", most=500 + len(str(path)))


@pytest.mark.parametrize(("features", "parts"), [(1, 5000), (100, 50)])
def test_more_parts_than_a_scene_may_have_are_refused(features: int, parts: int):
    several = {"type": "MultiPolygon", "coordinates": [[SQUARE]] * parts}
    with pytest.raises(ConfigurationError, match="shapes: got '201 shapes', expected at most 200"):
        scene_from_geojson(collection(*[feature(several, name=f"a{index}") for index in range(features)]))
