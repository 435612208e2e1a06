"""Shapes: polygons that are refused, normalised, smoothed and cut into triangles; discs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.settings.errors import ConfigurationError

SQUARE = ((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01))


def square(x: float, y: float, size: float) -> tuple[tuple[float, float], ...]:
    return ((x, y), (x + size, y), (x + size, y + size), (x, y + size))


@pytest.mark.parametrize(
    ("outline", "holes", "reason"),
    [
        (SQUARE[:2], (), r"outline: got '2 distinct points', expected at least 3"),
        ((SQUARE[0], SQUARE[1], SQUARE[0], SQUARE[1]), (), "2 distinct points"),
        ((*SQUARE[:3], (math.nan, 0.01)), (), r"outline\[3\]: got \(nan, 0.01\), expected finite"),
        ((*SQUARE[:3], (0.0, math.inf)), (), r"outline\[3\].*finite"),
        (((0.0, 0.0), (0.01, 0.01), (0.01, 0.0), (0.0, 0.01)), (), r"Self-intersection\[0.005 0.005\]"),
        ((*SQUARE, (0.005, 0.0)), (), "Self-intersection"),
        (((0.0, 0.0), (0.01, 0.02), (0.03, 0.06)), (), "zero area"),
        (((0.0, 0.0), (10.0, 0.0), (10.0, 20.0)), (), "got 20.0.*is it in metres"),
        (tuple((1e-5 * x, 1e-5 * y) for x, y in SQUARE), (), r"got 1[.0-9]*e-07.*is it in metres"),
        (((0.0, 0.0, 0.0), *SQUARE[1:]), (), "two coordinates"),
        (SQUARE, (square(0.02, 0.0, 0.005),), r"holes\[0\]: got 'a hole .* the outline'"),
        (SQUARE, (square(-0.02, -0.02, 0.05),), r"holes\[0\]: .*the outline"),
        (SQUARE, (square(0.005, 0.002, 0.01),), r"holes\[0\]: .*the outline"),
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


def test_only_sharp_corners_are_rounded():
    # A dented square: four right angles outside, three corners of the dent, and two blunt vertices.
    outline = (
        (0.0, 0.0), (0.005, -0.0001), (0.01, 0.0), (0.01, 0.01), (0.006, 0.01), (0.005, 0.006), (0.004, 0.01),
        (0.0, 0.01), (-0.0001, 0.005),
    )  # fmt: skip
    smooth = Polygon(outline).smoothed(0.0005)
    kept = set(smooth.outline) & set(outline)
    assert kept == {(0.005, -0.0001), (-0.0001, 0.005)}
    points = np.array(smooth.outline)
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turns = np.arctan2(cross, np.sum(before * after, axis=1))
    assert np.abs(turns).max() <= math.pi / 18 + 1e-9
    assert (turns < -0.1).any()  # the reflex corner of the dent is an arc too
    # A blunt polygon is returned as it was.
    t = 2.0 * np.pi * np.arange(30) / 30
    blunt = Polygon(tuple(zip(np.cos(t).tolist(), np.sin(t).tolist(), strict=True)))
    assert blunt.smoothed(0.1) == blunt


@given(st.floats(1e-4, 3e-3), st.floats(0.3, 2.5))
def test_an_arc_is_tangent_to_both_edges(radius: float, turn: float):
    # An isosceles triangle; its first corner turns by `turn`.
    half = 0.5 * (math.pi - turn)
    tip, side = (0.0, 0.0), 0.05
    right = (side * math.cos(half), -side * math.sin(half))
    left = (side * math.cos(half), side * math.sin(half))
    smooth = Polygon((tip, right, left)).smoothed(radius, angle=min(0.29, turn - 1e-3))
    tangent = radius * math.tan(0.5 * turn)
    centre = np.array([radius / math.cos(0.5 * turn), 0.0])
    points = np.array(smooth.outline)
    arc = points[np.linalg.norm(points, axis=1) <= tangent * (1.0 + 1e-9)]
    if tangent < 0.49 * min(side, 2.0 * side * math.sin(half)):
        assert len(arc) >= 2
        np.testing.assert_allclose(np.linalg.norm(arc - centre, axis=1), radius, rtol=1e-6)


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


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_signed_distance_of_a_disc_and_its_gradient(dimension: int):
    disc = Disc(tuple(0.1 * np.arange(dimension)), 0.5)
    points = np.vstack([np.random.default_rng(0).uniform(-1.0, 1.0, (50, dimension)), disc.centre])
    distance, normal = disc.signed_distance(points)
    np.testing.assert_allclose(distance, np.linalg.norm(points - disc.centre, axis=1) - 0.5)
    np.testing.assert_allclose(disc.centre + (0.5 + distance[:, None]) * normal, points, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)  # at the centre too
