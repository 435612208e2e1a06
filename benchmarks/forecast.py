"""Time forecasts, and compare them with what then happened on the simulated rig in closed loop.

Times: one forecast of 3 s in steps at 66 Hz of a thread of 81 segments among three posts, on one core. Errors: of
forecasts in the loop of a campaign, of the shipped procedures, in per cent of the thread's length,
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
from typing import Any

import numpy as np

from benchmarks.closed_loop import LoopRecord, Vector
from benchmarks.report import figures_table
from magnetosuture_thread import Disc, NeedlePose, NeedleSafetyFilter, Scene, Thread, ThreadForecaster
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.forecast.forecaster import make_forecaster
from magnetosuture_thread.forecast.published import PublishedForecasts
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.executor import ENDED, ThreadCondition
from magnetosuture_thread.planning.procedure import Procedure, read_procedure
from magnetosuture_thread.planning.session import ProcedureSession
from magnetosuture_thread.rig.campaign import vary
from magnetosuture_thread.rig.closed_loop import LATENCY, START, ClosedLoop
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.setups import Setup, read_procedure_setup
from magnetosuture_thread.thread.material import MATERIALS, Attachment

LOOPS = ("hernia", "slalom", "figure_eight", "dead_end", "wrap_and_tighten")
RATE, HORIZON = 66.0, 3.0  # Hz, s


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
        """Return the motion that is commanded at a measured pose, shape (3,)."""
        session, known = self.session, self.session.known
        known.on_prediction(stamp, condition.tension, lambda: condition.vertices)
        known.on_margins(stamp, condition.problem, condition.friction_nodes, condition.slowdown, known.scene_version)
        session.on_bridge(True, condition.pull.tolist())
        if session.status.state is None and not condition.problem:
            session.on_pose(stamp, tail, heading, stamp)
            session.plan(self._procedure, stamp)
            session.resume(stamp)
        velocity = session.on_pose(stamp, tail, heading, stamp)
        return np.zeros(3) if velocity is None else velocity


def run_loop(name: str, seed: int) -> tuple[Setup, LoopRecord]:
    """Run a procedure with what a seed varies; return the setup and what was done."""
    procedure = read_procedure(name)
    setup = read_procedure_setup(procedure)
    control, variation = ProcedureControl(procedure, setup), vary(setup, seed)
    record, rig = LoopRecord(control.session.new_plan), Rig(variation.setup.rig, setup.scene)
    loop = ClosedLoop(setup, rig, control, seed, recorder=record, losses=variation.losses)
    while loop.now < START + 100.0 and not control.done:
        loop.step()
    return setup, record


def measure_accuracy(name: str, seed: int) -> dict[str, Any]:
    """Return the errors of the forecasts of one procedure as published, five a second, in per cent of the length."""
    setup, record = run_loop(name, seed)
    forecaster = make_forecaster(setup.model, setup.scene)
    slowed, times = setup.model.friction_feedback == "all", np.array([now for now, _ in record.frames])
    moves = [now for now, commanded, _, _ in record.commands if commanded.any()]
    if not moves or times[-1] - moves[0] <= HORIZON + forecaster.step:
        raise ValueError(f"{name}: the needle did not move for {HORIZON:g} s")
    choice, commands, due = PublishedForecasts(forecaster.safety.kinematics), iter(record.commands), moves[0]
    errors, still, count = [], [], 0
    for measured, result, plan in record.measured:
        if plan is not None:
            choice.on_plan(plan)
        estimate = result.estimate
        if estimate is None or not estimate.converged:
            continue
        pose = NeedlePose(measured.stamp, measured.tail, measured.heading)
        for command in commands:
            choice.on_command(*command)
            if command[0] >= pose.stamp + LATENCY:
                break
        if pose.stamp < due:
            choice.update(pose, HORIZON)
            continue
        end = pose.stamp + forecaster.step * round(HORIZON / forecaster.step)
        if end > times[-1]:
            break
        due, count = due + 0.2, count + 1
        problem = choice.judge(estimate)
        forecast = choice.prepare(forecaster, estimate, pose, HORIZON, slowed=slowed)()
        if problem or forecast.problem:
            continue
        # The rig's thread then, between two frames, with as many segments.
        k = int(np.clip(np.searchsorted(times, end, side="right") - 1, 0, len(times) - 2))
        part = (end - times[k]) / (times[k + 1] - times[k])
        true = (1.0 - part) * record.frames[k][1].thread + part * record.frames[k + 1][1].thread
        at, nodes = np.linspace(0.0, setup.model.segments, len(true)), np.arange(setup.model.segments + 1)
        true = np.column_stack([np.interp(nodes, at, side) for side in true.T])
        errors.append(float(np.linalg.norm(forecast.vertices[-1] - true, axis=1).mean()))
        still.append(float(np.linalg.norm(estimate.positions - true, axis=1).mean()))
    percent = 100.0 / setup.model.thread_length
    return {
        "loop": name,
        "forecasts": count,
        "published": len(errors),
        "error_mean_percent": percent * float(np.mean(errors)),
        "error_median_percent": percent * float(np.median(errors)),
        "error_p95_percent": percent * float(np.percentile(errors, 95.0)),
        "still_mean_percent": percent * float(np.mean(still)),
    }


def measure_time(repeats: int) -> float:
    """Return the median of wall-clock time of a forecast of 3 s [ms]."""
    # The command is into the space between needle and a post, which the filter bends aside.
    command = np.array([0.0018, 0.0009])
    posts = {"ahead": (0.0135, 0.0035), "beside": (-0.003, 0.0024), "behind": (-0.009, -0.0023)}
    scene = Scene.create(dish_diameter=0.05, shapes={name: Disc(centre, 0.0015) for name, centre in posts.items()})
    safety = NeedleSafetyFilter(scene, needle_length=0.007, max_speed=0.01)
    thread = Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=81, attachment=Attachment.PINNED)
    forecaster = ThreadForecaster(thread, scene, safety, step=1.0 / RATE, max_step=1.001 / RATE)
    start = forecaster.straight(NeedlePose(0.0, np.array([0.004, -0.0002]), np.array([1.0, 0.0])))

    def forecast() -> object:
        return forecaster.forecast(start, command, HORIZON)

    forecast()  # compiles
    return 1e3 * float(np.median(timeit.repeat(forecast, number=1, repeat=repeats)))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--repeats", type=int, default=50, metavar="N", help="of each time (default: 50)")
    option("--seed", type=int, default=0, metavar="N", help="of the loops (default: 0)")
    option("--loops", nargs="*", default=LOOPS, metavar="NAME", help=f"procedures (default: {' '.join(LOOPS)})")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures."""
    log, milliseconds = terminal.log, measure_time(options.repeats)
    log(f"one forecast of 3 s, n = 81: {milliseconds:.1f} ms")
    loops = []
    for name in options.loops:
        log(f"the loop of {name}, and its forecasts")
        loops.append(measure_accuracy(name, options.seed))
    columns = {
        "loop": "{loop}",
        "error, mean": "{error_mean_percent:.2f}",
        "median": "{error_median_percent:.2f}",
        "95 %": "{error_p95_percent:.2f}",
        "nothing moves, mean": "{still_mean_percent:.2f}",
        "published": "{published} of {forecasts}",
    }
    terminal.print(figures_table("forecasts 3 s ahead against the simulated rig, in % of the length", loops, columns))
    return {"single_ms": milliseconds, "loops": loops}, True
