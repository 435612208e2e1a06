"""The thread in closed loop: the pull on the needle, and where the thread is, beside those of the simulated rig.

The loop of a campaign runs a setup's path follower: the needle moves by the coils' currents, which follow noisy poses.
The rig's rod has springs, and many more segments than the model. The model follows the needle's poses as the tracker's
noise leaves them, then exactly, at the frames and at every period of the bridge. The pull is compared in all three, the
nodes of prediction and estimate in the first.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from magnetosuture_thread import NeedlePose
from magnetosuture_thread.campaign.loop import START, ClosedLoop
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.setups import Setup, read_setup
from magnetosuture_thread.thread_model.session import PredictionResult, ThreadSession

CASES = (
    ("petri_35mm_polyamide", 25),
    ("petri_35mm_polyamide_post", 25),
    ("hernia_ring", 40),
    ("hernia_ring", 60),
    ("hernia_ring", 80),
)
TRUE_SEGMENTS = 240
SETTLING = 0.5  # s, after the start, in which the model finds velocities of its own
AVERAGING = 0.1  # s, of the running means


class LoopInstant(NamedTuple):
    """The rig at one period of the bridge.

    Attributes:
        pose: of the needle, exact.
        pull: of the thread on the needle, shape (2,) [N].
        thread: shape (n + 1, 2) [m].
        framed: whether a frame was taken.
    """

    pose: NeedlePose
    pull: NDArray[np.float64]
    thread: Points
    framed: bool


class _RecordingSession(ThreadSession):
    """Keeps the results by their stamps [ns]."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup.model, setup.scene)
        self.results: dict[int, PredictionResult] = {}

    def on_pose(self, stamp: int, pose: NeedlePose) -> PredictionResult:
        """Follow the needle to a pose; see `ThreadSession`."""
        self.results[stamp] = super().on_pose(stamp, pose)
        return self.results[stamp]


def measure_closed_loop(cases: tuple[tuple[str, int], ...] = CASES, duration: float = 90.0) -> list[dict[str, Any]]:
    """Return the figures of setups with so many segments; a loop ends with its path, or after a duration [s]."""
    return [figures for name, segments in cases for figures in _measure(read_setup(name), segments, duration)]


def closed_loop_table(figures: list[dict[str, Any]]) -> Table:
    """Return the figures as a table."""
    table = Table(title=f"pull on the needle in closed loop, rig of {TRUE_SEGMENTS} segments, simulated; % of its peak")
    for name in ("setup", "n", "poses", "RMS", "median", "maximum", f"RMS of means over {AVERAGING:g} s", "peak [µN]"):
        table.add_column(name, justify="left" if name in ("setup", "poses") else "right")
    for row in figures:
        shares = (row[f"{name}_percent"] for name in ("rms", "median", "max", "averaged_rms"))
        percents, peak = (f"{share:.1f}" for share in shares), f"{1e6 * row['peak_n']:.0f}"
        table.add_row(row["setup"], str(row["segments"]), row["poses"], *percents, peak)
    return table


def nodes_table(figures: list[dict[str, Any]]) -> Table:
    """Return the errors of the nodes as a table."""
    table = Table(title="nodes in closed loop, tracked poses and threads, simulated; % of the length, mean (maximum)")
    for name in ("setup", "n", "prediction", "estimate"):
        table.add_column(name, justify="left" if name == "setup" else "right")
    for row in figures:
        if "estimate" in row:
            errors = (row[name] for name in ("prediction", "estimate"))
            where = row["setup"], str(row["segments"])
            table.add_row(*where, *(f"{e['mean_percent']:.3f} ({e['max_percent']:.2f})" for e in errors))
    return table


def record_loop(setup: Setup, duration: float) -> tuple[list[LoopInstant], dict[int, PredictionResult]]:
    """Return the rig at every period of a loop, and what the model made of the noisy poses by their stamps [ns]."""
    follower, done = setup.follower.follower(), False

    def control(stamp: float, tail: Points, heading: Points, condition: ThreadCondition) -> NDArray[np.float64]:
        nonlocal done
        command = follower.compute_command(stamp, tail, heading)
        done = command.progress >= 1.0
        return np.asarray(command.velocity)

    loop = ClosedLoop(setup, Rig(setup.rig, setup.scene), control)
    session = loop.session = _RecordingSession(setup)
    instants = list[LoopInstant]()
    while loop.now < START + duration and not done:
        framed, rig = loop.step() is not None, loop.rig
        at = rig.look(rig.time, rendered=False)
        heading = np.array([math.cos(at.heading), math.sin(at.heading)])
        pose = NeedlePose(START + rig.time, at.tail, heading)
        instants.append(LoopInstant(pose, rig.thread_pull, at.thread, framed))
    return instants, session.results


