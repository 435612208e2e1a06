"""Polygons that are refused, normalised, smoothed and cut into triangles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Polygon, triangulate
from magnetosuture_thread.settings.errors import ConfigurationError

SQUARE = ((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01))


def square(x: float, y: float, size: float) -> tuple[tuple[float, float], ...]:
    return ((x, y), (x + size, y), (x + size, y + size), (x, y + size))


@pytest.mark.parametrize(
    ("outline", "holes", "reason"),
    [
        (SQUARE[:2], (), r"outline: got '2 distinct points', expected at least 3"),
        ((*SQUARE[:3], (math.nan, 0.01)), (), r"outline\[3\]: got \(nan, 0.01\), expected finite"),
        (((0.0, 0.0), (0.01, 0.01), (0.01, 0.0), (0.0, 0.01)), (), r"Self-intersection\[0.005 0.005\]"),
        (((0.0, 0.0), (0.01, 0.02), (0.03, 0.06)), (), "zero area"),
        (((0.0, 0.0), (10.0, 0.0), (10.0, 20.0)), (), "got 20.0.*is it in metres"),
        (tuple((1e-5 * x, 1e-5 * y) for x, y in SQUARE), (), r"got 1[.0-9]*e-07.*is it in metres"),
        (((0.0, 0.0, 0.0), *SQUARE[1:]), (), "two coordinates"),
        (SQUARE, (square(0.02, 0.0, 0.005),), r"holes\[0\]: got 'a hole .* the outline'"),
        (SQUARE, (((0.0, 0.005), (0.005, 0.004), (0.005, 0.006)),), r"holes\[0\]: .*the outline"),
        (SQUARE, (square(0.001, 0.001, 0.004), square(0.003, 0.003, 0.004)), r"holes\[1\]: .*: holes\[0\]"),
        (SQUARE, (((0.001, 0.001), (0.002, 0.002), (0.002, 0.001), (0.001, 0.002)),), r"holes\[0\].*Self-inter"),
    ],
)
def test_a_bad_polygon_is_refused_with_its_reason(outline, holes, reason: str):
    with pytest.raises(ConfigurationError, match=reason):
        Polygon(outline, holes)


def test_rings_are_normalised_and_keep_their_first_vertex():
    hole = square(0.002, 0.002, 0.003)
    closed = (*SQUARE, SQUARE[0])
    doubled = (SQUARE[0], SQUARE[0], *SQUARE[1:], SQUARE[0], SQUARE[0])
    clockwise = tuple(reversed(closed))
    shapes = [Polygon(outline, (h,)) for outline in (SQUARE, closed, doubled, clockwise) for h in (hole, hole[::-1])]
    for shape in shapes:
        assert shape.outline == SQUARE
        assert set(shape.holes[0]) == set(hole)
        assert shape.area == pytest.approx(1e-4 - 9e-6)


def test_an_arc_that_meets_a_hole_is_made_smaller():
    shape = Polygon(SQUARE, (((0.0002, 0.0002), (0.0012, 0.0004), (0.0004, 0.0012)),))
    smooth = shape.smoothed(0.004)
    assert smooth.area < shape.area
    with pytest.raises(ConfigurationError, match="radius"):
        shape.smoothed(-1.0)


def test_triangles_cover_the_polygon_and_every_edge_of_it_is_one_of_a_single_triangle():
    hole = square(0.002, 0.002, 0.003)
    for polygon in (Polygon(SQUARE), Polygon(SQUARE, (hole,)), Polygon(SQUARE).smoothed(0.001)):
        found = triangulate(polygon)
        (ax, ay), (bx, by), (cx, cy) = np.moveaxis(found, 0, -1)
        areas = 0.5 * ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
        assert (areas > 0.0).all()
        assert areas.sum() == pytest.approx(polygon.area)
        directed = [(tuple(t[k]), tuple(t[k - 2])) for t in found.tolist() for k in range(3)]
        assert len(directed) == len(set(directed))
        rings = [ring.tolist() for ring in polygon.rings]
        boundary = {(tuple(ring[k - 1]), tuple(ring[k])) for ring in rings for k in range(len(ring))}
        assert boundary == {(a, b) for a, b in directed if (b, a) not in directed}


def test_corners_apart_by_less_than_rounding_cannot_be_cut_into_triangles():
    needle = Polygon(((0.0, 0.0), (0.005, 0.0), (0.0, 0.005))).smoothed(1e-320)
    with pytest.raises(ConfigurationError, match="can be cut into triangles"):
        triangulate(needle)
