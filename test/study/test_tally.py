"""Figures of a run, kept as it goes on."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.model.margins import LeastBarrier, Margins
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.study import tally
from magnetosuture_thread.study.score import prediction_error_percent
from magnetosuture_thread.study.sight import Sight
from magnetosuture_thread.study.tally import Tally, errors_percent


def test_errors_of_many_are_those_of_each():
    random = np.random.default_rng(5)
    vertices = random.normal(size=(40, 6, 2))
    curves = [random.normal(size=(random.integers(0, 9), 2)) for _ in range(40)]
    curves[0], curves[-1] = np.empty((0, 2)), np.zeros((1, 2))
    errors, lengths = errors_percent(vertices, curves, 2.0)
    single = [prediction_error_percent(each, curve, 2.0) for each, curve in zip(vertices, curves, strict=True)]
    assert errors == pytest.approx(single, rel=1e-12, nan_ok=True)
    assert np.isnan(single).any()
    assert np.isfinite(single).any()
    assert lengths[1] == pytest.approx(np.linalg.norm(np.diff(curves[1], axis=0), axis=1).sum())
    nothing, _ = errors_percent(vertices[:2], [np.empty((0, 2))] * 2, 2.0)
    assert np.isnan(nothing).all()


def prediction(y: float) -> Prediction:
    """Return a straight thread."""
    vertices = np.column_stack([-0.25 * np.arange(5), np.full(5, y)])
    stretch = np.array([0.0, -0.002, 0.001, 0.0])
    return Prediction(1.0, "rod", "", vertices, stretch, 0.1, 1, "banded", "solved", 1e-9, True, list)


def margins(clearance: float) -> Margins:
    """Return margins of one node and obstacle."""
    return Margins(
        kind=np.array([2], dtype=np.uint8),
        node=np.array([3], dtype=np.uint32),
        obstacle=np.array([0], dtype=np.int32),
        value=np.array([clearance]),
        clearance=np.array([clearance]),
        least=(LeastBarrier(2, 3, 0, clearance, clearance),),
        touching=(3,) if clearance <= 0.0 else (),
    )


def test_of_a_run_numbers_are_kept_and_the_worst_in_full(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tally, "AT_ONCE", 2)
    kept = Tally(length=1.0)
    line = np.column_stack([-np.linspace(0.0, 1.0, 9), np.zeros(9)])
    tail, east = np.zeros(2), np.array([1.0, 0.0])
    for k, (y, clearance) in enumerate(((0.01, 0.5), (0.03, -0.1), (0.02, 0.2)), 1):
        kept.take(Sight(k * 10**9, tail, east, line), prediction(y), margins(clearance), 1e-4)
    kept.take(Sight(4 * 10**9, tail, east), prediction(9.0), None, 1e-4)
    assert [instant.error_seen for instant in kept.instants] == pytest.approx([1.0, 3.0, 2.0, np.nan], nan_ok=True)
    assert [instant.seen_share for instant in kept.instants] == pytest.approx([1.0, 1.0, 1.0, 0.0])
    assert all(len(instant.vertices) == 0 for instant in kept.instants)
    assert kept.instants[0].stretch == 0.002
    assert kept.worst is not None
    assert kept.worst.stamp == 2 * 10**9
    assert len(kept.worst.vertices) == 5
    assert kept.worst.clearance.tolist() == [np.inf, np.inf, np.inf, -0.1, np.inf]
    assert kept.contact_frames == 1
    assert [(m.kind, m.clearance, m.time) for m in kept.least_margins(10**9)] == [("obstacle", -0.1, 1.0)]
