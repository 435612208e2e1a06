"""The thread in closed loop: the pull on the needle, and where the thread is, beside those of the simulated rig.

The loop of a campaign runs a setup's path follower: the needle moves by the coils' currents, which follow noisy poses.
The rig's rod has springs, and many more segments than the model, which follows the needle's poses as the tracker's
noise leaves them. Compared are the pull, and the nodes of prediction and estimate.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from benchmarks.report import figures_table
from magnetosuture_thread import NeedlePose
from magnetosuture_thread.estimator.thread_session import PredictionResult, ThreadSession
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.rig.closed_loop import START, ClosedLoop
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.setups import Setup, read_setup

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


class PathControl:
    """Commands the velocities of a setup's path follower.

    Attributes:
        done: whether the needle is at the end of its path.
    """

    def __init__(self, setup: Setup) -> None:
        self._follower, self.done = setup.follower.follower(), False

    def __call__(self, stamp: float, tail: Points, heading: Points, condition: object) -> NDArray[np.float64]:
        """Return the velocity for a measured pose, shape (2,) [m/s]."""
        command = self._follower.compute_command(stamp, tail, heading)
        self.done = command.progress >= 1.0
        return np.asarray(command.velocity)


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
    return [_measure(read_setup(name), segments, duration) for name, segments in cases]


def closed_loop_table(figures: list[dict[str, Any]]) -> Table:
    """Return the figures as a table."""
    title = f"closed loop, rig of {TRUE_SEGMENTS} segments, simulated; pull in % of its peak, nodes in % of the length"
    columns = {
        "setup": "{setup}",
        "n": "{segments}",
        "pull, RMS": "{rms_percent:.1f}",
        "median": "{median_percent:.1f}",
        "maximum": "{max_percent:.1f}",
        f"RMS of means over {AVERAGING:g} s": "{averaged_rms_percent:.1f}",
        "peak [N]": "{peak_n:.1e}",
        "prediction, mean (maximum)": "{prediction[mean_percent]:.3f} ({prediction[max_percent]:.2f})",
        "estimate": "{estimate[mean_percent]:.3f} ({estimate[max_percent]:.2f})",
    }
    return figures_table(title, figures, columns)


def _measure(setup: Setup, segments: int, duration: float) -> dict[str, Any]:
    rig, model = replace(setup.rig, thread_segments=TRUE_SEGMENTS), replace(setup.model, segments=segments)
    setup = replace(setup, rig=rig, model=model).with_scene(setup.scene)
    control = PathControl(setup)
    loop = ClosedLoop(setup, Rig(setup.rig, setup.scene), control)
    session = loop.session = _RecordingSession(setup)
    true = dict[int, tuple[Points, NDArray[np.float64]]]()  # of each frame, by its stamp [ns]: the thread, and its pull
    begin: Points | None = None
    while loop.now < START + duration and not control.done:
        is_frame, at = loop.step() is not None, loop.rig.look(loop.rig.time, rendered=False)
        begin = at.tail.copy() if begin is None else begin
        if is_frame and (true or (at.tail != begin).any()):  # from when the needle moves on
            true[round(1e9 * (START + loop.rig.time))] = at.thread, at.pull
    times, pulls, expected = [], [], []
    errors: dict[str, list[float]] = {"prediction": [], "estimate": []}
    for stamp in sorted(session.results.keys() & true.keys()):
        result, (thread, pull) = session.results[stamp], true[stamp]
        forces = result.prediction.forces if result.prediction is not None else None
        if forces is not None:
            pulls.append(forces.needle_force)
            expected.append(pull)
            times.append(1e-9 * stamp)
        for name, found in (("prediction", result.prediction), ("estimate", result.estimate)):
            if found is not None:
                at_nodes = np.linspace(0.0, float(arc_lengths(thread)[-1]), len(found.positions))
                off = np.linalg.norm(found.positions - points_at(thread, at_nodes), axis=1)
                errors[name].append(100.0 * float(off.mean()) / setup.model.thread_length)
    nodes = {
        name: {"mean_percent": float(np.mean(each)), "max_percent": float(np.max(each))}
        for name, each in errors.items()
    }
    return {"setup": setup.name, "segments": segments, **compare_pulls(times, pulls, expected), **nodes}


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
