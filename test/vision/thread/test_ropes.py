"""Ropes on a table that were followed wrong once: along one edge, or on into another rope."""

from __future__ import annotations

import pytest

from benchmarks.vision.ropes import measure_rope


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
