"""Forecasts against what then happened: the simulated rig under coil bridge and path follower, without a graph.

The path follower steers by the rig's own poses, without camera. At random moments a forecast starts from where the
predictor has the thread, which follows the same poses from the start on, and is given the commands of the following
seconds as they were sent. What is compared with it is where the rig's needle and thread then were.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread import ForecastStart, NeedlePose, ThreadForecaster
from magnetosuture_thread.coils.bridge import NEEDLE, CoilBridge
from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.forecast import NeedleDrag, make_forecaster
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.setups import Setup, read_setup

EPOCH = 100.0  # s; stamps of 0 are none in ROS
READY = DriverState(ready=True, timeout=0.2)
MAX_DURATION = 60.0  # s


@dataclass(frozen=True)
class Moment:
    """A frame of the loop.

    Attributes:
        start: of a forecast, from the predictor.
        command: that was sent upon it, shape (2,) [m/s].
        tail: the rig's needle, shape (2,) [m].
        thread: the rig's thread at the model's nodes, shape (n + 1, 2) [m].
    """

    start: ForecastStart
    command: NDArray[np.float64]
    tail: NDArray[np.float64]
    thread: Points


def forecaster_of(setup: Setup) -> ThreadForecaster:
    """Return the forecaster of a setup, with a step for each of its frames."""
    coils = setup.coils
    drag = NeedleDrag(coils.needle_drag, coils.needle_drag_across, coils.needle_turning_drag)
    return make_forecaster(
        setup.model, setup.scene, coils.safety_filter(setup.scene), drag=drag, step=1.0 / setup.rig.frame_rate
    )


def run_loop(setup: Setup, duration: float) -> list[Moment]:
    """Return every frame of a loop, from the first command on, until the path is done or the time is over [s]."""
    scene, rig_settings, model = setup.scene, setup.rig, setup.model
    rig, follower = Rig(rig_settings, scene), setup.follower.follower()
    latch = ArmingLatch()
    bridge = CoilBridge(setup.coils, latch, scene)
    latch.activate()
    bridge.arm(READY)
    predictor, law, motion = model.predictor(scene), model.friction_law(), model.node_motion()
    period, frame, at = 1.0 / setup.coils.rate, 1.0 / rig_settings.frame_rate, 0.0
    next_frame, count, moments, velocity = 0.0, 0, list[Moment](), np.zeros(2)
    filtered = np.zeros(2)
    at_nodes = np.linspace(0.0, rig_settings.thread_segments, model.segments + 1)
    while at < duration:
        at += period
        rig.advance(at)
        now = EPOCH + at
        if at >= next_frame - 1e-9:
            next_frame, count = next_frame + frame, count + 1
            dynamics = rig._dynamics
            heading = np.array([math.cos(dynamics.heading), math.sin(dynamics.heading)])
            pose, thread = NeedlePose(now, dynamics.tail, heading), dynamics.thread
            attached = model.attachment_pose(pose)
            prediction = predictor.step(attached) if predictor.started else predictor.start(attached, thread)
            friction = law.classify(prediction.margins, motion.update(prediction.positions, prediction.interval))
            before = np.minimum(at_nodes.astype(int), rig_settings.thread_segments - 1)
            part = (at_nodes - before)[:, None]
            nodes = (1.0 - part) * thread[before] + part * thread[before + 1]
            command = follower.compute_command(now, pose.tail, heading)
            if velocity.any():
                pull = prediction.forces.needle_force if prediction.forces is not None else None
                start = ForecastStart.of_predictor(predictor, pose, filtered, pull)
                moments.append(Moment(start, command.velocity, pose.tail, nodes))
            if command.progress >= 1.0:
                break
            velocity = command.velocity
            with suppress(InvalidInputError):  # of a tail that jumps as the thread comes free, as the node does
                bridge.on_pose(pose.tail, heading, now, count, now, now)
            bridge.on_margins(now, True, friction.slowdown, scene.version, now)
            bridge.command(NEEDLE, velocity, now, count, now, now)
        output = bridge.step(now, now, READY)
        filtered = output.filtered
        rig.apply(output.allocation.currents, at)
    return moments


def measure_accuracy(name: str, moments: int, horizon: float, seed: int) -> dict[str, Any]:
    """Return the errors of forecasts at random moments of one loop, in per cent of the thread's length.

    Args:
        name: of the setup.
        moments: how many forecasts.
        horizon: of each [s].
        seed: of the moments.
    """
    setup = read_setup(name)
    frames, made = run_loop(setup, MAX_DURATION), forecaster_of(setup)
    steps = round(horizon / made.step)
    chosen = np.random.default_rng(seed).integers(0, len(frames) - steps, moments)
    errors, needle, held = [], [], []
    for first in chosen:
        commands = np.array([each.command for each in frames[first : first + steps]])
        forecast = made.forecast(frames[first].start, commands, horizon)
        then = frames[first + len(forecast.filtered)]
        errors.append(float(np.linalg.norm(forecast.vertices[-1] - then.thread, axis=1).mean()))
        needle.append(float(np.linalg.norm(forecast.tails[-1] - then.tail)))
        held.append(float(np.linalg.norm(frames[first].thread - then.thread, axis=1).mean()))
    percent = 100.0 / setup.model.thread_length
    return {
        "setup": name,
        "forecasts": moments,
        "horizon_s": horizon,
        "frames": len(frames),
        "error_mean_percent": percent * float(np.mean(errors)),
        "error_p95_percent": percent * float(np.percentile(errors, 95.0)),
        "needle_error_mean_percent": percent * float(np.mean(needle)),
        "moved_mean_percent": percent * float(np.mean(held)),
    }
