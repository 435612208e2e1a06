"""What is newly known, as values of settings."""

from __future__ import annotations

import math
from typing import Any

import pytest

from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.model.changes import of_material, of_obstacles
from magnetosuture_thread.model.settings import ThreadModelSettings

OUTLINE = [(0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01)]
HOLE = [(0.004, 0.004), (0.006, 0.004), (0.005, 0.006)]


def changed(values: dict[str, Any], **before: Any) -> ThreadModelSettings:
    """Return the settings after a change."""
    return from_mapping(ThreadModelSettings, {**to_mapping(from_mapping(ThreadModelSettings, before)), **values})


def test_obstacles_take_the_place_of_all_others():
    polygons = [[OUTLINE, HOLE], [[(x + 0.02, y) for x, y in OUTLINE]]]
    settings = changed(of_obstacles([(-0.01, 0.0, 0.002)], polygons, [0.0]), disc_obstacles=[0.0, 0.0, 0.001])
    disc, first, second = settings.obstacles()
    assert disc == Disc((-0.01, 0.0), 0.002)
    assert isinstance(first, Polygon)
    assert isinstance(second, Polygon)
    assert first.area == pytest.approx(1e-4 - 2e-6)
    assert (len(first.holes), len(second.holes)) == (1, 0)
    assert changed(of_obstacles([], []), disc_obstacles=[0.0, 0.0, 0.001]).obstacles() == ()


def test_corners_are_rounded_as_they_were_unless_it_is_told():
    assert changed(of_obstacles([], []), corner_radius=3e-4).corner_radius == 3e-4
    assert changed(of_obstacles([], [], [1e-4]), corner_radius=3e-4).corner_radius == 1e-4


def test_what_is_not_told_of_a_material_stays():
    assert of_material() == {}
    assert of_material(diameter=math.nan, elastic_modulus=math.nan, viscosity=math.nan, drag_anisotropy=math.nan) == {}
    before: dict[str, Any] = {"diameter": 7e-5, "elastic_modulus": 1e9, "rest_curvature": 5.0, "attachment": "glued"}
    after = changed(of_material(viscosity=0.8, drag_anisotropy=0.6), **before)
    assert after == from_mapping(ThreadModelSettings, {**before, "viscosity": 0.8, "drag_anisotropy": 0.6})


def test_a_material_that_is_named_brings_its_own_figures():
    before = {"diameter": 7e-5, "elastic_modulus": 1e9, "paper_stiffness_weight": 3.0, "viscosity": 0.7}
    silk = changed(of_material(name="silk_6_0"), **before)
    assert silk == from_mapping(ThreadModelSettings, {"material": "silk_6_0", "viscosity": 0.7})
    thicker = changed(of_material(name="silk_6_0", diameter=9e-5), **before)
    assert (thicker.material, thicker.diameter, thicker.elastic_modulus) == ("silk_6_0", 9e-5, 0.0)


def test_what_may_be_zero_can_be_told():
    before = {"rest_curvature": 5.0, "attachment_offset": [1e-3, 0.0], "attachment": "glued"}
    told = of_material(rest_curvature=[0.0], attachment_offset=[0.0, 0.0], attachment="pinned")
    assert changed(told, **before) == from_mapping(ThreadModelSettings, {"attachment_offset": [0.0, 0.0]})
