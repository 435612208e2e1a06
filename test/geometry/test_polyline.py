"""Polylines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.geometry.polyline import arc_lengths, chain_along, points_at


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


def test_a_chain_in_space():
    helix = np.column_stack([np.cos(np.linspace(0, 6, 200)), np.sin(np.linspace(0, 6, 200)), np.linspace(0, 1, 200)])
    chain = chain_along(helix, 10, 0.4)
    np.testing.assert_allclose(np.linalg.norm(np.diff(chain, axis=0), axis=1), 0.4, rtol=1e-9)
