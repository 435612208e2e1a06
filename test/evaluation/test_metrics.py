"""Errors of predictions, the figures of a run, and what is kept of it: columns, worst frames, error map."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import ErrorMap, EstimatedThread, FrameResult, Observation, with_gaps
from magnetosuture_thread.evaluation.metrics import (
    RunMetrics,
    SensorSilence,
    node_errors,
    prediction_error_percent,
    target_points,
)
from magnetosuture_thread.thread.margins import BarrierMargins, Margins
from magnetosuture_thread.thread.prediction import Prediction
from test.evaluation.runs import both, margins

NODES = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])
STRAIGHT = np.column_stack([-0.125 * np.arange(9), np.zeros(9)])
LINE = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])


def test_a_barrier_of_a_user_has_a_column_and_a_minimum_like_the_others():
    run = RunMetrics(1.0)
    for k, clearance in enumerate((0.5, -0.1, 0.2)):  # it comes while the run goes on
        given = both(margins(1.0), margins(clearance, "tip_keep_in")) if k else margins(1.0)
        run.add(FrameResult(k, vertices=STRAIGHT, margins=given))
    assert run.series.column("margin_tip_keep_in") == pytest.approx([np.nan, -0.1, 0.2], nan_ok=True)
    assert list(run.minimum_margins) == ["obstacle", "tip_keep_in"]
    assert run.minimum_margins["tip_keep_in"].clearance == -0.1


def test_a_minimum_margin_is_of_one_row_and_the_deepest_chord_of_all():
    """The chord at node 7 is deep at first; later node 3 itself is in the shape."""
    run = RunMetrics(1.0)
    for k, (node, value, clearance) in enumerate(((7, 2.0, -15.0), (3, -3.0, -5.0)), 1):
        row = np.array([node], np.uint32), np.zeros(1, np.int32), np.array([value]), np.array([clearance])
        run.add(FrameResult(k * 10**9, vertices=STRAIGHT, margins=Margins((BarrierMargins("obstacle", *row),))))
    least = run.minimum_margins["obstacle"]
    assert (least.promised, least.node, least.time, least.chord) == (-3.0, 3, 2.0, -15.0)


def test_of_a_run_numbers_are_kept_and_the_worst_in_full():
    run = RunMetrics(1.0, 10**9)
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
    assert run.worst is not None
    assert (run.worst.time, run.worst.error, run.worst.frame.stamp) == pytest.approx((1.0, 3.0, 2 * 10**9))
    assert run.worst.frame.clearance.tolist() == [*[np.inf] * 7, -0.1, np.inf]
    assert run.contact_frames == 1
    assert [(m.kind, m.clearance, m.time) for m in run.minimum_margins.values()] == [("obstacle", -0.1, 1.0)]
    assert (len(run.observed), run.tracked) == (40, 0)
    assert len(run.reasons) <= 13
    assert run.reasons["others"] > 0


def test_the_error_is_of_the_nodes_that_are_known_and_none_of_less_than_half():
    curve = np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101)])
    moved = NODES + np.array([0.0, 0.02])
    moved[0] = 9.0  # the needle's
    assert prediction_error_percent(moved, curve, 1.0) == pytest.approx(2.0)
    moved[8:] += 5.0
    assert prediction_error_percent(moved, curve[:76], 1.0) == pytest.approx(2.0)
    for short in (curve[:0], curve[:1], curve[:41]):
        assert np.isnan(prediction_error_percent(NODES, short, 1.0))
    targets, _ = target_points(0.9995 * NODES, 1.0, 10)  # chords of a curve are a little short
    assert np.isfinite(node_errors(NODES, targets, 1.0)).all()


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (np.delete(np.arange(0.0, 360.0, 0.1), [50, 51, 52, 90]), SensorSilence()),  # 0.4 s
        (
            np.concatenate([np.arange(0.0, 60.0, 0.1), np.arange(300.0, 360.0, 0.1)]),
            SensorSilence(1, 240.1, 240.1, 59.9),
        ),
        (np.arange(100.0, 200.0, 0.1), SensorSilence(2, 260.1, 160.1, 199.9)),
        (np.arange(0.0, 100.0, 0.1) + 1e9, SensorSilence()),  # of another clock
        (np.concatenate([np.arange(0.0, 360.0, 0.1), [-1.7e9]]), SensorSilence()),  # a frame stamped 0
        (np.array([3.0]), SensorSilence(1, 360.0, 360.0, 0.0)),
    ],
)
def test_the_silence_of_a_sensor_is_counted(times: np.ndarray, expected: SensorSilence):
    found = SensorSilence.of(times, 0.0, 360.0)
    assert found.gaps == expected.gaps
    assert (found.total, found.max_gap) == pytest.approx((expected.total, expected.max_gap), abs=0.2)
    assert found.at == pytest.approx(expected.at, abs=0.2, nan_ok=True)


def test_a_line_is_broken_where_nothing_came():
    times = np.concatenate([np.arange(10) / 30.0, 5.0 + np.arange(10) / 30.0])
    at, values = with_gaps(times, np.ones(20))
    assert (len(at), int(np.isnan(values).sum())) == (22, 2)
    assert at[10:12] == pytest.approx([10 / 30.0, 5.0 - 1 / 30.0])


@pytest.mark.parametrize("frames", [1, 8, 9, 4096])
def test_the_map_stays_small_and_keeps_the_greatest_errors(frames: int):
    gathered = ErrorMap(0.019, columns=4)
    values = np.random.default_rng(frames).random((frames, 3))
    for index, errors in enumerate(values):
        gathered.add(index / 30.0, errors)
    grid = gathered.grid()
    assert grid is not None
    times, lengths, found = grid
    assert found.shape[1] == len(times) <= 8
    assert found.max(axis=1).tolist() == values.max(axis=0).tolist()
    assert lengths[-1] == 0.019


@pytest.mark.parametrize("nodes", [np.array([[0.0, 0.0], [0.01, np.nan], [0.02, 0.0]]), np.zeros((1, 2))])
def test_a_prediction_with_a_node_that_is_nowhere_has_no_error(nodes: np.ndarray):
    curve = np.column_stack([np.linspace(0.0, 0.02, 50), np.zeros(50)])
    assert np.isnan(prediction_error_percent(nodes, curve, 0.02))


def test_an_estimate_is_measured_beside_a_prediction_that_is_nowhere():
    run, nowhere = RunMetrics(1.0), STRAIGHT.copy()
    nowhere[3] = np.nan
    run.add(FrameResult(0, vertices=nowhere, ground_truth=LINE, estimate=EstimatedThread(STRAIGHT)))
    assert not len(run.series.known("error_truth"))
    assert run.series.known("estimate_error_truth") == pytest.approx([0.0])
