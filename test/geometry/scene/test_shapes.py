"""Every shape of a scene file: its area, how far it reaches, and what it refuses."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import shapely
from scipy.integrate import quad

from magnetosuture_thread.geometry.obstacles import Polygon
from magnetosuture_thread.geometry.scene_files import ARC_TOLERANCE, shape_from_mapping
from magnetosuture_thread.settings.errors import ConfigurationError
from test.shared import check_refused

HALF_PI = 0.5 * math.pi


def polygon(**description: Any) -> Polygon:
    """Return the polygon that a description stands for."""
    geometry = shape_from_mapping("shape", description).geometry
    assert isinstance(geometry, Polygon)
    return geometry


@pytest.mark.parametrize(("inner", "outer"), [(0.0045, 0.006), (0.0001, 0.0002), (0.02, 0.05)])
def test_an_annulus_is_within_a_tolerance_of_its_circles(inner: float, outer: float):
    shape = polygon(annulus={"center": [0.001, 0.005], "inner_radius": inner, "outer_radius": outer})
    reach = (0.001 - outer, 0.005 - outer, 0.001 + outer, 0.005 + outer)
    assert shape.solid.bounds == pytest.approx(reach, abs=1e-12)
    exact = math.pi * (outer**2 - inner**2)
    assert abs(shape.area - exact) <= ARC_TOLERANCE * 2.0 * math.pi * (inner + outer)
    for ring, radius in zip(shape.rings, (outer, inner), strict=True):
        away = np.hypot(*(ring - [0.001, 0.005]).T)
        np.testing.assert_allclose(away, radius, atol=1e-11)
        middles = np.hypot(*(0.5 * (ring + np.roll(ring, -1, axis=0)) - [0.001, 0.005]).T)
        assert radius - middles.min() <= ARC_TOLERANCE


def sector_area(inner: float, outer: float, turn: float, inset: float) -> float:
    """Return the exact area of a sector of an annulus less a strip along both straight sides [m^2]."""
    return float(quad(lambda radius: radius * (turn - 2.0 * math.asin(inset / radius)), inner, outer)[0])


@pytest.mark.parametrize("inset", [0.0, 0.0005, 0.00085])
def test_an_annular_sector_leaves_a_strip_free(inset: float):
    fields = {"center": [0.0, 0.005], "inner_radius": 0.0077, "outer_radius": 0.0111, "inset": inset}
    shape = polygon(annular_sector={**fields, "start_angle": -HALF_PI, "end_angle": HALF_PI})
    low, bottom, right, top = shape.solid.bounds
    straight = math.sqrt(0.0111**2 - inset**2)
    assert (low, right) == pytest.approx((inset, 0.0111), abs=ARC_TOLERANCE)
    assert (bottom, top) == pytest.approx((0.005 - straight, 0.005 + straight), abs=1e-11)
    exact = sector_area(0.0077, 0.0111, math.pi, inset)
    assert abs(shape.area - exact) <= ARC_TOLERANCE * math.pi * (0.0077 + 0.0111)


def test_a_corner_radius_takes_the_four_corners_off_a_sector():
    """A right corner loses (1 - pi/4) r^2; those at arcs are right to some degrees."""
    fields = {"center": [0.0, 0.0], "inner_radius": 0.01, "outer_radius": 0.02, "start_angle": 0.0, "end_angle": 2.0}
    sharp, soft = polygon(annular_sector=fields), polygon(annular_sector=fields, corner_radius=0.001)
    lost = sharp.area - soft.area
    assert lost == pytest.approx(4.0 * (1.0 - 0.25 * math.pi) * 1e-6, rel=0.06)
    assert sharp.solid.buffer(0.2 * ARC_TOLERANCE).contains(soft.solid)
    assert soft.can_contain(0.001)


def test_corners_are_rounded_with_any_radius_of_which_a_disc_fits():
    """By a negative buffer nothing of this outline would be left; arcs of this sector end 0.5 um apart."""
    outline = [[1.9, 5.89], [0.65, 3.38], [-5.11, -3.63], [-4.36, -4.86], [8.47, -4.75], [7.77, -0.33]]
    assert polygon(polygon={"outline": [[1e-3 * x, 1e-3 * y] for x, y in outline]}, corner_radius=0.003258).area > 7e-5
    inner, outer = 0.0034664354975234646, 0.004019624212047212
    fields = {"center": [0, 0], "inner_radius": inner, "outer_radius": outer}
    sector, width = {**fields, "start_angle": 0.0, "end_angle": math.radians(249.89381737240402)}, outer - inner
    for share in (0.3, 0.6, 0.86, 0.99):
        assert polygon(annular_sector=sector, corner_radius=0.5 * share * width).can_contain(0.5 * share * width)


@pytest.mark.parametrize("angle", [0.0, 0.6, HALF_PI, -2.0])
def test_a_capsule_reaches_a_radius_around_its_segment(angle: float):
    length, radius = 0.006, 0.001
    start, along = np.array([0.002, -0.001]), np.array([math.cos(angle), math.sin(angle)])
    end = start + length * along
    shape = polygon(capsule={"start": start.tolist(), "end": end.tolist(), "radius": radius})
    exact = 2.0 * radius * length + math.pi * radius**2
    assert abs(shape.area - exact) <= ARC_TOLERANCE * 2.0 * math.pi * radius
    segment = shapely.LineString([start, end])
    away = [segment.distance(shapely.Point(corner)) for corner in shape.outline]
    np.testing.assert_allclose(away, radius, atol=1e-11)


@pytest.mark.parametrize("angle", [0.0, 0.3, -1.2])
def test_a_rectangle_is_turned_about_its_centre(angle: float):
    plate = {"center": [0.001, 0.002], "width": 0.004, "height": 0.002, "angle": angle}
    shape, soft = polygon(rectangle=plate), polygon(rectangle=plate, corner_radius=0.0005)
    assert shape.area == pytest.approx(8e-6, rel=1e-9)
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    x, y = 0.5 * np.array([0.004 * c + 0.002 * s, 0.004 * s + 0.002 * c])
    assert shape.solid.bounds == pytest.approx((0.001 - x, 0.002 - y, 0.001 + x, 0.002 + y))
    exact = 8e-6 - (4.0 - math.pi) * 0.0005**2
    assert soft.area == pytest.approx(exact, abs=ARC_TOLERANCE * 2.0 * math.pi * 0.0005)


RING = {"center": [0.0, 0.0], "inner_radius": 0.001, "outer_radius": 0.002}
SECTOR = {**RING, "start_angle": 0.0, "end_angle": 1.0}
SQUARE = [[0.0, 0.0], [0.01, 0.0], [0.01, 0.01], [0.0, 0.01]]
DISC = {"center": [0.0, 0.0], "radius": 0.001}
PLATE = {"center": [0, 0], "width": 0.01, "height": 0.002}

BAD: list[tuple[Any, str]] = [
    (None, "post: got None, expected a shape, one of disc, annulus"),
    ({"disc": DISC, "kind": "bone"}, "post.kind: got 'bone', expected one of tissue, instrument, wall"),
    ({"disc": {**DISC, "raduis": 0.1}}, "post.disc.raduis: got 0.1, expected one of center, radius (did you mean"),
    ({"disc": {**DISC, "center": [7.7, 3.9]}}, "post.disc.center: got [7.7, 3.9], expected two coordinates x, y of at"),
    ({"disc": DISC, "corner_radius": 0.001}, "post.corner_radius: got 0.001, expected 0 m: a disc has no corners"),
    ({"annular_sector": {**SECTOR, "inset": 0.0006}}, "post.annular_sector.inset: got 0.0006, expected less than half"),
    ({"capsule": {"start": [0, 0], "end": [0, 0], "radius": 0.001}}, "post.capsule.end: got [0.0, 0.0], expected an"),
    ({"rectangle": PLATE, "corner_radius": 0.001}, "post.corner_radius: got 0.001, expected at most 0.49 of the sh"),
    ({"polygon": {"outline": [[0, 0], [1, 1], [1, 0], [0, 1]]}}, "post.polygon.outline: got 'Self-intersection"),
    ({"polygon": {"outline": SQUARE}, "corner_radius": 0.006}, "post.corner_radius: got 0.006, expected a radius of"),
]


@pytest.mark.parametrize(("description", "words"), BAD, ids=lambda value: value if isinstance(value, str) else "")
def test_a_bad_shape_is_refused_in_one_line_that_names_file_shape_and_field(description: Any, words: str):
    read = partial(shape_from_mapping, "post", description, "lab.yaml")
    check_refused(ConfigurationError, read, f"lab.yaml: {words}")
