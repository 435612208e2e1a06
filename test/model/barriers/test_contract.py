"""The contract that every barrier keeps: shapes, gradients, signs."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model.barriers import (
    NO_OBSTACLE,
    Barrier,
    BarrierKind,
    Compression,
    Connectivity,
    ObstacleAvoidance,
)


def barriers(dimension: int) -> list[Barrier]:
    """Return one of each kind."""
    near, far = Disc((0.5,) * dimension, 0.4), Disc((-2.0,) * dimension, 0.7)
    return [Connectivity(1.0), Compression(1.0), ObstacleAvoidance([near, far], 0.05)]


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
    assert rows.nodes.min() >= 0
    assert rows.nodes.max() == len(positions) - 1
    has_obstacles = rows.kind is BarrierKind.OBSTACLE
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


def test_the_edge_of_an_obstacle_is_where_its_margin_begins():
    barrier = ObstacleAvoidance([Disc((0.0, 0.0), 1.0)], 0.25)
    for distance, value in ((1.5, 0.25), (1.25, 0.0), (1.0, -0.25), (0.2, -1.05)):
        positions = np.array([[9.0, 9.0], [0.0, distance]])
        rows = barrier.rows(positions)
        np.testing.assert_allclose(rows.value, [value], atol=1e-15)
        # Outwards on both sides of the surface: a node inside is pushed out, not trapped.
        np.testing.assert_allclose(rows.gradient, [[[0.0, 1.0]]], atol=1e-15)


def test_no_obstacle_gives_no_rows():
    rows = ObstacleAvoidance([], 0.1).rows(random_thread(3))
    assert rows.value.shape == (0,)
    assert rows.gradient.shape == (0, 1, 3)
