"""Closest points on triangles, against the definition."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.geometry.obstacles.search import closest_on_segment
from test.geometry.obstacles.triangles import closest_on_triangles


def test_on_a_segment():
    assert closest_on_segment(0.5, 1.0, 0.0, 0.0, 2.0, 0.0) == (0.5, 0.0, 0.25)
    assert closest_on_segment(-0.5, 1.0, 0.0, 0.0, 2.0, 0.0) == (0.0, 0.0, 0.0)
    assert closest_on_segment(2.5, 1.0, 0.0, 0.0, 2.0, 0.0) == (2.0, 0.0, 1.0)
    assert closest_on_segment(2.5, 1.0, 1.0, 1.0, 1.0, 1.0) == (1.0, 1.0, 0.0)


def test_on_a_triangle():
    random = np.random.default_rng(3)
    points = random.uniform(-1.0, 1.0, (60, 3))
    vertices = random.uniform(-0.6, 0.6, (12, 3))
    triangles = np.array([random.choice(12, 3, replace=False) for _ in range(20)])
    found = closest_on_triangles(points, vertices, triangles)
    assert found.shape == (60, 20, 3)
    # No point of a triangle is closer: the distance is convex, so p - q must have no part towards a vertex.
    towards = vertices[triangles][None] - found[:, :, None]
    gain = np.einsum("mtkd,mtd->mtk", towards, points[:, None] - found)
    assert gain.max() <= 1e-12
    # And it is a point of the triangle: its barycentric coordinates are none negative.
    for j, corners in enumerate(vertices[triangles]):
        matrix = np.vstack([corners.T, np.ones(3)])
        values = np.hstack([found[:, j], np.ones((60, 1))]).T
        weights, *_ = np.linalg.lstsq(matrix, values, rcond=None)
        assert weights.min() >= -1e-9
        np.testing.assert_allclose(matrix @ weights, values, atol=1e-9)
