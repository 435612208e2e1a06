"""Needle and thread in frames of the benchmark's hard classes, other ones than it draws by default."""

from __future__ import annotations

from functools import cache

import pytest

from benchmarks.vision.measurements import Row, frame_of, measure, row_of

SEED = 4711
FRAMES = 6
FOLDS = ("0_4", "4_15", "15_26", "26_50")
BESIDE = [f"fold_{fold}_{length}mm" for fold in FOLDS for length in ("2.5", "7")]
OPEN = [name for name in BESIDE if "_15_26" in name or "_26_50" in name]
COLOURED = ["black_1px", "black_2px", "black_4px", "violet_4px", "violet_12px", "black_12px", "white_1px", "white_4px"]


@cache
def row(name: str) -> Row:
    """Return what the tracker makes of some frames of a class."""
    return row_of(name, [measure(*frame_of(name, index, SEED)) for index in range(FRAMES)])


@pytest.mark.parametrize("name", BESIDE)
def test_a_needle_with_a_thread_beside_under_or_over_it_is_found_and_never_reversed(name: str):
    assert row(name).wrong == 0
    assert row(name).found - row(name).unknown >= FRAMES - 1


@pytest.mark.parametrize("name", OPEN)
def test_a_thread_folded_back_is_followed_from_where_it_comes_out(name: str):
    assert row(name).covered > 0.8  # of all frames, so that one needle may be lost
    assert (row(name).wrong_line or 0.0) < 0.005


@pytest.mark.parametrize("name", [f"thread_{each}" for each in COLOURED])
def test_dark_pale_thin_and_wide_threads_are_followed(name: str):
    assert (row(name).found, row(name).unknown, row(name).wrong) == (FRAMES, 0, 0)
    assert row(name).covered > 0.95
    assert (row(name).wrong_line or 0.0) < 0.02


@pytest.mark.parametrize("name", ["thread_undyed_1px", "thread_undyed_4px"])
def test_of_a_thread_that_is_hardly_seen_nothing_else_is_followed(name: str):
    assert row(name).found == FRAMES
    assert (row(name).wrong_line or 0.0) < 0.01


def test_a_rod_never_points_the_wrong_way():
    rods = row("blunt_rod")
    assert (rods.wrong, rods.found) == (0, FRAMES)


def test_of_two_needles_the_one_that_a_thread_leaves_is_taken():
    assert row("second_needle").found >= FRAMES - 1
    assert row("second_needle").wrong == 0
