"""Slow parameters that the estimator learns on line, against the rod that is the truth."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.estimator.camera import CameraModel
from benchmarks.estimator.cases import DURATION, RATE, SPEED
from benchmarks.estimator.truth import model_thread, simulate, wander
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.model.estimator import EstimatorOptions, ThreadEstimator
from magnetosuture_thread.model.estimator.parameter_kinds import KINDS
from magnetosuture_thread.model.predictor import ThreadPredictor

THREADS = (("silk_6_0", "pinned"), ("polyamide_7_0", "clamped"))
FLOW = (-6e-4, 8e-4)  # m/s


@dataclass(frozen=True)
class SlowCase:
    """What is learned, and from which wrong beginning.

    Attributes:
        learned: the parameters, see `EstimatorOptions`.
        stiffness: factor on the bending stiffness of the true thread.
        flow: true velocity of the liquid [m/s].
        told: what the model is told wrongly, by parameter: a factor, or the value of one that may be 0.
    """

    learned: tuple[str, ...]
    stiffness: float = 1.0
    flow: tuple[float, float] = (0.0, 0.0)
    told: dict[str, float] = field(default_factory=dict)


SLOW_CASES = {
    "stiffness x 5": SlowCase(("stiffness_over_drag",), stiffness=5.0),
    "stiffness / 5": SlowCase(("stiffness_over_drag",), stiffness=0.2),
    "anisotropy x 1.5": SlowCase(("drag_anisotropy",), told={"drag_anisotropy": 1.5}),
    "anisotropy / 1.5": SlowCase(("drag_anisotropy",), told={"drag_anisotropy": 1.0 / 1.5}),
    "rest curvature": SlowCase(("rest_curvature",), told={"rest_curvature": 50.0}),
    "flow": SlowCase(("flow",), flow=FLOW),
    "stiffness x 5, flow": SlowCase(("stiffness_over_drag", "flow"), stiffness=5.0, flow=FLOW),
    "stiffness / 5, anisotropy": SlowCase(
        ("stiffness_over_drag", "drag_anisotropy"), stiffness=0.2, told={"drag_anisotropy": 1.5}
    ),
}


def measure_slow(count: int, seed: int, progress: Callable[[], None]) -> list[dict[str, Any]]:
    """Return, of each case, material and parameter, errors of x and the share of 95 % intervals that hold the truth."""
    found = []
    for name, case in SLOW_CASES.items():
        for material, attachment in THREADS:
            errors: dict[str, list[tuple[float, float, bool]]] = {}
            spent = []
            for number in range(seed, seed + count):
                progress()
                tails, headings = wander(number, DURATION, RATE, SPEED)
                told = model_thread(material, 25, attachment)
                run = simulate(told, tails, headings, RATE, stiffness=case.stiffness, flow=case.flow)
                medium, stiffness = replace(told.medium, flow=case.flow), case.stiffness * told.bending_stiffness
                real = replace(told, bending_stiffness=stiffness, medium=medium)
                thread = run.thread
                for parameter, value in case.told.items():
                    kind = KINDS[parameter][0]
                    thread = kind.write(thread, value * kind.read(thread) if kind.logarithmic else value)
                predictor = ThreadPredictor(thread, Workspace((), 5e-3, wall_radius=run.wall_radius))
                estimator = ThreadEstimator(predictor, EstimatorOptions(slow_parameters=case.learned))
                rng, camera = np.random.default_rng(number), CameraModel()
                estimate = estimator.start_observed(run.poses[0], camera.observe(run.threads[0], 0.0, rng))
                for pose, nodes in zip(run.poses[1:], run.threads[1:], strict=True):
                    observation = camera.observe(nodes, pose.stamp, rng)
                    began = time.perf_counter()
                    estimate = estimator.step(pose, observation)
                    spent.append(time.perf_counter() - began)
                kinds = {kind.name: kind for each in case.learned for kind in KINDS[each]}
                for each in estimate.slow_parameters:
                    kind, true = kinds[each.name], kinds[each.name].read(real)
                    off = abs(kind.to_x(each.value) - kind.to_x(true))
                    half = 0.5 * (kind.to_x(each.high) - kind.to_x(each.low))
                    errors.setdefault(each.name, []).append((off, half, each.low <= true <= each.high))
            for parameter, rows in errors.items():
                off, half, inside = np.array(rows).T
                found.append(
                    {
                        "case": name,
                        "material": material,
                        "parameter": parameter,
                        "error_mean": float(off.mean()),
                        "error_max": float(off.max()),
                        "half_interval_mean": float(half.mean()),
                        "coverage": float(inside.mean()),
                        "step_s": float(np.median(spent)),
                    }
                )
    return found
