"""Triangulations conform to their polygon."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Polygon, triangulate


def star(seed: int, vertices: int, hole: bool) -> Polygon:
    """Return a random star-shaped polygon around (0.01, -0.02), with a star-shaped hole or not."""
    random = np.random.default_rng(seed)
    angle = 2.0 * np.pi * (np.arange(vertices) + random.uniform(-0.4, 0.4, vertices)) / vertices
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centre = np.array([0.01, -0.02])
    outline = centre + random.uniform(0.02, 0.05, vertices)[:, None] * way
    # Within the circle in the outline, also where its vertices are far apart.
    inner = centre + random.uniform(0.002, 0.005, vertices)[:, None] * way
    holes = (tuple(map(tuple, inner.tolist())),) if hole else ()
    return Polygon(tuple(map(tuple, outline.tolist())), holes)


@given(st.integers(0, 10_000), st.integers(5, 60), st.booleans())
def test_it_keeps_every_edge_once_and_the_area(seed: int, vertices: int, hole: bool):
    polygon = star(seed, vertices, hole)
    found = triangulate(polygon)
    assert len(found.triangles) == len(found.vertices) - 2 + 2 * hole
    assert (found.areas > 0.0).all()
    assert np.isclose(found.areas.sum(), polygon.area, rtol=1e-10)
    directed = [tuple(pair) for t in found.triangles.tolist() for pair in zip(t, (*t[1:], t[0]), strict=True)]
    boundary = set(map(tuple, found.boundary.tolist()))
    assert len(directed) == len(set(directed))
    assert boundary == {(a, b) for a, b in directed if (b, a) not in directed}
    assert {tuple(v) for v in found.vertices.tolist()} == {*polygon.outline, *(p for h in polygon.holes for p in h)}


def test_corners_apart_by_less_than_rounding_are_refused():
    needle = Polygon(((0.0, 0.0), (0.005, 0.0), (0.0, 0.005))).smoothed(1e-320)
    with pytest.raises(ConfigurationError, match="can be cut into triangles"):
        triangulate(needle)


HEXAGON = tuple((0.01 * math.cos(angle), 0.01 * math.sin(angle)) for angle in np.linspace(0.0, 2.0 * np.pi, 7)[:-1])
GOOD = [(0, 1, 2), (2, 3, 4), (4, 5, 0), (0, 2, 4)]
