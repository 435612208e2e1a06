"""Time forecasts, and compare them with what then happened on the simulated rig in closed loop.

Times: one forecast of 3 s in steps at 66 Hz of a thread of 81 segments among three posts, on one core. Errors: of
forecasts in the loop of a campaign, of the shipped procedures and a path follower, in per cent of the thread's length,
beside those of a forecast that nothing moves. What a seed varies (viscosity, stiffness, friction, coils) the nodes do
not know.

In the loop (simulated rig, the tracker's noise, estimator, and coil bridge) forecasts are those that the node
`thread_model` publishes: they start from the estimated thread and the tracked needle, and go by the needle's plan or
the command that is held; those that the node would withhold are counted, and are in no error. What is compared with
them is where the rig's needle and thread then were.
"""

from __future__ import annotations

import argparse
import timeit
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.closed_loop import PathControl
from benchmarks.report import figures_table
from magnetosuture_thread import Disc, NeedlePose, NeedleSafetyFilter, Scene, Thread, ThreadEstimate, ThreadForecaster
from magnetosuture_thread.coils.bridge import BridgeOutput
from magnetosuture_thread.commands.command import make_log
from magnetosuture_thread.estimator.thread_session import PredictionResult
from magnetosuture_thread.forecast import make_forecaster
from magnetosuture_thread.forecast.published import PublishedForecasts
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.executor import ENDED, ThreadCondition
from magnetosuture_thread.planning.procedure import Procedure, read_procedure
from magnetosuture_thread.planning.session import ProcedureSession
from magnetosuture_thread.rig.campaign import vary
from magnetosuture_thread.rig.closed_loop import LATENCY, START, ClosedLoop, Measurement
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.setups import Setup, read_procedure_setup, read_setup
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.thread.material import MATERIALS, Attachment

LOOPS = ("hernia", "slalom", "figure_eight", "dead_end", "wrap_and_tighten", "petri_35mm_polyamide_post")
LENGTH, NEEDLE = 0.019, 0.007  # of thread and needle that are timed [m]
RATE, HORIZON = 66.0, 3.0  # Hz, s
POSTS = {"ahead": (0.0135, 0.0035), "beside": (-0.003, 0.0024), "behind": (-0.009, -0.0023)}  # m
POSE = NeedlePose(0.0, np.array([0.004, -0.0002]), np.array([1.0, 0.0]))
COMMAND = np.array([0.0018, 0.0009])  # into the space between needle and a post, which the filter bends aside
MAX_DURATION = 100.0  # s; of a loop

Vector = NDArray[np.float64]


@dataclass
class LoopRecord:
    """What a loop did, as a `LoopRecorder`.

    Attributes:
        measured: the needle's pose and the estimate of each measurement, and the plan if there was a new one.
        commands: time [s], commanded and filtered velocity, shapes (2,) [m/s], and input of each step of the bridge.
        frame_times: of the frames [s].
        tails: of the rig's needle in each, shape (2,) [m].
        threads: of the rig in each, shape (k + 1, 2) [m].
    """

    new_plan: Callable[[], Points | None] = lambda: None
    measured: list[tuple[NeedlePose, ThreadEstimate, Points | None]] = field(default_factory=list)
    commands: list[tuple[float, Vector, Vector, str]] = field(default_factory=list)
    frame_times: list[float] = field(default_factory=list)
    tails: list[Vector] = field(default_factory=list)
    threads: list[Points] = field(default_factory=list)

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
        """Keep what a forecast starts from."""
        if result.estimate is not None and result.estimate.converged:
            pose = NeedlePose(measured.stamp, measured.tail, measured.heading)
            self.measured.append((pose, result.estimate, self.new_plan()))

    def on_bridge(self, now: float, output: BridgeOutput) -> None:
        """Keep the command."""
        self.commands.append((now, output.commanded, output.filtered, output.source))


class ProcedureControl:
    """Executes a procedure, as the needle planner does.

    Attributes:
        session: of the procedure.
    """

    def __init__(self, procedure: Procedure, setup: Setup) -> None:
        self.session, self._procedure = ProcedureSession(setup.planner, setup.scene), procedure

    @property
    def done(self) -> bool:
        """Whether the procedure has ended."""
        return self.session.status.state in ENDED

    def __call__(self, stamp: float, tail: Points, heading: Points, condition: ThreadCondition) -> Vector:
        """Return the velocity for a measured pose, shape (2,) [m/s]."""
        session, known = self.session, self.session.known
        known.on_prediction(stamp, condition.tension, lambda: condition.vertices)
        known.on_margins(stamp, condition.problem, condition.friction_nodes, condition.slowdown, known.scene_version)
        session.on_bridge(True, condition.drift)
        if session.status.state is None and not condition.problem:
            session.on_pose(stamp, tail, heading, stamp)
            session.plan(self._procedure, stamp)
            session.resume()
        velocity = session.on_pose(stamp, tail, heading, stamp)
        return np.zeros(2) if velocity is None else velocity


