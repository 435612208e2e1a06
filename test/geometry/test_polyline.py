"""Polylines."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.geometry.polyline import arc_lengths, chain_along, chain_inside, lay_behind_needle, points_at


def test_arc_lengths_and_points_of_a_corner():
    corner = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    assert arc_lengths(corner).tolist() == [0.0, 2.0, 3.0]
    assert points_at(corner, np.array([-1.0, 2.5, 9.0])).tolist() == [[0.0, 0.0], [2.0, 0.5], [2.0, 1.0]]


def test_a_chain_past_the_end_goes_on_straight():
    chain = chain_along(np.array([[0.0, 0.0], [1.0, 0.0]]), 5, 0.5)
    np.testing.assert_allclose(chain, np.column_stack([0.5 * np.arange(6), np.zeros(6)]), atol=1e-12)


@given(
    steps=st.lists(st.tuples(st.floats(0.05, 1.0), st.floats(-1.2, 1.2)), min_size=1, max_size=30),
    segments=st.integers(1, 40),
)
def test_a_chain_has_equal_segments_and_lies_on_the_polyline(steps, segments):
    angles = np.cumsum([turn for _, turn in steps])
    lengths = np.array([length for length, _ in steps])
    walk = np.cumsum(lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)
    path = np.vstack([np.zeros(2), walk])
    chain = chain_along(path, segments, 0.3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(chain, axis=0), axis=1), 0.3, rtol=1e-9)
    assert chain[0] == pytest.approx(path[0])
    extended = np.vstack([path, path[-1] + (path[-1] - path[-2]) / lengths[-1] * 0.3 * (segments + 1)])
    dense = points_at(extended, np.linspace(0.0, arc_lengths(extended)[-1], 20_000))
    distance = [np.linalg.norm(dense - point, axis=1).min() for point in chain]
    assert max(distance) < 2e-3


def test_a_vertex_that_repeats_the_one_before_is_passed_over():
    path = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.5], [1.0, 0.5]])
    np.testing.assert_array_equal(chain_along(path, 9, 0.25), chain_along(path[[0, 2, 4]], 9, 0.25))


def test_a_chain_in_space():
    helix = np.column_stack([np.cos(np.linspace(0, 6, 200)), np.sin(np.linspace(0, 6, 200)), np.linspace(0, 1, 200)])
    chain = chain_along(helix, 10, 0.4)
    np.testing.assert_allclose(np.linalg.norm(np.diff(chain, axis=0), axis=1), 0.4, rtol=1e-9)


CIRCLE = 0.0175


@pytest.mark.parametrize("segments", [25, 81])
def test_a_chain_goes_along_the_circle_where_its_path_leads_outside(segments: int):
    length = 0.15
    path = np.array([[0.0, 0.0], [-0.15, 0.03]])
    chain = chain_inside(path, segments, length / segments, CIRCLE)
    np.testing.assert_allclose(np.linalg.norm(np.diff(chain, axis=0), axis=1), length / segments, rtol=1e-12)
    assert np.linalg.norm(chain, axis=1).max() < CIRCLE * (1.0 + 1e-12)
    angle = np.unwrap(np.arctan2(chain[-5:, 1], chain[-5:, 0]))
    assert (np.diff(angle) > 0.0).all() or (np.diff(angle) < 0.0).all()  # on and on, not back and forth


def test_a_path_with_a_wave_outside_of_the_circle_comes_back_to_itself():
    angle = np.linspace(0.0, 2.0, 200)
    radius = CIRCLE - 2e-4 + 4e-4 * np.exp(-(((angle - 1.0) / 0.2) ** 2))
    path = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    free, chain = chain_along(path, 40, 8e-4), chain_inside(path, 40, 8e-4, CIRCLE)
    assert np.linalg.norm(free, axis=1).max() > CIRCLE + 1e-4
    assert np.linalg.norm(chain, axis=1).max() < CIRCLE * (1.0 + 1e-12)
    assert np.linalg.norm(chain - free, axis=1).max() < 4e-4
    np.testing.assert_array_equal(chain_inside(path, 40, 8e-4, 0.1), chain_along(path, 40, 8e-4))


def test_only_the_first_vertex_may_be_outside():
    path = np.array([[0.018, 0.0], [0.04, 0.0]])
    chain = chain_inside(path, 20, 1e-3, CIRCLE)
    np.testing.assert_array_equal(chain[0], path[0])
    assert np.linalg.norm(chain[1:], axis=1).max() < CIRCLE * (1.0 + 1e-12)


def test_what_is_laid_behind_a_needle_turns_in_before_the_circle():
    tail, heading = np.array([0.0, 0.0]), np.array([0.6, 0.8])
    laid = lay_behind_needle(tail, heading, 0.15, CIRCLE)
    assert arc_lengths(laid)[-1] >= 0.15
    assert np.linalg.norm(laid, axis=1).max() < CIRCLE
    edges = np.diff(laid, axis=0)
    turns = np.arccos(np.clip((edges[1:] * edges[:-1]).sum(axis=1) / np.linalg.norm(edges[0]) ** 2, -1.0, 1.0))
    assert (turns / np.linalg.norm(edges[0])).max() < 1.01 / (0.3 * CIRCLE)
    np.testing.assert_allclose(edges[0] / np.linalg.norm(edges[0]), -heading, atol=1e-12)
    for length, radius in ((0.01, CIRCLE), (0.15, math.inf)):
        np.testing.assert_array_equal(lay_behind_needle(tail, heading, length, radius), [tail, tail - length * heading])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_is_laid_turns_to_the_side_of_the_centre_and_comes_to_lie_along_the_circle(side: float):
    """The thread goes along x; the centre is to its left where the side is 1."""
    laid = lay_behind_needle(np.array([-0.002, -0.006 * side]), np.array([-1.0, 0.0]), 0.06, CIRCLE)
    edges = np.diff(laid, axis=0)
    turns = side * (edges[:-1, 0] * edges[1:, 1] - edges[:-1, 1] * edges[1:, 0]) / np.linalg.norm(edges[0]) ** 2
    assert turns.min() > -1e-9
    away = np.linalg.norm(laid, axis=1)
    assert away.max() < CIRCLE
    assert away[-20:].min() > 0.97 * CIRCLE


def test_a_chain_does_not_turn_back_where_its_path_leaves_the_circle_aslant():
    path = np.array([[-0.0091, -0.0016], [-0.0148, -0.0098], [-0.0248, -0.0099], [-0.0329, -0.004]])
    edges = np.diff(chain_inside(path, 60, 8e-4, CIRCLE), axis=0)
    assert (edges[1:] * edges[:-1]).sum(axis=1).min() > 0.0
