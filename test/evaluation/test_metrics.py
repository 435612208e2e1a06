"""Errors of predictions, and the figures of a run."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import FrameResult, Observation
from magnetosuture_thread.evaluation.metrics import (
    RunMetrics,
    SensorSilence,
    node_errors,
    prediction_error_percent,
    target_points,
)
from magnetosuture_thread.thread.margins import BarrierMargins, Margins
from magnetosuture_thread.thread.prediction import Prediction

NODES = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])


def prediction(y: float) -> Prediction:
    """Return a straight thread."""
    vertices = np.column_stack([-0.25 * np.arange(5), np.full(5, y)])
    stretch = np.array([0.0, -0.002, 0.001, 0.0])
    return Prediction(1.0, "rod", "", vertices, stretch, 0.1, 1, "banded", "solved", 1e-9, True, lambda: Margins(()))


def margins(clearance: float) -> Margins:
    """Return margins of one node and obstacle."""
    one = np.array([clearance])
    obstacle = BarrierMargins("obstacle", np.array([3], np.uint32), np.array([0], np.int32), one, one)
    return Margins((obstacle,), (3,) if clearance <= 0.0 else ())


def test_a_barrier_of_a_user_has_a_column_and_a_minimum_like_the_others():
    run = RunMetrics(1.0, 10**9)
    line = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])
    tail, east = np.zeros(2), np.array([1.0, 0.0])
    for k, clearance in enumerate((0.5, -0.1, 0.2), 1):
        given = margins(1.0)
        if k > 1:  # it comes while the run goes on
            one = np.array([clearance])
            own = BarrierMargins("tip_keep_in", np.array([4], np.uint32), np.array([-1], np.int32), one, one)
            given = Margins((*given.barriers, own))
        run.add(FrameResult.of(Observation(k * 10**9, tail, east, line), prediction(0.0), given, 1e-4))
    assert run.series.column("margin_tip_keep_in") == pytest.approx([np.nan, -0.1, 0.2], nan_ok=True)
    assert list(run.minimum_margins) == ["obstacle", "tip_keep_in"]
    assert (run.minimum_margins["tip_keep_in"].clearance, run.minimum_margins["tip_keep_in"].node) == (-0.1, 4)


def test_of_a_run_numbers_are_kept_and_the_worst_in_full():
    run = RunMetrics(1.0, 10**9)
    line = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])
    tail, east = np.zeros(2), np.array([1.0, 0.0])
    for k, (y, clearance) in enumerate(((0.01, 0.5), (0.03, -0.1), (0.02, 0.2)), 1):
        run.add(FrameResult.of(Observation(k * 10**9, tail, east, line), prediction(y), margins(clearance), 1e-4))
    run.add(FrameResult.of(Observation(4 * 10**9, tail, east), prediction(9.0), None, 1e-4))
    series = run.series
    assert series.column("error_seen") == pytest.approx([1.0, 3.0, 2.0, np.nan], nan_ok=True)
    assert series.column("seen_share") == pytest.approx([1.0, 1.0, 1.0, 0.0])
    assert series.column("strain")[0] == run.maximum("strain") == 0.002
    assert series.times == pytest.approx([0.0, 1.0, 2.0, 3.0])
    worst = run.worst_measured
    assert worst is not None
    assert worst.stamp == 2 * 10**9
    assert len(worst.vertices) == 5
    assert worst.clearance.tolist() == [np.inf, np.inf, np.inf, -0.1, np.inf]
    assert run.contact_frames == 1
    assert [(m.kind, m.clearance, m.time) for m in run.minimum_margins.values()] == [("obstacle", -0.1, 1.0)]


def test_a_prediction_of_another_number_of_nodes_is_compared_too():
    run = RunMetrics(1.0)
    line = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])
    for k, nodes in enumerate((5, 5, 9)):
        vertices = np.column_stack([-np.linspace(0.0, 1.0, nodes), np.full(nodes, 0.01 * nodes)])
        run.add(FrameResult(k, vertices, measured=line if nodes == 5 else np.empty((0, 2)), ground_truth=line))
    assert run.series.column("error_truth") == pytest.approx([5.0, 5.0, 9.0])


def test_a_prediction_that_is_not_finite_has_no_error():
    vertices = NODES.copy()
    vertices[4] = np.nan
    assert np.isnan(prediction_error_percent(vertices, NODES, 1.0))


def test_an_offset_is_its_share_of_the_length_and_the_tail_does_not_count():
    moved = NODES + np.array([0.0, 0.02])
    moved[0] = 9.0
    curve = np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101)])
    assert prediction_error_percent(moved, curve, 1.0) == pytest.approx(2.0)


def test_nodes_past_what_was_seen_are_left_out():
    moved = NODES.copy()
    moved[8:] += 5.0
    curve = np.array([[0.0, 0.0], [0.75, 0.0]])
    assert prediction_error_percent(moved, curve, 1.0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("curve", [np.empty((0, 2)), np.zeros((1, 2)), np.array([[0.0, 0.0], [0.4, 0.0]])])
def test_too_little_seen_gives_no_score(curve: np.ndarray):
    assert np.isnan(prediction_error_percent(NODES, curve, 1.0))


LENGTH = 0.019
THREAD = np.column_stack([-LENGTH * np.arange(26) / 25, np.zeros(26)])


def errors_of(curve: np.ndarray) -> np.ndarray:
    """Return the errors of the nodes of a straight thread."""
    targets, _ = target_points([curve], LENGTH, 25)
    return node_errors(THREAD, targets[0], LENGTH)


def test_a_curve_that_is_a_little_short_tells_of_the_free_end_too():
    assert np.isfinite(errors_of(0.9995 * THREAD)).all()


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (np.arange(0.0, 360.0, 0.1), SensorSilence()),
        (
            np.concatenate([np.arange(0.0, 60.0, 0.1), np.arange(300.0, 360.0, 0.1)]),
            SensorSilence(1, 240.1, 240.1, 59.9),
        ),
        (np.arange(100.0, 200.0, 0.1), SensorSilence(2, 260.1, 160.1, 199.9)),
        (np.delete(np.arange(0.0, 360.0, 0.1), [50, 51, 52, 90]), SensorSilence()),  # 0.4 s
        (np.arange(0.0, 100.0, 0.1) + 1e9, SensorSilence()),  # of another clock
        (np.array([3.0]), SensorSilence(1, 360.0, 360.0, 0.0)),
    ],
)
def test_the_silence_of_a_sensor_is_counted(times: np.ndarray, expected: SensorSilence):
    found = SensorSilence.of(times, 0.0, 360.0)
    assert found.gaps == expected.gaps
    assert (found.total, found.max_gap) == pytest.approx((expected.total, expected.max_gap), abs=0.2)
    assert found.at == pytest.approx(expected.at, abs=0.2, nan_ok=True)
