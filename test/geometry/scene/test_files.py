"""Scene files: what is written is read back the same, and what is no scene is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.geometry.scene_files import read_scene, write_scene
from magnetosuture_thread.settings.errors import ConfigurationError
from test.geometry.scene.scenes import SHAPES, every_shape
from test.shared import check_refused

DISH = "dish: {diameter: 0.035, depth: 0.003}\n"


@pytest.mark.parametrize("ending", [".yaml", ".yml", ".json", ".geojson"])
def test_a_written_scene_is_read_back_with_version_and_definitions(tmp_path: Path, ending: str):
    scene, path = every_shape(), tmp_path / f"scene{ending}"
    write_scene(scene, path)
    again = read_scene(str(path))
    assert again == scene
    assert again.version == scene.version
    for shape in again.shapes:
        expected = {"kind": "tissue", **SHAPES[shape.name]}
        assert {**shape.definition, "kind": shape.kind} == expected
    write_scene(again, tmp_path / f"again{ending}")
    assert (tmp_path / f"again{ending}").read_bytes() == path.read_bytes()
    assert sorted(tmp_path.iterdir()) == sorted([path, tmp_path / f"again{ending}"])


@pytest.mark.parametrize("ending", [".yaml", ".geojson"])
def test_geometry_without_a_definition_is_written_bit_for_bit(tmp_path: Path, ending: str):
    """As of a message: only the geometry is known."""
    shapes = [SceneShape(s.name, s.kind, s.geometry) for s in every_shape().shapes]
    clockwise = Polygon(((0.0, -0.001), (0.0, -0.002), (1e-3 / 3.0, -0.002)))
    others = SceneShape("clockwise", "wall", clockwise), SceneShape("tiny", "wall", Disc((-0.0, 1e-9), 1e-6))
    bare = Scene(Dish(0.05, 0.004, self_contact=True), (*shapes, *others))
    write_scene(bare, tmp_path / f"bare{ending}")
    assert read_scene(str(tmp_path / f"bare{ending}")).version == bare.version


BAD = [
    ("", "scene: got None, expected dish, and shapes by name"),
    ("dish: {diameter: 35}", "dish.diameter: got 35, expected a number from 0.005 to 0.5 m; given in metres?"),
    ("dish: {diameter: 0.035, self_contact: 1}", "dish.self_contact: got 1, expected true or false or nothing"),
    (f"{DISH}shapes: {{post: 3}}", "post: got 3, expected a shape, one of disc"),
    (f"{DISH}shapes: {{a: 1, a: 2}}", "scene file: got 'a is given twice in line 2', expected valid YAML"),
    ("dish: \x07", "scene file: got '"),
    ("a: &a [*a]", "scene file: got 'an anchor or alias (& or *) in line 1', expected plain YAML"),
]


@pytest.mark.parametrize(("text", "words"), BAD, ids=lambda value: value[:40])
def test_a_bad_file_is_refused_in_one_line_that_names_it(tmp_path: Path, text: str, words: str):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    check_refused(ConfigurationError, lambda: read_scene(str(path)), f"{path}: {words}", most=500 + len(str(path)))


@pytest.mark.parametrize("name", ["", "nowhere", "a\0b", "x" * 5000, "../config/scenes/dish_35mm"])
def test_a_name_that_no_scene_has_is_refused(name: str):
    with pytest.raises(ConfigurationError, match=r"^scene: got .{2,200}, expected a YAML or GeoJSON file, or one of"):
        read_scene(name)