def _measure(setup: Setup, segments: int, duration: float) -> list[dict[str, Any]]:
    rig, model = replace(setup.rig, thread_segments=TRUE_SEGMENTS), replace(setup.model, segments=segments)
    setup = replace(setup, rig=rig, model=model).with_scene(setup.scene)
    instants, results = record_loop(setup, duration)
    begins = next(k for k, instant in enumerate(instants) if (instant.pose.tail != instants[0].pose.tail).any())
    moving = instants[max(begins - 1, 0) :]
    stamps = {round(1e9 * instant.pose.stamp): instant for instant in moving if instant.framed}
    tracked, expected, times = [], [], []
    errors: dict[str, list[float]] = {"prediction": [], "estimate": []}
    for stamp, result in results.items():
        forces = result.prediction.forces if result.prediction is not None else None
        if stamp in stamps and forces is not None:
            tracked.append(forces.needle_force)
            expected.append(stamps[stamp].pull)
            times.append(1e-9 * stamp)
        for name, found in (("prediction", result.prediction), ("estimate", result.estimate)):
            if stamp in stamps and found is not None:
                truth = stamps[stamp].thread
                at = np.linspace(0.0, float(arc_lengths(truth)[-1]), len(found.positions))
                off = np.linalg.norm(found.positions - points_at(truth, at), axis=1)
                errors[name].append(100.0 * float(off.mean()) / setup.model.thread_length)
    rows = {
        f"tracked, {setup.rig.frame_rate:g} Hz": (times, tracked, expected),
        f"exact, {setup.rig.frame_rate:g} Hz": _follow(setup, [instant for instant in moving if instant.framed]),
        f"exact, {setup.coils.rate:g} Hz": _follow(setup, moving),
    }
    case = {"setup": setup.name, "segments": segments}
    figures = [{**case, "poses": poses, **compare_pulls(*found)} for poses, found in rows.items()]
    for name, each in errors.items():
        figures[0][name] = {"mean_percent": float(np.mean(each)), "max_percent": float(np.max(each))}
    return figures


def _follow(setup: Setup, instants: list[LoopInstant]) -> tuple[list[float], list[Points], list[Points]]:
    """Return stamps, and the pulls of the model, which follows the exact poses, and of the rig."""
    predictor, attached, pulls = setup.model.predictor(setup.scene), setup.model.attachment_pose, []
    predictor.start(attached(instants[0].pose), instants[0].thread)
    for instant in instants[1:]:
        forces = predictor.step(attached(instant.pose)).forces
        assert forces is not None
        pulls.append(forces.needle_force)
    return [instant.pose.stamp for instant in instants[1:]], pulls, [instant.pull for instant in instants[1:]]


def compare_pulls(times: list[float], pulls: list[Points], expected: list[Points]) -> dict[str, float]:
    """Return by how much pulls of the needle are off, in % of the greatest.

    Args:
        times: of each [s].
        pulls: of the model, each of shape (2,) [N].
        expected: of the rig.
    """
    at = np.array(times)
    kept = at >= at[0] + SETTLING
    off, true = (np.array(pulls) - expected)[kept], np.array(expected)[kept]
    width = max(1, round(AVERAGING / float(np.median(np.diff(at)))))
    averaged = np.column_stack([np.convolve(side, np.ones(width) / width, "valid") for side in off.T])
    peak = float(np.linalg.norm(true, axis=1).max())
    error = np.linalg.norm(off, axis=1)
    percent = 100.0 / peak
    return {
        "rms_percent": percent * math.sqrt(float(np.mean(error**2))),
        "median_percent": percent * float(np.median(error)),
        "max_percent": percent * float(error.max()),
        "averaged_rms_percent": percent * math.sqrt(float(np.mean(np.sum(averaged**2, axis=1)))),
        "peak_n": peak,
    }
