"""Distances of whole segments from shapes and the wall, against points sampled densely along them."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Contacts, Disc, Obstacle, Polygon, Workspace, half_segment_distance

REACH = 5e-3
WALL_RADIUS = 0.012
SAMPLES = np.linspace(0.0, 0.5, 1001)[:, None]  # of a half segment


def star(random: np.random.Generator, corners: int) -> Polygon:
    """Return a polygon with corners that stick out and others that do not, about a random place."""
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    away = 4e-3 * random.uniform(0.3, 1.0, corners)
    centre = random.uniform(-0.01, 0.01, 2)
    return Polygon(tuple(map(tuple, centre + away[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))))


def polyline(random: np.random.Generator, dimension: int) -> np.ndarray:
    ways = np.cumsum(random.normal(0.0, 0.5, (25, dimension)), axis=0)
    ways *= random.choice([3e-4, 8e-4, 2e-3]) / np.linalg.norm(ways, axis=1)[:, None]
    return np.vstack([np.zeros(dimension), np.cumsum(ways, axis=0)]) + random.uniform(-6e-3, 6e-3, dimension)


def distances_of(nodes: np.ndarray, workspace: Workspace, contacts: Contacts) -> np.ndarray:
    """Return the distance of a node and the half segments beside it, for each contact."""
    pairs = zip(contacts.node, contacts.obstacle, contacts.distance, strict=True)
    return np.array([half_segment_distance(nodes, *pair, workspace.data) for pair in pairs])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("dimension", [2, 3])
def test_no_point_of_a_chord_is_closer_than_its_distance_and_one_is_as_close(seed: int, dimension: int):
    random = np.random.default_rng(seed)
    ball = Disc(tuple(random.uniform(-0.01, 0.01, dimension)), random.uniform(2e-4, 3e-3))
    others: list[Obstacle] = [star(random, 5), star(random, 40)] if dimension == 2 else []
    shapes = [ball, *others]
    near = Workspace(shapes, REACH, dimension, WALL_RADIUS)
    far = Workspace(shapes, 0.1, dimension, WALL_RADIUS)
    for _ in range(3):
        nodes = polyline(random, dimension)
        contacts = near.near(nodes)
        found = distances_of(nodes, near, contacts)
        for i in range(len(nodes)):
            beside = [j for j in (i - 1, i + 1) if 0 <= j < len(nodes)]
            sampled = far.near(np.vstack([nodes[i] + SAMPLES * (nodes[j] - nodes[i]) for j in beside]))
            spacing = max(np.linalg.norm(nodes[j] - nodes[i]) for j in beside) * SAMPLES[1, 0]
            for row in np.flatnonzero((contacts.node == i) & contacts.nearest):
                same = sampled.obstacle == contacts.obstacle[row]
                least = sampled.distance[same].min()
                assert least >= found[row] - 1e-12
                assert found[row] > least - 0.5 * spacing - 1e-7 - 1e-12  # and what lies between two samples
                assert found[row] > least - 1e-6
                assert found[row] <= contacts.distance[row]


def test_beside_an_edge_and_through_a_thin_shape_nothing_is_missed():
    thin = Polygon(((-1e-4, -5e-3), (1e-4, -5e-3), (1e-4, 5e-3), (-1e-4, 5e-3)))
    workspace = Workspace([thin, Disc((0.0, 8e-3), 1e-3)], REACH)
    through = np.array([[-5e-4, 0.0], [5e-4, 0.0]])
    contacts = workspace.near(through)
    found = distances_of(through, workspace, contacts)[contacts.obstacle == 0]
    np.testing.assert_allclose(found, -1e-4, atol=2e-7)
    beside = np.array([[3e-4, -1e-3], [3e-4, 1e-3], [3e-4, 3e-3]])
    contacts = workspace.near(beside)
    found = distances_of(beside, workspace, contacts)[contacts.obstacle == 0]
    np.testing.assert_allclose(found, 2e-4, atol=1e-12)
