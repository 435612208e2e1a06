"""Contacts in the plane, against shapely and against the definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from magnetosuture_thread.geometry.obstacles import WALL, Disc, Obstacle, Polygon, Workspace
from magnetosuture_thread.settings.errors import ConfigurationError

SQUARE = Polygon(((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01)))


def star(seed: int, vertices: int, hole: bool) -> Polygon:
    random = np.random.default_rng(seed)
    angle = 2.0 * np.pi * (np.arange(vertices) + random.uniform(-0.4, 0.4, vertices)) / vertices
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centre = np.array([0.01, -0.02])
    outline = centre + random.uniform(0.02, 0.05, vertices)[:, None] * way
    inner = centre + random.uniform(0.002, 0.005, vertices)[:, None] * way
    holes = (tuple(map(tuple, inner.tolist())),) if hole else ()
    return Polygon(tuple(map(tuple, outline.tolist())), holes)


def signed(polygon: Polygon, points: np.ndarray) -> np.ndarray:
    """Return shapely's signed distance."""
    places = shapely.points(points)
    distance = shapely.distance(polygon.solid.boundary, places)
    return np.where(shapely.contains(polygon.solid, places), -distance, distance)


def minima(polygon: Polygon, point: np.ndarray, reach: float) -> list[float]:
    """Return the distances of all local minima at a point outside, by their definition, edge by edge."""
    found = []
    for ring in polygon.rings:
        for before, a, b in zip(np.roll(ring, 1, axis=0), ring, np.roll(ring, -1, axis=0), strict=True):
            d = b - a
            t = (point - a) @ d / (d @ d)
            side = ((point - a)[0] * d[1] - (point - a)[1] * d[0]) / np.linalg.norm(d)
            if 0.0 < t < 1.0 and side >= 0.0:
                found.append(float(side))
            e = a - before
            convex = e[0] * d[1] - e[1] * d[0] > 0.0
            if convex and t <= 0.0 and (point - before) @ e / (e @ e) >= 1.0:
                found.append(float(np.linalg.norm(point - a)))
    return sorted(value for value in found if value <= reach)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.integers(5, 40), st.booleans(), st.sampled_from([0.0, 1e-4, 0.004, 0.03, 0.5]))
def test_contacts_of_random_stars(seed: int, vertices: int, hole: bool, reach: float):
    polygon = star(seed, vertices, hole)
    points = np.random.default_rng(seed + 1).uniform([-0.06, -0.09], [0.08, 0.05], (120, 2))
    points = np.vstack([points, np.random.default_rng(seed + 2).uniform([0.0, -0.03], [0.02, -0.01], (30, 2))])
    contacts = Workspace([polygon], reach).near(points)
    true = signed(polygon, points)
    assert set(contacts.node.tolist()) == set(np.flatnonzero(true <= reach).tolist())
    nearest = contacts.nearest
    np.testing.assert_allclose(contacts.distance[nearest], true[contacts.node[nearest]], atol=1e-12)
    assert len(set(contacts.node[nearest].tolist())) == nearest.sum()
    for i in set(contacts.node.tolist()):
        rows = np.sort(contacts.distance[contacts.node == i])
        if true[i] < 0.0:
            assert len(rows) == 1
        else:
            np.testing.assert_allclose(rows, minima(polygon, points[i], reach), atol=1e-12)
    # x - sd n is on the boundary.
    foot = points[contacts.node] - contacts.distance[:, None] * contacts.normal
    assert shapely.distance(polygon.solid.boundary, shapely.points(foot)).max(initial=0.0) < 1e-12


def test_a_wall_of_many_edges_is_one_contact():
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    x = np.linspace(0.0, 0.05, 101)
    outline = np.vstack([np.stack([x, 0.0 * x], 1), np.stack([x[::-1], 0.0 * x + 0.002], 1)]) @ turn.T + 0.03
    wall = Workspace([Polygon(tuple(map(tuple, outline.tolist())))], 0.01)
    along = np.concatenate([x[1:-1], np.random.default_rng(0).uniform(0.001, 0.049, 500)])
    for above in (0.0, 1e-9, 0.003, 0.009):
        points = np.stack([along, 0.002 + above + 0.0 * along], 1) @ turn.T + 0.03
        contacts = wall.near(points)
        outside = contacts.distance >= 0.0  # on the wall itself, rounding decides
        assert contacts.node.tolist() == list(range(len(points)))
        assert outside.all() or above == 0.0
        np.testing.assert_allclose(contacts.distance, above, atol=1e-15)
        np.testing.assert_allclose(contacts.normal, np.tile(turn[:, 1], (len(points), 1)), atol=1e-9)


