"""Scene files: what is written is read back the same, and what is no scene is refused in one line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.geometry.scene_files import read_scene, write_scene
from magnetosuture_thread.settings.errors import ConfigurationError
from test.geometry.scene.scenes import SHAPES, every_shape

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
    shapes = tuple(SceneShape(s.name, s.kind, s.geometry) for s in every_shape().shapes)
    bare = Scene(Dish(0.05, 0.004, self_contact=True), shapes)
    clockwise = Polygon(((0.0, -0.001), (0.0, -0.002), (1e-3 / 3.0, -0.002)), ())
    bare = bare.add(SceneShape("clockwise", "wall", clockwise)).add(
        SceneShape("tiny", "wall", Disc((-0.0, 1e-9), 1e-6))
    )
    write_scene(bare, tmp_path / f"bare{ending}")
    assert read_scene(str(tmp_path / f"bare{ending}")).version == bare.version


def test_numbers_are_read_as_ros_reads_them(tmp_path: Path):
    (tmp_path / "a.yaml").write_text(
        "dish: {diameter: 35e-3}\nshapes: {a: {disc: {center: [0, 1e-3], radius: +1.e-3}}}\n"
    )
    assert read_scene(str(tmp_path / "a.yaml")).obstacles == (Disc((0.0, 0.001), 0.001),)


BAD = [
    ("", "scene: got None, expected dish, and shapes by name"),
    (f"{DISH}obstacles: []", "obstacles: got [], expected dish and shapes, nothing else"),
    ("dish: {depth: 0.003}", "dish: got {'depth': 0.003}, expected diameter and depth [m]"),
    ("dish: {diameter: 35}", "dish.diameter: got 35, expected a number from 0.005 to 0.5 m; given in metres?"),
    ("dish: {diameter: 0.035, self_contact: 1}", "dish.self_contact: got 1, expected true or false or nothing"),
    ("dish: {diameter: 0.035, radius: 0.01}", "dish.radius: got 0.01, expected one of diameter, depth"),
    (f"{DISH}shapes: {{post: 3}}", "post: got 3, expected a shape, one of disc"),
    (f"{DISH}shapes: {{1: {{}}}}", "shapes: got 1, expected names of 1 to 64"),
    (f"{DISH}shapes: {{a: 1, a: 2}}", "scene file: got 'a is given twice in line 2', expected valid YAML"),
    ("dish: \x07", "scene file: got '"),
    ("a: &a [*a]", "scene file: got 'an anchor or alias (& or *) in line 1', expected plain YAML"),
    ("dish: !!python/object/apply:os.system [ls]", "scene file: got 'a tag (!) in line 1', expected plain YAML"),
    (
        f"{DISH}shapes: {{a: {{disc: {{center: !!binary AAA=, radius: 0.001}}}}}}",
        "scene file: got 'a tag (!) in line 2'",
    ),
    *[
        (f"{DISH}shapes: {{a: {{capsule: {{radius: {number}}}}}}}", f"scene file: got '{number}, which is no decimal")
        for number in ("010", "0x1F", "-0b11", "1_000", "1:30")
    ],
    ("[" * 100_000, "scene file: got 'lists and mappings 21 deep in line 1', expected plain YAML, at most 20 deep"),
]


@pytest.mark.parametrize(("text", "words"), BAD, ids=lambda value: value[:40])
def test_a_bad_file_is_refused_in_one_line_that_names_it(tmp_path: Path, text: str, words: str):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_scene(str(path))
    assert str(caught.value).startswith(f"{path}: {words}")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500 + len(str(path))


def test_what_only_looks_like_another_number_is_a_name_or_a_number(tmp_path: Path):
    (tmp_path / "a.yaml").write_text(
        f"{DISH}shapes: {{0bad: {{disc: {{center: [0, 0.0], radius: 0.001}}}}, '010': "
        "{disc: {center: [+1e-2, -0], radius: .001}}}\n"
    )
    assert [shape.name for shape in read_scene(str(tmp_path / "a.yaml")).shapes] == ["0bad", "010"]


@pytest.mark.parametrize("name", [".", "", "..", "/"])
def test_a_scene_is_not_written_in_the_place_of_a_folder(name: str):
    with pytest.raises(ConfigurationError, match="is a folder; expected a new file"):
        write_scene(every_shape(), Path(name))


def test_only_a_regular_file_of_a_bounded_size_is_read(tmp_path: Path):
    fifo = tmp_path / "fifo.yaml"
    os.mkfifo(fifo)
    (tmp_path / "device.yaml").symlink_to("/dev/zero")
    for path in (fifo, tmp_path / "device.yaml", tmp_path / "none.yaml"):
        with pytest.raises(ConfigurationError, match=r"^scene: got '.*, expected a YAML or GeoJSON file, or one of"):
            read_scene(str(path))
    for ending, problem in ((".yaml", "YAML"), (".geojson", "GeoJSON")):
        large = tmp_path / f"large{ending}"
        os.truncate(os.open(large, os.O_CREAT | os.O_WRONLY), 10**12)  # a terabyte with nothing in it
        with pytest.raises(ConfigurationError, match=f"got 'a larger file', expected a readable {problem} file"):
            read_scene(str(large))
        large.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
        with pytest.raises(ConfigurationError, match="it is a pointer of Git LFS, not the file itself"):
            read_scene(str(large))


@pytest.mark.parametrize("name", ["", "nowhere", "a\0b", "x" * 5000, "../config/scenes/dish_35mm"])
def test_a_name_that_no_scene_has_is_refused(name: str):
    with pytest.raises(ConfigurationError, match=r"^scene: got .{2,200}, expected a YAML or GeoJSON file, or one of"):
        read_scene(name)
