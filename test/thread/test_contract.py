"""The contract that every barrier keeps: shapes, gradients, signs."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.barrier import Barrier
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon, Workspace
from magnetosuture_thread.thread.barriers import (
    Compression,
    Connectivity,
    EnhancedConnectivity,
    ObstacleAvoidance,
    Stiffness,
    WallAvoidance,
    move_inside,
)


def barriers(dimension: int) -> list[Barrier]:
    """Return one of each kind."""
    near, far = Disc((0.5,) * dimension, 0.4), Disc((-2.0,) * dimension, 0.7)
    shape: Obstacle = Polygon(((-1.0, -1.5), (0.3, -1.4), (0.1, -0.6), (-0.2, -0.9)))
    if dimension == 3:
        shape = Disc((-0.2, -1.1, 0.2), 0.5)
    workspace = Workspace([near, far, shape], 50.0, dimension, 2.5)
    return [
        Connectivity(1.0),
        EnhancedConnectivity(1.0),
        Compression(1.0),
        Compression(np.linspace(0.8, 1.0, 8)),
        ObstacleAvoidance(workspace, 0.05),
        Stiffness(np.linspace(1.5, 2.0, 7)),
        WallAvoidance(workspace, 0.05),
    ]


def random_thread(dimension: int) -> np.ndarray:
    """Return nodes with segments of about unit length, none at rest."""
    random = np.random.default_rng(3)
    return np.cumsum(random.uniform(-1.0, 1.0, (9, dimension)), axis=0)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("index", range(len(barriers(2))))
def test_gradient_is_the_central_difference(dimension: int, index: int):
    positions = random_thread(dimension)
    barrier = barriers(dimension)[index]
    rows = barrier.rows(positions)
    full = np.zeros((len(rows.value), *positions.shape))
    for column in range(rows.nodes.shape[1]):
        full[np.arange(len(rows.value)), rows.nodes[:, column]] += rows.gradient[:, column]
    for node in range(len(positions)):
        for axis in range(dimension):
            step = np.zeros_like(positions)
            step[node, axis] = 1e-6
            slope = (barrier.rows(positions + step).value - barrier.rows(positions - step).value) / 2e-6
            np.testing.assert_allclose(full[:, node, axis], slope, atol=1e-8)


def around_a_disc(*distances: float) -> np.ndarray:
    """Return nodes at distances from the origin."""
    return np.array([[0.0, distance] for distance in distances])


def test_the_edge_of_an_obstacle_is_where_its_margin_begins():
    barrier = ObstacleAvoidance(Workspace([Disc((0.0, 0.0), 1.0)], 5.0), 0.25)
    rows = barrier.rows(around_a_disc(1.5, 1.25, 1.0, 0.2))
    np.testing.assert_allclose(rows.value, [0.25, 0.0, -0.25, -1.05], atol=1e-15)
    # Outwards on both sides of the surface: a node inside is pushed out, not trapped.
    np.testing.assert_allclose(rows.gradient, np.tile([[[0.0, 1.0]]], (4, 1, 1)), atol=1e-15)


def test_the_wall_is_a_circle_and_in_space_a_cylinder():
    plane = np.array([[0.0, 0.0], [1.5, 0.0], [0.0, 1.75], [-3.0, 0.0]])
    rows = WallAvoidance(Workspace([], 0.5, 2, 2.0), 0.25).rows(plane)
    np.testing.assert_array_equal(rows.nodes, [[1], [2], [3]])
    np.testing.assert_allclose(rows.value, [0.25, 0.0, -1.25], atol=1e-15)
    np.testing.assert_allclose(rows.gradient[:, 0], [[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]], atol=1e-15)
    space = np.column_stack([plane, [5.0, -3.0, 0.0, 1.0]])
    above = WallAvoidance(Workspace([], 0.5, 3, 2.0), 0.25).rows(space)
    np.testing.assert_array_equal(above.value, rows.value)
    assert (above.gradient[:, 0, 2] == 0.0).all()
    assert len(WallAvoidance(Workspace([], 0.5), 0.25).rows(plane).value) == 0


def test_a_wall_row_forbids_nothing_that_the_circle_allows():
    random = np.random.default_rng(1)
    barrier = WallAvoidance(Workspace([], 50.0, 2, 2.0), 0.1)
    about, inside = random.normal(size=(200, 2)), random.normal(size=(200, 2))
    inside *= (1.9 * random.uniform(size=(200, 1)) ** 0.1) / np.linalg.norm(inside, axis=1, keepdims=True)
    rows = barrier.rows(about)
    linear = rows.value + np.einsum("ij,ij->i", rows.gradient[:, 0], inside - about)
    assert linear.min() > -1e-12
    left = linear - barrier.rows(inside).value  # what the row leaves outside of the circle
    way = np.linalg.norm(inside - about, axis=1)
    assert (left <= way**2 / (2.0 * np.linalg.norm(about, axis=1)) + 1e-12).all()


def test_free_nodes_outside_of_the_wall_are_moved_onto_it_and_no_others():
    positions = np.array([(0.0, 3.0), (0.6, 0.5), (3.0, -4.0), (-2.1, 0.0)])
    move_inside(positions, np.array([True, False, False, False]), 2.0)
    np.testing.assert_allclose(positions, [(0.0, 3.0), (0.6, 0.5), (1.2, -1.6), (-2.0, 0.0)])
