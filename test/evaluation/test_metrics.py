"""Errors of predictions, the figures of a run, and what is kept of it: columns, worst frames, error map."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import (
    ErrorMap,
    FrameResult,
    Observation,
    TimeSeries,
    WorstFrames,
    with_gaps,
)
from magnetosuture_thread.evaluation.metrics import (
    RunMetrics,
    SensorSilence,
    node_errors,
    prediction_error_percent,
    target_points,
)
from magnetosuture_thread.evaluation.page import thinned
from magnetosuture_thread.thread.margins import BarrierMargins, Margins
from magnetosuture_thread.thread.prediction import Prediction

NODES = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])


STRAIGHT = np.column_stack([-0.25 * np.arange(5), np.zeros(5)])
LINE = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])
NEEDLE = (np.zeros(2), np.array([1.0, 0.0]))  # tail and heading


def margins(clearance: float, barrier: str = "obstacle", node: int = 3) -> Margins:
    """Return margins of one node."""
    one, obstacle = np.array([clearance]), np.array([0 if barrier == "obstacle" else -1], np.int32)
    row = BarrierMargins(barrier, np.array([node], np.uint32), obstacle, one, one)
    return Margins((row,), (node,) if clearance <= 0.0 else ())


def test_a_barrier_of_a_user_has_a_column_and_a_minimum_like_the_others():
    run = RunMetrics(1.0)
    for k, clearance in enumerate((0.5, -0.1, 0.2)):
        given = margins(1.0).barriers
        if k:  # it comes while the run goes on
            given += margins(clearance, "tip_keep_in", 4).barriers
        run.add(FrameResult(k, STRAIGHT, margins=Margins(given)))
    assert run.series.column("margin_tip_keep_in") == pytest.approx([np.nan, -0.1, 0.2], nan_ok=True)
    assert list(run.minimum_margins) == ["obstacle", "tip_keep_in"]
    assert (run.minimum_margins["tip_keep_in"].clearance, run.minimum_margins["tip_keep_in"].node) == (-0.1, 4)


def test_of_a_run_numbers_are_kept_and_the_worst_in_full():
    run = RunMetrics(1.0, 10**9)
    strain = np.array([0.0, -0.002, 0.001, 0.0])
    for k, (y, clearance) in enumerate(((0.01, 0.5), (0.03, -0.1), (0.02, 0.2), (9.0, None)), 1):
        nodes = STRAIGHT + np.array([0.0, y])
        found = Prediction(1.0, "rod", "", nodes, strain, 0.1, 1, "banded", "solved", 1e-9, True, lambda: Margins(()))
        measured = LINE if clearance is not None else LINE[:0]
        margin = margins(clearance) if clearance is not None else None
        run.add(FrameResult.of(Observation(k * 10**9, *NEEDLE, measured), found, margin, 1e-4))
    for k in range(40):
        run.observe(Observation((5 + k) * 10**9, reason=f"{k % 20}"))
    series = run.series
    assert series.column("error_seen") == pytest.approx([1.0, 3.0, 2.0, np.nan], nan_ok=True)
    assert series.column("seen_share") == pytest.approx([1.0, 1.0, 1.0, 0.0])
    assert series.column("strain")[0] == run.maximum("strain") == 0.002
    assert series.times == pytest.approx([0.0, 1.0, 2.0, 3.0])
    worst = run.worst_measured
    assert worst is not None
    assert (worst.stamp, len(worst.vertices)) == (2 * 10**9, 5)
    assert worst.clearance.tolist() == [np.inf, np.inf, np.inf, -0.1, np.inf]
    assert run.contact_frames == 1
    assert [(m.kind, m.clearance, m.time) for m in run.minimum_margins.values()] == [("obstacle", -0.1, 1.0)]
    assert run.lost == [[4.0, 43.0]]
    assert len(run.reasons) <= 13
    assert run.reasons["others"] > 0


def test_a_prediction_of_another_number_of_nodes_is_compared_too():
    run = RunMetrics(1.0)
    for k, nodes in enumerate((5, 5, 9)):
        vertices = np.column_stack([-np.linspace(0.0, 1.0, nodes), np.full(nodes, 0.01 * nodes)])
        run.add(FrameResult(k, vertices, measured=LINE if nodes == 5 else LINE[:0], ground_truth=LINE))
    assert run.series.column("error_truth") == pytest.approx([5.0, 5.0, 9.0])


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


def test_a_curve_that_is_a_little_short_tells_of_the_free_end_too():
    targets, _ = target_points([0.9995 * NODES], 1.0, 10)
    assert np.isfinite(node_errors(NODES, targets[0], 1.0)).all()


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


def test_what_is_not_named_is_nan():
    table = TimeSeries(["a", "b"])
    table.add(0.5, {"a": 1.0})
    assert (len(table), table.times.tolist(), table.column("a").tolist()) == (1, [0.5], [1.0])
    assert table.known("a").tolist() == [1.0]
    assert table.known("b").tolist() == []
    with pytest.raises(KeyError, match="no such columns: c"):
        table.add(1.0, {"c": 1.0})


@pytest.mark.parametrize("count", [5001, 17_999, 18_000, 123_457])
def test_no_peak_is_lost_and_no_line_is_longer_than_the_limit(count: int):
    times = np.arange(count) / 30.0
    values = np.random.default_rng(count).normal(size=count)
    values[count // 3], values[-1] = 50.0, -50.0
    values[7] = np.nan
    at, columns = thinned(times, {"a": values}, 5000)
    assert len(at) == len(columns["a"]) <= 5000
    assert (np.nanmax(columns["a"]), np.nanmin(columns["a"])) == (50.0, -50.0)
    assert (np.diff(at) >= 0.0).all()
    peak = at[int(np.nanargmax(columns["a"]))]
    assert abs(peak - times[count // 3]) <= 2.0 * count / 5000 / 30.0 + 1 / 30.0


def test_a_line_is_broken_where_nothing_came():
    times = np.array([0.0, 0.1, 0.2, 3.0, 3.1])
    at, values = with_gaps(times, np.arange(5.0))
    assert at[3:5] == pytest.approx([0.3, 2.9])
    assert np.isnan(values[3:5]).all()
    assert np.delete(values, [3, 4]).tolist() == [0, 1, 2, 3, 4]


def test_they_are_the_worst_first_and_apart():
    worst = WorstFrames(count=3, apart=1.0)
    for time, error in ((0.2, 1.0), (0.7, 9.0), (0.9, 8.0), (3.0, 5.0), (3.6, 4.0), (8.0, 2.0), (9.0, np.nan)):
        worst.add(time, error, FrameResult(round(time * 1e9)))
    found = worst.found()
    assert [(moment.time, moment.error) for moment in found] == [(0.7, 9.0), (3.0, 5.0), (8.0, 2.0)]
    assert found[0].frame.stamp == 700_000_000


LENGTH = 0.019


@pytest.mark.parametrize("frames", [1, 8, 9, 1000, 4096])
def test_the_map_stays_small_and_keeps_the_greatest_errors(frames: int):
    gathered = ErrorMap(LENGTH, columns=4)
    values = np.random.default_rng(frames).random((frames, 3))
    for index, errors in enumerate(values):
        gathered.add(index / 30.0, errors)
    grid = gathered.grid()
    assert grid is not None
    times, lengths, found = grid
    assert found.shape[1] == len(times) <= 8
    assert found.max(axis=1).tolist() == values.max(axis=0).tolist()
    assert lengths[-1] == LENGTH
