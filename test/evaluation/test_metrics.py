"""Errors of predictions and estimates, the figures of a run, and what is kept of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from magnetosuture_thread.estimator.disturbance import Disturbance
from magnetosuture_thread.evaluation import metrics
from magnetosuture_thread.evaluation.frames import EstimatedThread, FrameResult, Observation
from magnetosuture_thread.thread.margins import BarrierMargins, Margins
from magnetosuture_thread.thread.prediction import Prediction
from test.evaluation.runs import margins
from test.shared import known

NODES = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])
STRAIGHT = np.column_stack([-0.125 * np.arange(9), np.zeros(9)])
LINE = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])


def test_a_minimum_margin_is_of_one_row_and_the_deepest_chord_of_all():
    """The chord at node 7 is deep at first; later node 3 itself is in the shape."""
    run = metrics.RunMetrics(1.0)
    for k, (node, value, clearance) in enumerate(((7, 2.0, -15.0), (3, -3.0, -5.0)), 1):
        row = np.array([node], np.uint32), np.zeros(1, np.int32), np.array([value]), np.array([clearance])
        run.add(FrameResult(k * 10**9, vertices=STRAIGHT, margins=Margins((BarrierMargins("obstacle", *row),))))
    least = run.minimum_margins["obstacle"]
    assert (least.promised, least.node, least.time, least.chord) == (-3.0, 3, 2.0, -15.0)


def test_of_a_run_numbers_are_kept_and_the_worst_in_full():
    run = metrics.RunMetrics(1.0, 10**9)
    strain = np.array([0.0, -0.002, 0.001, 0.0])
    for k, (y, clearance) in enumerate(((0.01, 0.5), (0.03, -0.1), (0.02, 0.2), (9.0, None)), 1):
        nodes = STRAIGHT + np.array([0.0, y])
        found = Prediction(1.0, "rod", "", nodes, strain, 0.1, 1, "banded", "solved", 1e-9, True, lambda: Margins(()))
        measured = LINE if clearance is not None else LINE[:0]
        margin = margins(clearance) if clearance is not None else None
        observation = Observation(k * 10**9, np.zeros(2), np.array([1.0, 0.0]), measured)
        run.add(FrameResult.of(observation, found, margin, 1e-4))
    for k in range(40):
        run.observe(Observation((5 + k) * 10**9, reason=f"{k % 20}"))
    series = run.series
    assert series.column("error_seen") == pytest.approx([1.0, 3.0, 2.0, np.nan], nan_ok=True)
    assert series.column("seen_share") == pytest.approx([1.0, 1.0, 1.0, 0.0])
    assert series.column("strain")[0] == run.maximum("strain") == 0.002
    assert series.times == pytest.approx([0.0, 1.0, 2.0, 3.0])
    worst = known(run.worst)
    assert (worst.time, worst.error, worst.frame.stamp) == pytest.approx((1.0, 3.0, 2 * 10**9))
    assert worst.frame.clearance.tolist() == [*[np.inf] * 7, -0.1, np.inf]
    assert run.contact_frames == 1
    assert [(m.kind, m.clearance, m.time) for m in run.minimum_margins.values()] == [("obstacle", -0.1, 1.0)]
    assert (len(run.observed), run.tracked) == (40, 0)
    assert len(run.reasons) <= 13
    assert run.reasons["others"] > 0


def test_the_error_is_of_the_nodes_that_are_known_and_none_of_less_than_half():
    curve = np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101)])
    moved = NODES + np.array([0.0, 0.02])
    moved[0] = 9.0  # the needle's
    assert metrics.prediction_error_percent(moved, curve, 1.0) == pytest.approx(2.0)
    moved[8:] += 5.0
    assert metrics.prediction_error_percent(moved, curve[:76], 1.0) == pytest.approx(2.0)
    for short in (curve[:0], curve[:1], curve[:41]):
        assert np.isnan(metrics.prediction_error_percent(NODES, short, 1.0))


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (np.delete(np.arange(0.0, 360.0, 0.1), [50, 51, 52, 90]), metrics.SensorSilence()),  # 0.4 s
        (
            np.concatenate([np.arange(0.0, 60.0, 0.1), np.arange(300.0, 360.0, 0.1)]),
            metrics.SensorSilence(1, 240.1, 240.1, 59.9),
        ),
        (np.arange(100.0, 200.0, 0.1), metrics.SensorSilence(2, 260.1, 160.1, 199.9)),
        (np.concatenate([np.arange(0.0, 360.0, 0.1), [-1.7e9]]), metrics.SensorSilence()),  # a frame stamped 0
    ],
)
def test_the_silence_of_a_sensor_is_counted(times: np.ndarray, expected: metrics.SensorSilence):
    found = metrics.SensorSilence.of(times, 0.0, 360.0)
    assert found.gaps == expected.gaps
    assert (found.total, found.max_gap) == pytest.approx((expected.total, expected.max_gap), abs=0.2)
    assert found.at == pytest.approx(expected.at, abs=0.2, nan_ok=True)


def test_an_estimate_is_measured_beside_a_prediction_that_is_nowhere():
    run, nowhere = metrics.RunMetrics(1.0), STRAIGHT.copy()
    nowhere[3] = np.nan
    run.add(FrameResult(0, vertices=nowhere, ground_truth=LINE, estimate=EstimatedThread(STRAIGHT)))
    assert not len(run.series.known("error_truth"))
    assert run.series.known("estimate_error_truth") == pytest.approx([0.0])


UP = np.array([0.0, 1.0])


def frame(stamp: float, estimate: EstimatedThread | None, **others: Any) -> FrameResult:
    """Return a frame whose prediction is 0.02 m off."""
    return FrameResult(round(stamp * 1e9), vertices=STRAIGHT + 0.02 * UP, estimate=estimate, **others)


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_innovations_are_within_their_band_if_they_are_as_expected(scale: float):
    squared = scale * np.random.default_rng(1).standard_normal((2000, 16)) ** 2
    squared[::3, 5:] = np.nan  # hidden

    def consistency(rows: np.ndarray) -> metrics.Consistency:
        run = metrics.RunMetrics(1.0)
        for k, row in enumerate(rows):
            run.add(frame(0.1 * k, EstimatedThread(STRAIGHT, True, row)))
        return metrics.Consistency.of(run.series)

    found = consistency(squared)
    assert found.windows == 40
    assert found.window_s == pytest.approx(199.9 / 40)
    assert found.normalised_innovation_squared_mean == pytest.approx(np.nanmean(squared), rel=1e-9)
    if scale == 1.0:
        assert found.windows_within_band >= 34
    else:
        assert found.windows_within_band == 0
        for window in map(consistency, np.split(squared, 40)):
            mean, high = window.normalised_innovation_squared_mean, window.band_95_high
            assert window.windows == 1
            assert mean is not None
            assert high is not None
            assert mean > high
    counts = np.array([16.0, 2400.0])
    for count, low, high in zip(counts, *metrics.mean_band(counts), strict=True):
        assert chi2.cdf((low * count, high * count), count) == pytest.approx((0.025, 0.975))


def test_hidden_shares_are_of_time_and_not_of_frames():
    run = metrics.RunMetrics(1.0)
    for time in [*np.arange(0.0, 1.0, 0.1), *np.arange(1.0, 2.0, 0.05)]:
        run.add(frame(time, EstimatedThread(STRAIGHT, time < 1.5), measured=LINE[:5] if time < 1.0 else LINE))
    found = metrics.HiddenShares.of(run.series)
    shares = found.hidden_time_share, found.all_hidden_time_share, found.hidden_length_share
    assert shares == pytest.approx((0.75, 0.25, 0.5), abs=0.02)


def test_disturbances_of_one_beginning_are_one_event():
    run = metrics.RunMetrics(1.0, 10**10)
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
        run.add(frame(time, EstimatedThread(STRAIGHT, True, np.empty(0), found)))
    first, second = run.disturbances
    assert [first.begin_s, first.end_s] == pytest.approx([0.4, 0.7])
    assert [first.significance, first.arc_length_m] == pytest.approx([7.0, 2.1])
    assert [first.x_m, first.y_m, first.direction_rad] == pytest.approx([0.1, 0.2, math.pi / 2])
    assert second.begin_s == pytest.approx(0.85)
