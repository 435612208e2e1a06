"""Runs that the tests of this folder make: a thread that lies straight, measured and true ones beside it."""

from __future__ import annotations

from typing import Any

import numpy as np

from magnetosuture_thread.evaluation.frames import EstimatedThread, FrameResult, Observation
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.thread.margins import BarrierMargins, Margins

LENGTH = 0.019
NODES = np.column_stack([0.004 - LENGTH * np.arange(26) / 25, np.zeros(26)])
EVIL = '<script>alert("x")</script>\'"&'

# Columns of an evaluated bag's row that differ from run to run.
TIMES = ("step_median_s", "step_p99_s", "tracker_median_s", "tracker_p99_s")


def margins(clearance: float) -> Margins:
    """Return margins of node 7 at obstacle 0."""
    nodes, clearances = np.array([7], np.uint32), np.array([clearance])
    row = BarrierMargins("obstacle", nodes, np.zeros(1, np.int32), clearances, clearances)
    return Margins((row,), (7,) if clearance <= 0 else ())


def made_metrics(frames: int) -> RunMetrics:
    """Return the metrics of frames whose predictions are off by more and more; their estimates by half as much."""
    metrics = RunMetrics(LENGTH, 10**9, ("truth",))
    for index in range(frames):
        stamp, off = 10**9 + index * 33_333_333, 1e-6 * index
        seen, truth = NODES + np.array([0.0, off]), NODES + np.array([0.0, 2.0 * off])
        metrics.observe(Observation(stamp, NODES[0], np.array([1.0, 0.0]), seen, truth, processing=3e-3))
        given: dict[str, Any] = {"strain": 1e-5, "residual": 1e-9, "step_time": 1e-4, "recorded": seen}
        given |= {"tension": max(1e-6 * index, 5e-6), "pull": np.array([-3e-6, 4e-6])}
        given["estimate"] = EstimatedThread(seen, index > 0, np.linspace(0.5, 1.5, 16))
        at = margins(1e-3 - 1e-5 * index)
        metrics.add(FrameResult(stamp, vertices=NODES, margins=at, measured=seen, ground_truth=truth, **given))
    return metrics
