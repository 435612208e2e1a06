"""The command `magnetosuture scene`: what it shows, writes, draws and refuses."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import numpy as np
import pytest

from magnetosuture_thread.cli import main
from magnetosuture_thread.geometry.scene_files import read_scene, write_scene
from test.geometry.scene.scenes import every_shape
from test.shared import known

HOSTILE = """\
dish: {diameter: 0.035, depth: 0.003}
shapes:
  "$x^{2": {disc: {center: [0.0, 0.012], radius: 0.004}}
  "[bold]縫合 & <糸>": {disc: {center: [0.0, 0.006], radius: 0.004}, kind: wall}
"""


def test_check_shows_dish_version_shapes_and_warnings(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    file = tmp_path / "a.json"
    assert main(["scene", "check", "hernia_ring", "--json", str(file)]) == 0
    shown, scene, report = capsys.readouterr().out, read_scene("hernia_ring"), json.loads(file.read_text())
    assert scene.version in shown
    assert report["version"] == scene.version
    assert [shape["name"] for shape in report["shapes"]] == list(scene.names)
    ring = report["shapes"][0]
    assert ring["definition"]["annulus"]["outer_radius"] == 0.006
    assert ring["bounds_m"] == pytest.approx([-0.006, -0.001, 0.006, 0.011])
    assert ring["area_m2"] == pytest.approx(np.pi * (0.006**2 - 0.0045**2), rel=2e-3)
    assert report["warnings"] == []
    assert main(["scene", "check", "hernia_ring", "--needle-width", "0.0018", "--json", str(file)]) == 0
    shown, warnings = capsys.readouterr().out, json.loads(file.read_text())["warnings"]
    assert shown.count("warning: the gap between") == len(warnings) == 3
    assert warnings[0]["shapes"] == ["ring", "left_tissue"]


def test_a_picture_shows_every_shape_in_its_place(tmp_path: Path):
    write_scene(every_shape(), tmp_path / "lab.geojson")
    for ending in ("svg", "png"):
        output = tmp_path / f"lab.{ending}"
        assert main(["scene", "draw", str(tmp_path / "lab.geojson"), "--output", str(output)]) == 0
    root = ElementTree.parse(tmp_path / "lab.svg").getroot()
    words = {"".join(text.itertext()).strip() for text in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"lab", *every_shape().names, "10 mm", "tissue", "instrument", "wall"} <= words
    picture = known(cv2.imread(str(tmp_path / "lab.png")))
    height, width, _ = picture.shape
    scale = width / (1.12 * 0.05)  # px/m
    x, y = -0.003, 0.013  # in the block of tissue
    colour = picture[round(height - 0.5 * width - scale * y), round(0.5 * width + scale * x), ::-1]
    np.testing.assert_allclose(colour, (240, 185, 180), atol=16)


def test_names_that_mean_something_to_programs_are_drawn_and_shown_as_they_are(tmp_path: Path, capsys):
    (tmp_path / "a.yaml").write_text(HOSTILE, encoding="utf-8")
    for ending in ("png", "svg"):
        assert main(["scene", "draw", str(tmp_path / "a.yaml"), "--output", str(tmp_path / f"a.{ending}")]) == 0
    assert "[bold]縫合 &amp; &lt;糸&gt;" in (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert main(["scene", "check", str(tmp_path / "a.yaml")]) == 0
    shown = capsys.readouterr().out
    assert "warning: $x^{2 and [bold]縫合 & <糸> overlap by" in shown


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "nowhere"], "error: scene: got 'nowhere', expected a YAML or GeoJSON file, or one of dead_end"),
        (["draw", "BAD", "--output", "OUT/a.png"], "bad.yaml: post.disc.radius: got 1.5, expected a number"),
        (["draw", "hernia_ring", "--output", "OUT/a.gif"], "a.gif', expected a file that ends in .png or .svg"),
    ],
)
def test_wrong_use_ends_with_one_line_and_code_2(tmp_path: Path, capsys, arguments: list[str], words: str):
    bad = tmp_path / "bad.yaml"
    bad.write_text("dish: {diameter: 0.035}\nshapes: {post: {disc: {center: [0, 0], radius: 1.5}}}\n")
    given = [str(bad) if word == "BAD" else word.replace("OUT", str(tmp_path)) for word in arguments]
    assert main(["scene", *given]) == 2
    errors = capsys.readouterr().err
    assert words in errors
    assert errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == [bad]
