"""Time forecasts, and compare them with what then happened on the simulated rig in closed loop.

Times: one forecast of 3 s in steps at 66 Hz of a thread of 81 segments among three posts, on one core. Errors: of
forecasts from random moments of runs of the shipped procedures in the loop of a campaign, and of a path follower, under
the commands that were then sent, in per cent of the thread's length. What a seed varies (viscosity, stiffness,
friction, coils) the nodes do not know.

In the loop (simulated rig, the tracker's noise, estimator, and coil bridge) forecasts start from the estimated thread
and the tracked needle, as those of the node `thread_model` do. Each is given the commands of the following seconds as
the bridge took them. What is compared with it is where the rig's needle and thread then were.
"""

from __future__ import annotations

import argparse
import timeit
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.closed_loop import PathControl
from benchmarks.report import figures_table
from magnetosuture_thread import (
    Disc,
    ForecastStart,
    NeedlePose,
    NeedleSafetyFilter,
    Scene,
    Thread,
    ThreadForecaster,
)
from magnetosuture_thread.campaign.loop import START, ClosedLoop, Measurement
from magnetosuture_thread.campaign.run import run_procedure, vary
from magnetosuture_thread.coils.bridge import BridgeOutput
from magnetosuture_thread.commands.command import make_log
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.forecast import NeedleDrag, make_forecaster
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.setups import Setup, read_procedure_setup, read_setup
from magnetosuture_thread.thread.material import MATERIALS, Attachment
from magnetosuture_thread.thread_model.session import PredictionResult

LOOPS = ("hernia", "slalom", "figure_eight", "dead_end", "wrap_and_tighten", "petri_35mm_polyamide_post")
LENGTH, NEEDLE = 0.019, 0.007  # of thread and needle that are timed [m]
RATE, HORIZON = 66.0, 3.0  # Hz, s
POSTS = {"ahead": (0.0135, 0.0035), "beside": (-0.003, 0.0024), "behind": (-0.009, -0.0023)}  # m
POSE = NeedlePose(0.0, np.array([0.004, -0.0002]), np.array([1.0, 0.0]))
COMMAND = np.array([0.0018, 0.0009])  # into the space between needle and a post, which the filter bends aside
MAX_DURATION = 60.0  # s; of the path follower

Vector = NDArray[np.float64]


@dataclass
class LoopRecord:
    """What a loop did, as a `LoopRecorder`.

    Attributes:
        starts: of forecasts, one for each measurement with an estimate.
        times: of the bridge's steps [s].
        commands: that the bridge took in each, shape (2,) [m/s].
        frame_times: of the frames [s].
        tails: of the rig's needle in each, shape (2,) [m].
        threads: of the rig in each, shape (k + 1, 2) [m].
    """

    starts: list[ForecastStart] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    commands: list[Vector] = field(default_factory=list)
    frame_times: list[float] = field(default_factory=list)
    tails: list[Vector] = field(default_factory=list)
    threads: list[Points] = field(default_factory=list)
    _filtered: Vector = field(default_factory=lambda: np.zeros(2))

    def truth(self, time: float, segments: int) -> tuple[Vector, Points]:
        """Return the rig's needle and thread at a time, between two frames, with as many segments."""
        times = np.array(self.frame_times)
        k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        part = (time - times[k]) / (times[k + 1] - times[k])
        tail = (1.0 - part) * self.tails[k] + part * self.tails[k + 1]
        thread = (1.0 - part) * self.threads[k] + part * self.threads[k + 1]
        own = np.linspace(0.0, segments, len(thread))
        return tail, np.column_stack([np.interp(np.arange(segments + 1), own, each) for each in thread.T])

    def on_frame(self, now: float, frame: RigFrame) -> None:
        """Keep the ground truth."""
        self.frame_times.append(now)
        self.tails.append(frame.tail.copy())
        self.threads.append(frame.thread.copy())

    def on_measurement(self, now: float, measured: Measurement, result: PredictionResult, commanded: Vector) -> None:
        """Keep where a forecast starts."""
        if result.estimate is None or not result.estimate.converged:
            return
        pose = NeedlePose(measured.stamp, measured.tail, measured.heading)
        self.starts.append(ForecastStart.of_estimate(result.estimate, pose, self._filtered))

    def on_bridge(self, now: float, output: BridgeOutput) -> None:
        """Keep the command."""
        self.times.append(now)
        self.commands.append(output.commanded)
        self._filtered = output.filtered


def forecaster_of(setup: Setup) -> ThreadForecaster:
    """Return the forecaster of a setup; with the needle's drag where the bridge does not compensate the motion."""
    coils, drag = setup.coils, None
    if not coils.motion_compensation:
        drag = NeedleDrag(coils.needle_drag, coils.needle_drag_across, coils.needle_turning_drag)
    return make_forecaster(setup.model, setup.scene, coils.safety_filter(setup.scene), drag=drag)


