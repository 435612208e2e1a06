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
    DisturbanceLog,
    HiddenShares,
    RunMetrics,
    compare_errors,
    hidden_part,
    mean_band,
)
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

NODES = np.column_stack([-0.25 * np.arange(5), np.zeros(5)])  # a thread 1 m long
LINE = np.column_stack([-np.linspace(0.0, 1.0, 21), np.zeros(21)])


def frame(stamp: float, estimate: EstimatedThread | None, **others: Any) -> FrameResult:
    """Return a frame whose prediction is 0.02 m off the line."""
    return FrameResult(round(stamp * 1e9), NODES + np.array([0.0, 0.02]), estimate=estimate, **others)


def piece(first: float, last: float, begins: PieceEnd = PieceEnd.UNKNOWN) -> ThreadPiece:
    """Return a piece of the line between two arc lengths."""
    points = np.array([[-first, 0.0], [-last, 0.0]])
    return ThreadPiece(points, np.full(2, 1e-4), begins, PieceEnd.COVERED, (first, first))


def consistency_of(squared: np.ndarray, rate: float = 10.0) -> Consistency:
    """Return the consistency of innovations of shape (frames, windows)."""
    run = RunMetrics(1.0)
    for k, row in enumerate(squared):
        run.add(frame(k / rate, EstimatedThread(NODES, True, row)))
    found = Consistency.of(run.series)
    assert found is not None
    return found


def test_errors_of_prediction_and_estimate_have_the_same_names():
    run = RunMetrics(1.0)
    for k, off in enumerate((0.004, 0.008)):
        nodes = NODES + np.array([0.0, off])
        nodes[3, 1] += 0.004
        run.add(frame(k, EstimatedThread(nodes, True), measured=LINE, ground_truth=LINE + np.array([0.0, 0.001])))
    found = compare_errors(run.series)
    assert found["prediction"].keys() == found["estimate"].keys()
    assert found["prediction"]["error_measured_mean_percent"] == pytest.approx(2.0)
    assert found["prediction"]["error_ground_truth_max_node_percent"] == pytest.approx(1.9)
    assert found["estimate"]["error_ground_truth_mean_percent"] == pytest.approx((0.4 + 0.8) / 2)
    assert found["estimate"]["error_ground_truth_max_percent"] == pytest.approx(0.8)
    assert found["estimate"]["error_ground_truth_max_node_percent"] == pytest.approx(1.1)
    assert found["estimate"]["error_measured_max_percent"] == pytest.approx(0.9)


def test_the_band_is_that_of_a_mean_of_squares():
    low, high = mean_band(np.array([16, 2400]))
    for count, a, b in zip((16, 2400), low, high, strict=True):
        assert chi2.cdf(a * count, count) == pytest.approx(0.025)
        assert chi2.cdf(b * count, count) == pytest.approx(0.975)


def test_innovations_as_expected_are_within_their_band():
    random = np.random.default_rng(1)
    squared = random.standard_normal((2000, 16)) ** 2
    squared[::3, 5:] = np.nan  # hidden
    found = consistency_of(squared)
    assert found.windows == 40
    assert found.within >= 34
    assert found.mean == pytest.approx(np.nanmean(squared), rel=1e-9)
    assert found.width == pytest.approx(199.9 / 40)
    assert found.share == found.within / 40


def test_innovations_larger_than_expected_are_not():
    random = np.random.default_rng(2)
    found = consistency_of(1.5 * random.standard_normal((500, 16)) ** 2)
    assert found.within == 0
    assert (found.means > found.high).all()


def test_hidden_is_what_no_piece_shows():
    estimate = EstimatedThread(NODES, True)
    whole = ThreadObservation((piece(0.0, 0.9, PieceEnd.TAIL),), complete=True)
    parts = ThreadObservation((piece(0.0, 0.3, PieceEnd.TAIL), piece(0.6, 0.9)))
    assert hidden_part(frame(0, estimate, observation=whole), 1.0) == 0.0
    assert hidden_part(frame(0, estimate, observation=parts), 1.0) == pytest.approx(0.4)
    assert hidden_part(frame(0, estimate, measured=LINE), 1.0) == pytest.approx(0.0, abs=1e-12)
    assert hidden_part(frame(0, estimate, measured=LINE[:11]), 1.0) == pytest.approx(0.5)
    assert hidden_part(frame(0, estimate, measured=LINE, observation=ThreadObservation()), 1.0) == 1.0
    assert hidden_part(frame(0, EstimatedThread(NODES), measured=LINE), 1.0) == 1.0  # it was refused
    broken = LINE.copy()
    broken[5:] = np.nan
    assert hidden_part(frame(0, estimate, measured=broken), 1.0) == pytest.approx(0.8)


def test_hidden_shares_are_of_time_and_not_of_frames():
    run = RunMetrics(1.0)
    times = [*np.arange(0.0, 1.0, 0.1), *np.arange(1.0, 2.0, 0.05)]
    for time in times:
        if time < 1.0:
            run.add(frame(time, EstimatedThread(NODES, True), measured=LINE[:11]))
        else:
            run.add(frame(time, EstimatedThread(NODES, time < 1.5), measured=LINE))
    found = HiddenShares.of(run.series)
    assert found is not None
    assert found.time == pytest.approx(0.75, abs=0.02)
    assert found.all_time == pytest.approx(0.25, abs=0.02)
    assert found.length == pytest.approx(0.5, abs=0.02)


def test_disturbances_of_one_beginning_are_one_event():
    log = DisturbanceLog()

    def disturbed(since: float, significance: float) -> EstimatedThread:
        place, east = np.array([0.1, 0.2]), np.array([0.0, 1.0])
        return EstimatedThread(
            NODES, True, np.empty(0), (Disturbance(0.3 * significance, 0.1, place, east, 1e-6, significance, since),)
        )

    for time, estimate in (
        (10.0, EstimatedThread(NODES, True)),
        (10.5, disturbed(10.4, 5.0)),
        (10.6, disturbed(10.4, 7.0)),
        (10.7, disturbed(10.4, 6.0)),
        (10.8, EstimatedThread(NODES, True)),
        (10.9, disturbed(10.85, 5.0)),
    ):
        log.add(time - 10.0, frame(time, estimate))
    assert log.count == 2
    first, second = log.events
    assert [first.begin_s, first.end_s] == pytest.approx([0.4, 0.7])
    assert [first.significance, first.arc_length_m] == pytest.approx([7.0, 2.1])
    assert [first.x_m, first.y_m, first.direction_rad] == pytest.approx([0.1, 0.2, math.pi / 2])
    assert second.begin_s == pytest.approx(0.85)