def run_loop(name: str, seed: int) -> tuple[Setup, LoopRecord]:
    """Run a procedure, or the path follower of a setup, with what a seed varies; return the setup and what was done."""
    record = LoopRecord()
    control: ProcedureControl | PathControl
    try:
        procedure = read_procedure(name)
    except ConfigurationError:
        setup = read_setup(name)
        control = PathControl(setup)
    else:
        setup = read_procedure_setup(procedure)
        control = ProcedureControl(procedure, setup)
        record.new_plan = control.session.new_plan
    variation = vary(setup, seed)
    rig, gains = Rig(variation.setup.rig, setup.scene), variation.coil_gains
    loop = ClosedLoop(setup, rig, control, seed, losses=variation.losses, coil_gains=gains, recorder=record)
    while loop.now < START + MAX_DURATION and not control.done:
        loop.step()
    return setup, record


def measure_accuracy(name: str, period: float, horizon: float, seed: int) -> dict[str, Any]:
    """Return the errors of the forecasts of one loop as they are published, in per cent of the thread's length.

    Args:
        name: of the procedure, or of the setup whose path follower steers.
        period: from one forecast to the next [s].
        horizon: of each [s].
        seed: of what is varied.
    """
    setup, record = run_loop(name, seed)
    made, segments = make_forecaster(setup.model, setup.scene), setup.model.segments
    slowed = setup.model.friction_feedback == "all"
    moves = [time for time, commanded, _, _ in record.commands if commanded.any()]
    if not moves or record.frame_times[-1] - moves[0] <= horizon + made.step:
        raise ValueError(f"{name}: the needle did not move for {horizon:g} s")
    choice, commands, due = PublishedForecasts(made.safety.kinematics), iter(record.commands), moves[0]
    errors, still, needle, count, failed = [], [], [], 0, 0
    for pose, estimate, plan in record.measured:
        for command in commands:
            choice.on_command(*command)
            if command[0] >= pose.stamp + LATENCY:
                break
        if plan is not None:
            choice.on_plan(plan)
        if pose.stamp < due:
            choice.update(pose, horizon)
            continue
        end = pose.stamp + made.step * round(horizon / made.step)
        if end > record.frame_times[-1]:
            break
        due, count = due + period, count + 1
        problem = choice.judge(estimate)
        forecast = choice.prepare(made, estimate, pose, horizon, slowed=slowed)()
        failed += bool(forecast.problem)
        if problem or forecast.problem:
            continue
        tail, thread = record.truth(end, segments)
        errors.append(float(np.linalg.norm(forecast.vertices[-1] - thread, axis=1).mean()))
        still.append(float(np.linalg.norm(estimate.positions - thread, axis=1).mean()))
        needle.append(float(np.linalg.norm(forecast.tails[-1] - tail)))
    percent = 100.0 / setup.model.thread_length
    return {
        "loop": name,
        "forecasts": count,
        "published": len(errors),
        "without_solution": failed,
        "horizon_s": horizon,
        "step_s": made.step,
        "duration_s": record.frame_times[-1] - moves[0],
        "error_mean_percent": percent * float(np.mean(errors)),
        "error_median_percent": percent * float(np.median(errors)),
        "error_p95_percent": percent * float(np.percentile(errors, 95.0)),
        "needle_error_mean_percent": percent * float(np.mean(needle)),
        "still_mean_percent": percent * float(np.mean(still)),
        "worse_than_still": int(np.sum(np.array(errors) > still)),
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
    option("--period", type=float, default=0.2, metavar="S", help="from one forecast to the next (default: 0.2)")
    option("--seed", type=int, default=0, metavar="N", help="of the loops (default: 0)")
    words = f"procedures, or setups whose path follower steers (default: {' '.join(LOOPS)})"
    option("--loops", nargs="*", default=LOOPS, metavar="NAME", help=words)


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures."""
    log, times = make_log(console), measure_times(options.repeats)
    log(f"one forecast of 3 s, n = 81: {times['single_ms']:.1f} ms")
    loops = []
    for name in options.loops:
        log(f"the loop of {name}, and its forecasts")
        loops.append(measure_accuracy(name, options.period, 3.0, options.seed))
    columns = {
        "loop": "{loop}",
        "error, mean": "{error_mean_percent:.2f}",
        "median": "{error_median_percent:.2f}",
        "95 %": "{error_p95_percent:.2f}",
        "of the needle, mean": "{needle_error_mean_percent:.2f}",
        "nothing moves, mean": "{still_mean_percent:.2f}",
        "published": "{published} of {forecasts}",
    }
    title = "forecasts 3 s ahead against the simulated rig, in % of the length"
    console.print(figures_table(title, loops, columns))
    return {"times": times, "loops": loops}, True