def run_loop(name: str, seed: int) -> tuple[Setup, LoopRecord]:
    """Run a procedure, or the path follower of a setup, with what a seed varies; return the setup and what was done."""
    record = LoopRecord()
    try:
        procedure = read_procedure(name)
    except ConfigurationError:
        setup = read_setup(name)
        control, variation = PathControl(setup), vary(setup, seed)
        rig, gains = Rig(variation.setup.rig, setup.scene), variation.coil_gains
        loop = ClosedLoop(setup, rig, control, seed, losses=variation.losses, coil_gains=gains, recorder=record)
        while loop.now < START + MAX_DURATION and not control.done:
            loop.step()
        return setup, record
    setup = read_procedure_setup(procedure)
    run_procedure(procedure, setup, vary(setup, seed), recorder=record)
    return setup, record


def measure_accuracy(name: str, moments: int, horizon: float, seed: int) -> dict[str, Any]:
    """Return the errors of forecasts at random moments of one loop, in per cent of the thread's length.

    Args:
        name: of the procedure, or of the setup whose path follower steers.
        moments: how many forecasts.
        horizon: of each [s].
        seed: of what is varied, and of the moments.
    """
    setup, record = run_loop(name, seed)
    made = forecaster_of(setup)
    steps, slowed = round(horizon / made.step), setup.coils.friction_feedback == "all"
    times, commands = np.array(record.times), np.array(record.commands)
    first = times[np.argmax(commands.any(axis=1))]  # nothing moves before
    last = record.frame_times[-1] - horizon - made.step
    possible = [start for start in record.starts if first <= start.pose.stamp <= last]
    if not possible:
        raise ValueError(f"{name}: the needle did not move for {horizon:g} s")
    errors, needle, moved = [], [], []
    for index in np.random.default_rng(seed).integers(0, len(possible), moments):
        start = possible[index]
        begin = start.pose.stamp
        middles = begin + made.step * (np.arange(steps) + 0.5)
        taken = commands[np.searchsorted(times, middles, side="right") - 1]
        forecast = made.forecast(start, taken, horizon, slowed=slowed)
        if forecast.problem:
            continue  # it ends before the horizon, and is counted
        tail, thread = record.truth(begin + made.step * len(forecast.filtered), setup.model.segments)
        _, before = record.truth(begin, setup.model.segments)
        errors.append(float(np.linalg.norm(forecast.vertices[-1] - thread, axis=1).mean()))
        needle.append(float(np.linalg.norm(forecast.tails[-1] - tail)))
        moved.append(float(np.linalg.norm(before - thread, axis=1).mean()))
    percent = 100.0 / setup.model.thread_length
    return {
        "loop": name,
        "forecasts": moments,
        "without_solution": moments - len(errors),
        "horizon_s": horizon,
        "step_s": made.step,
        "duration_s": float(record.frame_times[-1] - first),
        "error_mean_percent": percent * float(np.mean(errors)),
        "error_median_percent": percent * float(np.median(errors)),
        "error_p95_percent": percent * float(np.percentile(errors, 95.0)),
        "needle_error_mean_percent": percent * float(np.mean(needle)),
        "moved_mean_percent": percent * float(np.mean(moved)),
    }


def measure_times(repeats: int) -> dict[str, Any]:
    """Return the median of wall-clock time of a forecast [ms]."""
    scene = Scene.create(dish_diameter=0.05, shapes={name: Disc(centre, 0.0015) for name, centre in POSTS.items()})
    safety = NeedleSafetyFilter(scene, needle_length=NEEDLE, max_speed=0.01)
    thread = Thread.of(MATERIALS["polyamide_7_0"], length=LENGTH, segments=81, attachment=Attachment.PINNED)
    made = ThreadForecaster(thread, scene, safety, step=1.0 / RATE, max_step=1.001 / RATE)
    start = made.straight(POSE)
    made.forecast(start, COMMAND, HORIZON)  # compiles
    took = timeit.repeat(lambda: made.forecast(start, COMMAND, HORIZON), number=1, repeat=repeats)
    return {"single_ms": 1e3 * float(np.median(took))}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--repeats", type=int, default=50, metavar="N", help="of each time (default: 50)")
    option("--forecasts", type=int, default=100, metavar="N", help="at random moments of each loop (default: 100)")
    option("--seed", type=int, default=0, metavar="N", help="of the loops and moments (default: 0)")
    words = f"procedures, or setups whose path follower steers (default: {' '.join(LOOPS)})"
    option("--loops", nargs="*", default=LOOPS, metavar="NAME", help=words)


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures."""
    log, times = make_log(console), measure_times(options.repeats)
    log(f"one forecast of 3 s, n = 81: {times['single_ms']:.1f} ms")
    loops = []
    for name in options.loops:
        log(f"the loop of {name}, and {options.forecasts} forecasts from it")
        loops.append(measure_accuracy(name, options.forecasts, 3.0, options.seed))
    columns = {
        "loop": "{loop}",
        "error, mean": "{error_mean_percent:.2f}",
        "median": "{error_median_percent:.2f}",
        "95 %": "{error_p95_percent:.2f}",
        "of the needle, mean": "{needle_error_mean_percent:.2f}",
        "the thread moved, mean": "{moved_mean_percent:.2f}",
    }
    title = "forecasts 3 s ahead against the simulated rig, in % of the length"
    console.print(figures_table(title, loops, columns))
    return {"times": times, "loops": loops}, True