def test_a_needle_and_a_notch_keep_their_signs():
    # The tip of a needle at the right; the notch in it is as sharp.
    tip, depth = 1e-9, 0.01
    needle = Polygon(((0.0, -tip), (0.05, 0.0), (0.0, tip)))
    notched = Polygon(((0.0, -0.01), (0.02, -0.01), (0.02, -tip), (depth, 0.0), (0.02, tip), (0.02, 0.01), (0.0, 0.01)))
    points = np.array([[0.051, 0.0], [0.051, 0.001], [0.025, 1e-4], [0.025, -1e-4]])
    assert Workspace([needle], 0.01).near(points).distance.min() > 0.0
    inside = Workspace([notched], 0.02).near(np.array([[0.008, 0.0], [0.0099, 0.001], [0.015, -0.001]]))
    np.testing.assert_allclose(inside.distance, [-0.002, -np.hypot(1e-4, 1e-3), -0.001], rtol=1e-6)


def test_contacts_come_by_nodes_and_then_by_obstacles_whatever_their_kind():
    other = Polygon(tuple((x + 0.02, y) for x, y in SQUARE.outline))
    shapes: list[Obstacle] = [SQUARE, Disc((0.015, 0.005), 0.002), other]
    points = np.array([[0.0125, 0.005], [np.nan, 0.005], [0.015, 0.005], [0.5, 0.5], [0.018, 0.005]])
    contacts = Workspace(shapes, 0.003).near(points)
    assert contacts.node.tolist() == [0, 0, 2, 4, 4]
    assert contacts.obstacle.tolist() == [0, 1, 1, 1, 2]
    np.testing.assert_allclose(contacts.distance, [0.0025, 0.0005, -0.002, 0.001, 0.002])
    np.testing.assert_allclose(contacts.normal, [[1, 0], [-1, 0], [1, 0], [1, 0], [-1, 0]], atol=1e-15)
    assert contacts.nearest.all()


def test_the_wall_is_a_contact_of_its_own_before_the_obstacles():
    points = np.array([[0.0, 0.0], [0.045, 0.0], [0.0, -0.06], [np.nan, 0.0], [np.inf, 0.0]])
    contacts = Workspace([Disc((0.044, 0.0), 1e-3)], 0.01, wall_radius=0.05).near(points)
    np.testing.assert_array_equal(contacts.node, [1, 1, 2])
    np.testing.assert_array_equal(contacts.obstacle, [WALL, 0, WALL])
    np.testing.assert_allclose(contacts.distance, [0.005, 0.0, -0.01], atol=1e-15)
    np.testing.assert_allclose(contacts.normal[[0, 2]], [[-1.0, 0.0], [0.0, 1.0]], atol=1e-15)
    assert contacts.nearest.all()
    centre = Workspace([], 0.1, 3, 0.05).near(np.array([[0.0, 0.0, 0.7]]))
    assert centre.distance.tolist() == [0.05]


@pytest.mark.parametrize(
    ("shapes", "changes", "reason"),
    [
        ([SQUARE], {"dimension": 3}, "which is a ball"),
        ([Disc((0.0, 0.0, 0.0), 1.0)], {}, "2 coordinates"),
        ([SQUARE], {"friction": (0.1, 0.2)}, "one for each of 1"),
        ([Disc((0.0, 0.0, 0.0), 1.0)], {"dimension": 3, "friction": (0.1,)}, "friction is of the plane"),
    ],
)
def test_what_cannot_be_a_workspace_is_refused(shapes: list[Obstacle], changes: dict[str, Any], reason: str):
    with pytest.raises(ConfigurationError, match=reason):
        Workspace(shapes, **{"reach": 0.1, **changes})
