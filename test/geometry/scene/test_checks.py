"""What is allowed in a scene and yet often a slip, and where names stand in a drawing."""

from __future__ import annotations

import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape, SceneWarning, scene_warnings
from magnetosuture_thread.geometry.scene_files import read_scene, shape_from_mapping

WIDTH = 0.0004
SQUARE = ((0.0, 0.0), (0.004, 0.0), (0.004, 0.004), (0.0, 0.004))


def scene(*geometries: Disc | Polygon) -> Scene:
    """Return a dish of 35 mm with shapes a, b and so on."""
    return Scene(Dish(0.035), tuple(SceneShape(name, "tissue", g) for name, g in zip("abc", geometries, strict=False)))


def moved(x: float, y: float) -> Polygon:
    """Return a square of 4 mm somewhere."""
    return Polygon(tuple((a + x, b + y) for a, b in SQUARE))


@pytest.mark.parametrize("name", ["hernia_ring", "dish_35mm_post", "dish_35mm", "dish_150mm"])
def test_nothing_is_to_be_said_of_the_scenes_that_ship(name: str):
    assert scene_warnings(read_scene(name), WIDTH) == []


def test_an_overlap_has_its_area_and_a_place_in_it():
    (warning,) = scene_warnings(scene(moved(0.0, 0.0), moved(0.003, 0.002)), WIDTH)
    assert (warning.what, warning.shapes) == ("overlap", ("a", "b"))
    assert warning.value == pytest.approx(2e-6)
    assert 0.003 < warning.place[0] < 0.004
    assert 0.002 < warning.place[1] < 0.004
    assert warning.text.startswith("a and b overlap by 2 mm^2 at (3.")


@pytest.mark.parametrize(("gap", "warned"), [(0.0, True), (0.0003, True), (0.00039, True), (0.00041, False)])
def test_a_gap_is_told_while_it_is_narrower_than_the_needle(gap: float, warned: bool):
    found = scene_warnings(scene(moved(0.0, 0.0), moved(0.004 + gap, 0.0)), WIDTH)
    assert [warning.what for warning in found] == (["gap"] if warned else [])
    if warned:
        assert found[0].value == pytest.approx(gap)
        assert found[0].place[0] == pytest.approx(0.004 + 0.5 * gap)
        assert "narrower than the needle" in found[0].text


def test_check_reports_a_shape_near_or_across_the_wall():
    (near,) = scene_warnings(scene(Disc((0.0, 0.0152), 0.002)), WIDTH)
    assert near.what == "gap"
    assert near.place == pytest.approx((0.0, 0.0172))
    assert near.value == pytest.approx(0.0003)
    assert near.text == "the gap between a and the wall at (0.00, 17.20) mm is 0.3 mm wide: narrower than the needle"
    (across,) = scene_warnings(scene(moved(0.015, -0.002)), WIDTH)
    assert across.what == "wall"
    assert across.value == pytest.approx((0.019**2 + 0.002**2) ** 0.5 - 0.0175)
    assert across.text == "a lies across the wall: it reaches 1.6 mm beyond"
    assert scene_warnings(scene(Disc((0.0, 0.0150), 0.002)), WIDTH) == []


def test_check_reports_a_hole_too_narrow_for_the_needle():
    def warnings(radius: float) -> list[SceneWarning]:
        ring = {"annulus": {"center": [0, 0], "inner_radius": radius, "outer_radius": 0.002}}
        return scene_warnings(Scene(Dish(), (shape_from_mapping("ring", ring),)), WIDTH)

    assert warnings(0.00021) == []
    (warning,) = warnings(0.00019)
    assert (warning.what, warning.shapes) == ("hole", ("ring",))
    assert warning.value == pytest.approx(0.00038, rel=0.02)
