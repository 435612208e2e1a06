"""The contract that every barrier keeps: shapes, gradients, signs."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.barrier import NO_OBSTACLE, Barrier
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon, Workspace
from magnetosuture_thread.model.barriers import (
    Compression,
    Connectivity,
    EnhancedConnectivity,
    ObstacleAvoidance,
    SquaredObstacleAvoidance,
    Stiffness,
    WallAvoidance,
    moved_inside,
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
        SquaredObstacleAvoidance(workspace, 0.05),
        Stiffness(np.linspace(1.5, 2.0, 7)),
        WallAvoidance(workspace, 0.05),
    ]


def random_thread(dimension: int) -> np.ndarray:
    """Return nodes with segments of about unit length, none at rest."""
    random = np.random.default_rng(3)
    return np.cumsum(random.uniform(-1.0, 1.0, (9, dimension)), axis=0)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("index", range(len(barriers(2))))
def test_shapes_agree(dimension: int, index: int):
    positions = random_thread(dimension)
    rows = barriers(dimension)[index].rows(positions)
    count, touched = rows.nodes.shape
    assert rows.value.shape == rows.clearance.shape == rows.obstacle.shape == (count,)
    assert rows.gradient.shape == (count, touched, dimension)
    assert rows.nodes.min() == 0
    assert rows.nodes.max() == len(positions) - 1
    has_obstacles = rows.name == "obstacle"
    assert has_obstacles == bool((rows.obstacle != NO_OBSTACLE).all())


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


@pytest.mark.parametrize("index", range(len(barriers(2))))
def test_value_and_clearance_have_the_same_sign(index: int):
    rows = barriers(2)[index].rows(random_thread(2))
    assert (np.sign(rows.value) == np.sign(rows.clearance)).all()


def straight(length: float) -> np.ndarray:
    """Return three nodes in a row, their segments of a given length."""
    return np.array([[0.0, 0.0], [length, 0.0], [2.0 * length, 0.0]])


def test_a_long_segment_is_unsafe_for_connectivity_and_safe_for_compression():
    np.testing.assert_allclose(Connectivity(1.0).rows(straight(1.1)).value, -0.105)
    np.testing.assert_allclose(Compression(1.0).rows(straight(1.1)).value, 0.105)
    np.testing.assert_allclose(Connectivity(1.0).rows(straight(1.1)).clearance, -0.1)
    np.testing.assert_allclose(Compression(1.0).rows(straight(0.9)).clearance, -0.1)


def around_a_disc(*distances: float) -> np.ndarray:
    """Return nodes at distances from the origin."""
    return np.array([[0.0, distance] for distance in distances])


def test_the_edge_of_an_obstacle_is_where_its_margin_begins():
    barrier = ObstacleAvoidance(Workspace([Disc((0.0, 0.0), 1.0)], 5.0), 0.25)
    rows = barrier.rows(around_a_disc(1.5, 1.25, 1.0, 0.2))
    np.testing.assert_allclose(rows.value, [0.25, 0.0, -0.25, -1.05], atol=1e-15)
    # Outwards on both sides of the surface: a node inside is pushed out, not trapped.
    np.testing.assert_allclose(rows.gradient, np.tile([[[0.0, 1.0]]], (4, 1, 1)), atol=1e-15)


def test_the_papers_obstacle_function_has_the_same_edge_and_pushes_out_as_well():
    barrier = SquaredObstacleAvoidance(Workspace([Disc((0.0, 0.0), 1.0)], 5.0), 0.25)
    rows = barrier.rows(around_a_disc(1.5, 1.25, 1.0, 0.2))
    np.testing.assert_allclose(rows.value, 0.5 * np.array([0.5**2, 0.25**2, 0.0, -(0.8**2)]) - 0.5 * 0.25**2)
    assert (rows.gradient[[0, 1, 3], 0, 1] > 0.0).all()
    assert (
        np.sign(rows.value)
        == np.sign(ObstacleAvoidance(barrier.workspace, 0.25).rows(around_a_disc(1.5, 1.25, 1.0, 0.2)).value)
    )[[0, 2, 3]].all()


def test_the_needle_has_a_margin_too_and_far_pairs_have_none():
    near = Workspace([Disc((0.0, 0.0), 1.0), Disc((9.0, 0.0), 1.0)], 2.0)
    rows = ObstacleAvoidance(near, 0.0).rows(around_a_disc(1.5, 2.5, 3.5))
    np.testing.assert_array_equal(rows.nodes, [[0], [1]])
    np.testing.assert_array_equal(rows.obstacle, [0, 0])


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


def test_no_obstacle_gives_no_rows():
    rows = ObstacleAvoidance(Workspace([], 1.0, 3), 0.1).rows(random_thread(3))
    assert rows.value.shape == (0,)
    assert rows.gradient.shape == (0, 1, 3)


def test_two_segments_are_not_longer_than_two_rest_lengths():
    """Read with the printed Delta instead of 2 Delta, a straight thread would be unsafe."""
    np.testing.assert_allclose(EnhancedConnectivity(1.0).rows(straight(1.0)).value, [0.0], atol=1e-15)
    np.testing.assert_allclose(EnhancedConnectivity(1.0).rows(straight(1.1)).clearance, [-0.2])


def test_stiffness_is_zero_in_the_rest_shape_and_below_it_elsewhere():
    angle = 0.3
    bent = np.array([[np.cos(angle), np.sin(angle)], [0.0, 0.0], [-1.0, 0.0]])
    rest = np.array([np.linalg.norm(bent[0] - bent[2])])
    np.testing.assert_allclose(Stiffness(rest).rows(bent).value, 0.0, atol=1e-30)
    assert Stiffness(rest).rows(straight(1.0)).value[0] < -1e-4
    assert Stiffness(np.array([2.0])).rows(bent).value[0] == pytest.approx(-0.5 * (rest[0] ** 2 - 4.0) ** 2)


def test_free_nodes_outside_of_the_wall_are_moved_onto_it_and_no_others():
    positions = np.array([(0.0, 3.0), (0.6, 0.5), (3.0, -4.0), (-2.1, 0.0)])
    longest = moved_inside(positions, np.array([True, False, False, False]), 2.0)
    np.testing.assert_allclose(positions, [(0.0, 3.0), (0.6, 0.5), (1.2, -1.6), (-2.0, 0.0)])
    assert longest == pytest.approx(3.0)
