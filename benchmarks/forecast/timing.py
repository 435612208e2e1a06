"""How long forecasts take: one on one core, a batch on all, beside stepping filter and predictor from Python."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from magnetosuture_thread import (
    Disc,
    ForecastStart,
    NeedlePose,
    NeedleSafetyFilter,
    Scene,
    Thread,
    ThreadForecaster,
    ThreadPredictor,
)
from magnetosuture_thread.model.thread import MATERIALS, Attachment

LENGTH, NEEDLE = 0.019, 0.007  # of thread and needle [m]
RATE, COARSE_RATE, HORIZON = 66.0, 33.0, 3.0  # Hz, Hz, s
SPEED = 0.002  # m/s
BATCH = 64
START = NeedlePose(0.0, np.array([0.004, -0.0002]), np.array([1.0, 0.0]))
COMMAND = np.array([0.0018, 0.0009])  # into the space between needle and a post, which the filter bends aside


def measure_times(repeats: int, workers: int | None = None) -> dict[str, Any]:
    """Return wall-clock times, and the processor time of all cores [ms], and what steps at half the rate change [%].

    Args:
        repeats: of each; the median and the minimum are given.
        workers: threads of a batch; None for all cores.
    """
    one, start = forecaster(81, 1)
    single = _times(lambda: one.forecast(start, COMMAND, HORIZON), repeats)
    by_hand = _times(lambda: _by_hand(one, start), max(3, repeats // 10))
    cores = workers or os.cpu_count() or 1
    many, start = forecaster(40, cores)
    angles = np.linspace(0.0, 2.0 * np.pi, BATCH, endpoint=False)
    commands = SPEED * np.column_stack([np.cos(angles), np.sin(angles)])
    batch = _times(lambda: many.forecasts(start, commands, HORIZON), max(3, repeats // 5))
    coarse_one, coarse_many = forecaster(81, 1, COARSE_RATE)[0], forecaster(40, cores, COARSE_RATE)[0]
    coarse_single = _times(lambda: coarse_one.forecast(one.straight(START), COMMAND, HORIZON), repeats)
    coarse_batch = _times(lambda: coarse_many.forecasts(start, commands, HORIZON), max(3, repeats // 5))
    pairs = zip(many.forecasts(start, commands), coarse_many.forecasts(start, commands), strict=True)
    apart = [np.linalg.norm(fine.vertices[-1] - coarse.vertices[-1], axis=1).mean() for fine, coarse in pairs]
    return {
        "single_ms": single,
        "by_hand_ms": by_hand,
        "batch_ms": batch,
        "coarse_single_ms": coarse_single,
        "coarse_batch_ms": coarse_batch,
        "coarse_apart_mean_percent": 100.0 * float(np.mean(apart)) / LENGTH,
        "coarse_apart_max_percent": 100.0 * float(np.max(apart)) / LENGTH,
        "batch_size": BATCH,
        "cores": cores,
        "steps": round(HORIZON * RATE),
    }


def forecaster(segments: int, workers: int, rate: float = RATE) -> tuple[ThreadForecaster, ForecastStart]:
    """Return a forecaster in a dish with three posts, one of which the thread is drawn against, and a start."""
    centres = {"ahead": (0.0135, 0.0035), "beside": (-0.003, 0.0024), "behind": (-0.009, -0.0023)}
    scene = Scene.create(dish_diameter=0.05, shapes={name: Disc(centre, 0.0015) for name, centre in centres.items()})
    safety = NeedleSafetyFilter(scene, needle_length=NEEDLE, max_speed=0.01)
    thread = Thread.of(MATERIALS["polyamide_7_0"], length=LENGTH, segments=segments, attachment=Attachment.PINNED)
    made = ThreadForecaster(thread, scene, safety, step=1.0 / rate, max_step=1.001 / rate, workers=workers)
    made.warm_up()
    return made, made.straight(START)


def _by_hand(made: ThreadForecaster, start: ForecastStart) -> None:
    predictor, pose = ThreadPredictor(made.thread, made.scene), start.pose
    predictor.start_at(pose, start.vertices)
    safety, kinematics = made.safety, made.safety.kinematics
    for _ in range(round(HORIZON * RATE)):
        velocity = safety.filter(COMMAND, pose.tail, pose.heading).filtered
        moved = kinematics.moved(pose.tail, pose.heading, *kinematics.body_velocity(pose.heading, velocity), made.step)
        pose = NeedlePose(pose.stamp + made.step, *moved)
        prediction = predictor.step(pose)
        assert prediction.margins
        assert prediction.forces


def _times(work: Any, repeats: int) -> dict[str, float]:
    work()
    took, used = [], []
    for _ in range(repeats):
        began, busy = time.perf_counter(), time.process_time()
        work()
        took.append(1e3 * (time.perf_counter() - began))
        used.append(1e3 * (time.process_time() - busy))
    return {"median": float(np.median(took)), "minimum": min(took), "processor": float(np.median(used))}
