"""The score of a prediction."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.study.score import prediction_error_percent

NODES = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])


def test_a_perfect_prediction_has_no_error():
    curve = np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101)])
    assert prediction_error_percent(NODES, curve, 1.0) == pytest.approx(0.0, abs=1e-12)


def test_an_offset_is_its_share_of_the_length_and_the_tail_does_not_count():
    moved = NODES + np.array([0.0, 0.02])
    moved[0] = 9.0
    curve = np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101)])
    assert prediction_error_percent(moved, curve, 1.0) == pytest.approx(2.0)


def test_the_error_does_not_depend_on_the_unit():
    curve = np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101)])
    moved = NODES + np.array([0.0, 0.02])
    assert prediction_error_percent(0.019 * moved, 0.019 * curve, 0.019) == pytest.approx(2.0)


def test_nodes_past_what_was_seen_are_left_out():
    moved = NODES.copy()
    moved[8:] += 5.0
    curve = np.array([[0.0, 0.0], [0.75, 0.0]])
    assert prediction_error_percent(moved, curve, 1.0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("curve", [np.empty((0, 2)), np.zeros((1, 2)), np.array([[0.0, 0.0], [0.4, 0.0]])])
def test_too_little_seen_gives_no_score(curve: np.ndarray):
    assert np.isnan(prediction_error_percent(NODES, curve, 1.0))
