"""The error along the thread."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation.error_map import ErrorMap

LENGTH = 0.019


@pytest.mark.parametrize("frames", [1, 8, 9, 1000, 4096])
def test_the_map_stays_small_and_keeps_the_greatest_errors(frames: int):
    gathered = ErrorMap(LENGTH, columns=4)
    values = np.random.default_rng(frames).random((frames, 3))
    for index, errors in enumerate(values):
        gathered.add(index / 30.0, errors)
    grid = gathered.grid()
    assert grid is not None
    assert grid.errors.shape[1] == len(grid.times) <= 8
    assert grid.errors.max(axis=1).tolist() == values.max(axis=0).tolist()
    assert grid.lengths[-1] == LENGTH


def test_a_gap_is_empty():
    gathered = ErrorMap(LENGTH)
    for time in (0.0, 0.1, 0.2, 5.0, 5.1):
        gathered.add(time, np.ones(3))
    grid = gathered.grid()
    assert grid is not None
    inside = (grid.times > 0.2) & (grid.times < 5.0)
    assert inside.sum() == 2
    assert np.isnan(grid.errors[:, inside]).all()
    assert (grid.errors[:, ~inside] == 1.0).all()


def test_without_errors_there_is_no_map():
    gathered = ErrorMap(LENGTH)
    gathered.add(0.0, np.full(3, np.nan))
    assert gathered.grid() is None
