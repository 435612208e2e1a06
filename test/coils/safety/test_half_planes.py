"""The nearest point within half planes."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from magnetosuture_thread.coils.needle_motion import ROUNDING, project_onto_half_planes
from test.shared import known

NUMBERS = st.floats(-1.0, 1.0)


@st.composite
def half_planes(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a point and half planes that all hold the origin, some through it, some nearly the same."""
    count = draw(st.integers(1, 12))
    angles = np.array(draw(st.lists(st.floats(0.0, 2.0 * np.pi), min_size=count, max_size=count)))
    rows = np.column_stack([np.cos(angles), np.sin(angles)]) * draw(st.sampled_from([1e-3, 1.0, 7.0]))
    least = np.array(draw(st.lists(st.sampled_from([0.0, -0.05, -0.3, -2.0]), min_size=count, max_size=count)))
    if draw(st.booleans()):
        rows, least = np.concatenate([rows, (1.0 + 1e-15) * rows]), np.concatenate([least, least])
    return np.array([draw(NUMBERS), draw(NUMBERS)]), rows, least * np.linalg.norm(rows, axis=1)


def nearest_in_half_planes(point: np.ndarray, rows: np.ndarray, bounds: np.ndarray) -> np.ndarray | None:
    """Return the nearest point of the half planes' intersection; None where there is none."""
    found = np.empty(2)
    point, rows, bounds = (np.ascontiguousarray(array, dtype=np.float64) for array in (point, rows, bounds))
    return found if project_onto_half_planes(point, rows, bounds, np.empty((len(rows), 3)), found) else None


def missing(rows: np.ndarray, least: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return by how much points (m, 2) are beyond the lines, as distances."""
    return (least - points @ rows.T) / np.linalg.norm(rows, axis=1)


@settings(deadline=None)
@given(problem=half_planes())
def test_what_is_found_is_within_and_nothing_within_is_nearer(problem: tuple[np.ndarray, np.ndarray, np.ndarray]):
    point, rows, least = problem
    found = known(nearest_in_half_planes(point, rows, least))
    assert missing(rows, least, found[None]).max() <= 1.01 * ROUNDING * np.linalg.norm(point) + 1e-18
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    others = (np.linspace(0.0, 1.5, 61)[:, None, None] * way).reshape(-1, 2)
    others = others[missing(rows, least, others).max(axis=1) <= 0.0]
    assert np.linalg.norm(found - point) <= np.linalg.norm(others - point, axis=1).min(initial=np.inf) + 1e-9


def test_half_planes_without_a_common_point_have_none():
    rows = np.array([[1.0, 0.0], [-1.0, 0.0]])
    for size in (1.0, 1e-20):
        assert nearest_in_half_planes(np.zeros(2), rows, size * np.array([1.0, 1.0])) is None
    assert nearest_in_half_planes(np.array([2.0, 0.0]), rows, np.array([1.0, -1.0 + 1e-6])) is None  # by so little
