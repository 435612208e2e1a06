"""Errors of predictions, and the figures of a run."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation import metrics as module
from magnetosuture_thread.evaluation.frames import FrameResult, Observation
from magnetosuture_thread.evaluation.metrics import (
    RunMetrics,
    SensorSilence,
    node_errors,
    prediction_error_percent,
    prediction_errors,
    target_points,
)
from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.model.margins import BarrierMargins, Margins
from magnetosuture_thread.model.prediction import Prediction

NODES = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])


def by_definition(vertices: np.ndarray, curve: np.ndarray, length: float) -> float:
    """Return 100 mean |x_i - X(s_i)| / L over the nodes on the curve, node by node."""
    known = arc_lengths(curve)[-1] if len(curve) > 1 else 0.0
    if known < 0.5 * length:
        return float("nan")
    at = length * np.arange(1, len(vertices)) / (len(vertices) - 1)
    off = [
        np.linalg.norm(vertex - points_at(curve, np.array([s]))[0])
        for vertex, s in zip(vertices[1:], at, strict=True)
        if s <= known + 1e-3 * length
    ]
    return float(100.0 * np.mean(off) / length)


def test_errors_of_many_are_those_of_each():
    random = np.random.default_rng(5)
    vertices = random.normal(size=(40, 6, 2))
    curves = [random.normal(size=(random.integers(0, 9), 2)) for _ in range(40)]
    curves[0], curves[-1] = np.empty((0, 2)), np.zeros((1, 2))
    errors, _, shares = prediction_errors(vertices, curves, 2.0)
    single = [by_definition(each, curve, 2.0) for each, curve in zip(vertices, curves, strict=True)]
    assert errors == pytest.approx(single, rel=1e-12, nan_ok=True)
    assert np.isnan(single).any()
    assert np.isfinite(single).any()
    lengths = [arc_lengths(curve)[-1] if len(curve) else 0.0 for curve in curves]
    assert shares == pytest.approx(np.minimum(1.0, np.array(lengths) / 2.0))
    one = [prediction_error_percent(each, curve, 2.0) for each, curve in zip(vertices, curves, strict=True)]
    assert errors == pytest.approx(one, rel=1e-12, nan_ok=True)
    nothing, _, _ = prediction_errors(vertices[:2], [np.empty((0, 2))] * 2, 2.0)
    assert np.isnan(nothing).all()


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


def test_of_a_run_numbers_are_kept_and_the_worst_in_full(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "BATCH", 2)
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


def test_the_first_frame_is_shown_where_nothing_can_be_compared():
    run = RunMetrics(1.0)
    for k in (1, 2):
        observation = Observation(k * 10**9, np.zeros(2), np.array([1.0, 0.0]))
        run.add(FrameResult.of(observation, prediction(0.1 * k), None, 1e-4))
    assert run.worst_measured is not None
    assert run.worst_measured.stamp == 10**9
    assert run.errors() == {"truth": None, "seen": None}


def test_a_prediction_of_another_number_of_nodes_is_compared_too():
    run = RunMetrics(1.0)
    line = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])
    for k, nodes in enumerate((5, 5, 9)):
        vertices = np.column_stack([-np.linspace(0.0, 1.0, nodes), np.full(nodes, 0.01 * nodes)])
        run.add(FrameResult(k, vertices, measured=line if nodes == 5 else np.empty((0, 2)), ground_truth=line))
    assert run.series.column("error_truth") == pytest.approx([5.0, 5.0, 9.0])


def test_a_curve_that_is_not_finite_is_not_known_and_spoils_no_other():
    line = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])
    broken = line.copy()
    broken[3] = np.nan
    vertices = np.stack([np.column_stack([-np.linspace(0.0, 1.0, 5), np.full(5, 0.02)])] * 3)
    errors, _, shares = prediction_errors(vertices, [line, broken, line], 1.0)
    assert errors == pytest.approx([2.0, np.nan, 2.0], nan_ok=True)
    assert shares == pytest.approx([1.0, 0.0, 1.0])


def test_a_prediction_that_is_not_finite_has_no_error():
    vertices = NODES.copy()
    vertices[4] = np.nan
    assert np.isnan(prediction_error_percent(vertices, NODES, 1.0))


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


LENGTH = 0.019
THREAD = np.column_stack([-LENGTH * np.arange(26) / 25, np.zeros(26)])


def errors_of(curve: np.ndarray) -> np.ndarray:
    """Return the errors of the nodes of a straight thread."""
    targets, _ = target_points([curve], LENGTH, 25)
    return node_errors(THREAD, targets[0], LENGTH)


@pytest.mark.parametrize("known", [1.0, 0.8])
def test_the_mean_over_the_nodes_is_the_prediction_error(known: float):
    curve = known * THREAD[[0, 25]] + np.array([0.0, 1e-4])
    errors = errors_of(curve)
    assert np.nanmean(errors) == pytest.approx(prediction_error_percent(THREAD, curve, LENGTH))
    assert np.isnan(errors).sum() == round(25 * (1.0 - known))


def test_a_curve_that_is_a_little_short_tells_of_the_free_end_too():
    assert np.isfinite(errors_of(0.9995 * THREAD)).all()


def test_nothing_is_known_without_a_curve():
    assert np.isnan(errors_of(np.empty((0, 2)))).all()


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
