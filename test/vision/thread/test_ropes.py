"""Ropes on a table that were followed wrong once: along one edge, or on into another rope."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from benchmarks.vision.ropes import measure_rope
from magnetosuture_thread.vision.thread.cross_section import smoothest


@pytest.mark.parametrize("index", [2, 7])
def test_a_rope_as_bright_as_the_table_is_followed_between_its_two_dark_edges(index: int):
    covered, wrong, _ = measure_rope("ropes_1", index, 270001)
    assert covered > 0.95
    assert wrong < 0.02


@pytest.mark.parametrize(("name", "index", "seed"), [("ropes_2", 6, 270001), ("ropes_shallow", 1, 270001)])
def test_of_two_ways_at_a_crossing_the_one_is_taken_that_is_as_long_as_the_rope(name: str, index: int, seed: int):
    covered, wrong, _ = measure_rope(name, index, seed)
    assert covered > 0.95
    assert wrong < 0.02


@pytest.mark.parametrize("price", [0.0, 0.3, 2.0])
def test_the_smoothest_columns_are_the_best_of_all_from_the_middle_on(price: float):
    """Every way through a small table is tried."""
    score = np.random.default_rng(6).uniform(0.0, 2.0, (5, 5))

    def worth(way: tuple[int, ...]) -> float:
        steps = np.diff(way)
        if way[0] != 2 or np.abs(steps).max() > 2:
            return -np.inf
        return float(score[np.arange(1, 5), way[1:]].sum() - price * (steps**2).sum())

    best = max(itertools.product(range(5), repeat=5), key=worth)
    np.testing.assert_array_equal(smoothest(score, price, 2), best)
