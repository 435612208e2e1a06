"""Figures of the estimate itself: consistency, hidden parts, disturbances, and errors side by side."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from magnetosuture_thread.estimator import Disturbance
from magnetosuture_thread.evaluation.frames import EstimatedThread, FrameResult
from magnetosuture_thread.evaluation.metrics import (
    Consistency,
    HiddenShares,
    RunMetrics,
    compare_errors,
    hidden_part,
    mean_band,
)
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

NODES = np.column_stack([-0.25 * np.arange(5), np.zeros(5)])  # a thread 1 m long
LINE = np.column_stack([-np.linspace(0.0, 1.0, 21), np.zeros(21)])
UP = np.array([0.0, 1.0])


def frame(stamp: float, estimate: EstimatedThread | None, **others: Any) -> FrameResult:
    """Return a frame whose prediction is 0.02 m off the line."""
    return FrameResult(round(stamp * 1e9), vertices=NODES + 0.02 * UP, estimate=estimate, **others)


def piece(first: float, last: float) -> ThreadPiece:
    """Return a piece of the line between two arc lengths."""
    points = np.array([[-first, 0.0], [-last, 0.0]])
    return ThreadPiece(points, np.full(2, 1e-4), PieceEnd.TAIL, PieceEnd.COVERED, (first, first))


def test_errors_of_prediction_and_estimate_have_the_same_names():
    run = RunMetrics(1.0)
    for k, off in enumerate((0.004, 0.008)):
        nodes = NODES + off * UP
        nodes[3, 1] += 0.004
        run.add(frame(k, EstimatedThread(nodes, True), measured=LINE, ground_truth=LINE + 0.001 * UP))
    found = compare_errors(run.series)
    assert found["prediction"].keys() == found["estimate"].keys()
    assert found["prediction"]["error_measured_mean_percent"] == pytest.approx(2.0)
    assert found["prediction"]["error_ground_truth_max_node_percent"] == pytest.approx(1.9)
    assert found["estimate"]["error_ground_truth_mean_percent"] == pytest.approx((0.4 + 0.8) / 2)
    assert found["estimate"]["error_ground_truth_max_percent"] == pytest.approx(0.8)
    assert found["estimate"]["error_ground_truth_max_node_percent"] == pytest.approx(1.1)
    assert found["estimate"]["error_measured_max_percent"] == pytest.approx(0.9)


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_innovations_are_within_their_band_if_they_are_as_expected(scale: float):
    squared = scale * np.random.default_rng(1).standard_normal((2000, 16)) ** 2
    squared[::3, 5:] = np.nan  # hidden
    run = RunMetrics(1.0)
    for k, row in enumerate(squared):
        run.add(frame(0.1 * k, EstimatedThread(NODES, True, row)))
    found = Consistency.of(run.series)
    assert found is not None
    assert found.windows == 40
    assert found.width == pytest.approx(199.9 / 40)
    assert found.mean == pytest.approx(np.nanmean(squared), rel=1e-9)
    if scale == 1.0:
        assert found.within >= 34
    else:
        assert found.within == 0
        assert (found.means > found.high).all()
    counts = np.array([16.0, 2400.0])
    for count, low, high in zip(counts, *mean_band(counts), strict=True):
        assert chi2.cdf((low * count, high * count), count) == pytest.approx((0.025, 0.975))


def test_hidden_is_what_no_piece_shows():
    estimate = EstimatedThread(NODES, True)
    whole = ThreadObservation((piece(0.0, 0.9),), complete=True)
    parts = ThreadObservation((piece(0.0, 0.3), piece(0.6, 0.9)))
    broken = LINE.copy()
    broken[5:] = np.nan
    for expected, own, others in (
        (0.0, estimate, {"observation": whole}),
        (0.4, estimate, {"observation": parts}),
        (0.0, estimate, {"measured": LINE}),
        (0.5, estimate, {"measured": LINE[:11]}),
        (1.0, estimate, {"measured": LINE, "observation": ThreadObservation()}),
        (1.0, EstimatedThread(NODES), {"measured": LINE}),  # it was refused
        (0.8, estimate, {"measured": broken}),
    ):
        assert hidden_part(frame(0, own, **others), 1.0) == pytest.approx(expected, abs=1e-12)


def test_hidden_shares_are_of_time_and_not_of_frames():
    run = RunMetrics(1.0)
    for time in [*np.arange(0.0, 1.0, 0.1), *np.arange(1.0, 2.0, 0.05)]:
        run.add(frame(time, EstimatedThread(NODES, time < 1.5), measured=LINE[:11] if time < 1.0 else LINE))
    found = HiddenShares.of(run.series)
    assert found is not None
    assert (found.time, found.all_time, found.length) == pytest.approx((0.75, 0.25, 0.5), abs=0.02)


def test_disturbances_of_one_beginning_are_one_event():
    run = RunMetrics(1.0, 10**10)
    place = np.array([0.1, 0.2])
    for time, since, significance in (
        (10.0, None, 0.0),
        (10.5, 10.4, 5.0),
        (10.6, 10.4, 7.0),
        (10.7, 10.4, 6.0),
        (10.8, None, 0.0),
        (10.9, 10.85, 5.0),
    ):
        found = (Disturbance(0.3 * significance, 0.1, place, UP, 1e-6, significance, since),) if since else ()
        run.add(frame(time, EstimatedThread(NODES, True, np.empty(0), found)))
    first, second = run.disturbances
    assert [first.begin_s, first.end_s] == pytest.approx([0.4, 0.7])
    assert [first.significance, first.arc_length_m] == pytest.approx([7.0, 2.1])
    assert [first.x_m, first.y_m, first.direction_rad] == pytest.approx([0.1, 0.2, math.pi / 2])
    assert second.begin_s == pytest.approx(0.85)
