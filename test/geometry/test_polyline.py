"""Polylines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.geometry.polyline import arc_lengths, chain_along, chain_inside, lay_behind_needle, points_at


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


def test_only_the_first_vertex_may_be_outside():
    path = np.array([[0.018, 0.0], [0.04, 0.0]])
    chain = chain_inside(path, 20, 1e-3, CIRCLE)
    np.testing.assert_array_equal(chain[0], path[0])
    assert np.linalg.norm(chain[1:], axis=1).max() < CIRCLE * (1.0 + 1e-12)


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
