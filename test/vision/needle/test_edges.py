"""The axis half-way between two edges, of which a thread may hide one."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.vision.needle.edges import fit_edges

ALONG = np.arange(0.0, 30.0)
ASIDE = np.arange(-9.0, 9.1, 0.5)
WIDTH = 5.0
AT, SLOPE, BEND = 0.3, 0.02, -0.001  # of the axis: offset [px], slope, and half its second derivative [1/px]


def strip(hidden: float, first: float, last: float) -> np.ndarray:
    """Return the steel of a body, and of a thread beside it on one side between two lengths, shape (rows, columns)."""
    axis = AT + SLOPE * ALONG + BEND * ALONG**2
    steel = np.clip(0.5 + 0.5 * WIDTH - np.abs(ASIDE - axis[:, None]), 0.0, 1.0)
    beside = (first < ALONG) & (last > ALONG)
    thread = np.abs(ASIDE - axis[:, None] - hidden * (0.5 * WIDTH + 1.0)) < 1.0
    return np.where(beside[:, None] & thread, 1.0, steel)


def fit(steel: np.ndarray) -> tuple[np.ndarray, tuple[int, int, int, float]]:
    """Return c_0 to c_2 and h in pixels, and what the fit says of itself."""
    values, inverse = np.empty(4), np.empty((4, 4))
    width = steel.sum(axis=1) * 0.5
    span = (-1.0, 30.0, 0.85 * WIDTH, WIDTH + 0.6, 0.0)
    said = fit_edges(ALONG, ASIDE, steel, width, span, 1.0, 0.5 * WIDTH, values, inverse)
    return values, said


def test_without_a_thread_every_edge_counts():
    values, (rows, taken, kept, square) = fit(strip(0.0, 99.0, 99.0))
    assert (rows, taken, kept) == (30, 60, 60)
    assert values == pytest.approx([AT, SLOPE, BEND, 0.5 * WIDTH], abs=0.01)
    assert square < 0.01


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("last", [8.0, 16.0])
def test_where_a_thread_hides_one_edge_the_other_tells_of_the_axis(side: float, last: float):
    values, (rows, taken, kept, _) = fit(strip(side, -1.0, last))
    assert rows == 30 - last
    assert (taken, kept) == (60, 60 - last)
    assert values == pytest.approx([AT, SLOPE, BEND, 0.5 * WIDTH], abs=0.02)


def test_a_thread_on_either_side_in_turn_moves_the_axis_neither_way():
    steel = np.where(ALONG[:, None] < 8.0, strip(1.0, -1.0, 8.0), strip(-1.0, 21.0, 99.0))
    values, _ = fit(steel)
    assert values == pytest.approx([AT, SLOPE, BEND, 0.5 * WIDTH], abs=0.02)


def test_too_few_rows_keep_no_edge():
    steel = strip(0.0, 99.0, 99.0)
    steel[2:] = 0.0
    _, (rows, taken, kept, _) = fit(steel)
    assert (rows, taken, kept) == (2, 4, 0)
