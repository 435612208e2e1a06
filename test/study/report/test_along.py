"""The error along the thread."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.study.report.along import AlongThread, node_errors
from magnetosuture_thread.study.score import prediction_error_percent

LENGTH = 0.019
NODES = np.column_stack([-LENGTH * np.arange(26) / 25, np.zeros(26)])


@pytest.mark.parametrize("known", [1.0, 0.8])
def test_the_mean_over_the_nodes_is_the_prediction_error(known: float):
    curve = known * NODES[[0, 25]] + np.array([0.0, 1e-4])
    errors = node_errors(NODES, curve, LENGTH)
    assert np.nanmean(errors) == pytest.approx(prediction_error_percent(NODES, curve, LENGTH))
    assert np.isnan(errors).sum() == round(25 * (1.0 - known))


def test_a_curve_that_is_a_little_short_tells_of_the_free_end_too():
    assert np.isfinite(node_errors(NODES, 0.9995 * NODES, LENGTH)).all()


def test_nothing_is_known_without_a_curve():
    assert np.isnan(node_errors(NODES, np.empty((0, 2)), LENGTH)).all()


@pytest.mark.parametrize("frames", [1, 8, 9, 1000, 4096])
def test_the_map_stays_small_and_keeps_the_greatest_errors(frames: int):
    gathered = AlongThread(LENGTH, most=4)
    values = np.random.default_rng(frames).random((frames, 3))
    for index, errors in enumerate(values):
        gathered.add(index / 30.0, errors)
    along = gathered.map()
    assert along is not None
    assert along.errors.shape[1] == len(along.times) <= 8
    assert along.errors.max(axis=1).tolist() == values.max(axis=0).tolist()
    assert along.lengths[-1] == LENGTH


def test_a_gap_is_empty():
    gathered = AlongThread(LENGTH)
    for time in (0.0, 0.1, 0.2, 5.0, 5.1):
        gathered.add(time, np.ones(3))
    along = gathered.map()
    assert along is not None
    inside = (along.times > 0.2) & (along.times < 5.0)
    assert inside.sum() == 2
    assert np.isnan(along.errors[:, inside]).all()
    assert (along.errors[:, ~inside] == 1.0).all()


def test_without_errors_there_is_no_map():
    gathered = AlongThread(LENGTH)
    gathered.add(0.0, np.full(3, np.nan))
    assert gathered.map() is None
