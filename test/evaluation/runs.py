"""Runs that the tests of this folder make: a thread that lies straight, measured and true ones beside it."""

from __future__ import annotations

from typing import Any

import numpy as np

from magnetosuture_thread.estimator import Disturbance
from magnetosuture_thread.evaluation.frames import EstimatedThread, FrameResult, Observation
from magnetosuture_thread.evaluation.graph_outputs import ReplaySummary
from magnetosuture_thread.evaluation.metrics import Percentiles, RunMetrics
from magnetosuture_thread.thread.margins import BarrierMargins, Margins

LENGTH = 0.019
NODES = np.column_stack([0.004 - LENGTH * np.arange(26) / 25, np.zeros(26)])
EVIL = '<script>alert("x")</script>\'"&'


def margins(clearance: float, barrier: str = "obstacle", value: float | None = None) -> Margins:
    """Return margins of node 7 at obstacle 0, or of another barrier; `value` is h, the clearance if None."""
    clearances, values = (np.array([each]) for each in (clearance, clearance if value is None else value))
    row = BarrierMargins(barrier, np.array([7], np.uint32), np.array([0], np.int32), values, clearances)
    return Margins((row,), (7,) if clearance <= 0 else ())


def both(*parts: Margins) -> Margins:
    """Return margins of several barriers."""
    return Margins(tuple(barrier for part in parts for barrier in part.barriers))


def made_metrics(
    frames: int = 300, targets: tuple[str, ...] = ("truth", "seen"), *, estimated: bool = False
) -> RunMetrics:
    """Return the metrics of frames whose predictions are off by more and more, with a needle lost in between.

    Estimates are off by half as much, and the thread is disturbed from frame 200 on.
    """
    metrics = RunMetrics(LENGTH, 10**9, targets)
    for index in range(frames):
        stamp, off = 10**9 + index * 33_333_333, 1e-6 * index
        seen, truth = NODES + np.array([0.0, off]), NODES + np.array([0.0, 2.0 * off])
        if 100 <= index < 120:
            metrics.observe(Observation(stamp, reason=f"hidden by {EVIL}"))
            continue
        metrics.observe(Observation(stamp, NODES[0], np.array([1.0, 0.0]), seen, truth, processing=3e-3))
        given: dict[str, Any] = {"strain": 1e-5, "residual": 1e-9, "step_time": 1e-4, "recorded": seen}
        given |= {"tension": max(1e-6 * index, 5e-6), "pull": np.array([-3e-6, 4e-6])}
        if estimated:
            found = Disturbance(8e-3, 2e-3, NODES[10], np.array([0.0, 1.0]), 3e-6, 9.0, 1.0 + 200 / 30)
            squared, disturbances = np.linspace(0.5, 1.5, 16), (found,) if index >= 200 else ()
            nodes = NODES + np.array([0.0, off])
            given["estimate"] = EstimatedThread(nodes, index > 0, squared, disturbances)
        at = margins(1e-3 - 1e-5 * index)
        metrics.add(FrameResult(stamp, vertices=NODES, margins=at, measured=seen, ground_truth=truth, **given))
    return metrics


def replay_summary(**figures: Any) -> ReplaySummary:
    """Return the summary of a replay in the setup petri of which all is simulated, with some figures."""
    spread = Percentiles(0.012, 0.02, 0.03)
    given: dict[str, Any] = {"bag": "bag", "setup": "petri", "simulated": "all of it", "commands": 0, "driven": 0}
    given |= {"latency": {}, "step_time": spread, "stretch": 1e-6, "seen_share": 0.9, "residual": 1e-9}
    given |= {"error_seen": None, "error_truth": None, "least_margins": [], "contact_frames": 2}
    return ReplaySummary(**given | figures)
