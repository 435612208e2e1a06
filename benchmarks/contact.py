"""Hold the thread in contact against the simulated rig: a recorded steering through the hernia, forces and depths.

The thread model first steers its needle, a point, as `magnetosuture reproduce hernia` does. Then the rig's rod, of
springs and with many more segments, is driven along the same way, and the model, with several n, is compared with it.
The same with friction, of the rig's own code and the model's; then the pull on the needle where closed loops move it;
friction alone: capstans of flexible and of stiff threads. Last, random motions in which the thread may
not pass through itself.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.closed_loop import closed_loop_table, measure_closed_loop
from benchmarks.friction import friction_tables, measure_friction
from benchmarks.report import figures_table
from benchmarks.self_contact import measure_self_contact, self_contact_table
from magnetosuture_thread import NeedlePose, ThreadPredictor, Workspace
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.commands.command import make_log
from magnetosuture_thread.evaluation.hernia import (
    paper_model,
    point_filter,
    read_steering,
    replay_steering,
    start_centreline,
)
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, ThreadProperties
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.thread.rod import RodFormulation

STEERING = Path("examples/hernia_steering")
TRUE_SEGMENTS = 240
MAX_DEPTH = 5e-6  # m, of any point of a chord
SAMPLES = 21  # of a chord, for its depth
CROWDED = 10  # pushed nodes, from which on a step counts as one of many contacts
FRICTION = 0.2  # of the rig's thread on everything, and of the model's scene


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--bag", type=Path, default=STEERING, metavar="BAG", help="steering to repeat (default: the example)")
    option("--motions", type=int, default=1000, metavar="N", help="random motions of a thread that touches itself")
    option("--segments", type=int, nargs="+", default=[40, 60, 80], metavar="N", help="of the model")


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures, and whether no chord is too deep, all steps converged and nothing passed through."""
    log = make_log(console)
    setup = read_setup("hernia_ring")
    log("the thread model steers its needle")
    needle = point_filter(setup.scene, setup.coils.keep_out, setup.coils.approach_rate)
    steered = replay_steering(paper_model(setup), start_centreline(setup), read_steering(Bag(options.bag)), needle)
    positions = np.array([instant.prediction.positions[:2] for instant in steered.instants])
    poses = [
        NeedlePose(instant.time, tail, (tail - first) / np.linalg.norm(tail - first))
        for instant, (tail, first) in zip(steered.instants, positions, strict=True)
    ]
    log(f"the rig's rod of {TRUE_SEGMENTS} segments follows the same way")
    truth, pulls = _simulate(setup, poses)
    rows = [_compared(setup, poses, truth, pulls, segments) for segments in options.segments]
    log(f"the same with friction, {FRICTION:g}")
    rough = _with_friction(setup, FRICTION)
    truth, pulls = _simulate(rough, poses)
    rows += [_compared(rough, poses, truth, pulls, segments) for segments in options.segments]
    title = f"hernia_ring, simulated, {poses[-1].stamp:.0f} s; errors in % of the length, mean (maximum)"
    columns = {
        "n": "{segments}",
        "friction": "{friction:g}",
        "error": "{error_mean_percent:.3f} ({error_max_percent:.2f})",
        "deepest [m]": "{deepest_m:.1e}",
        "pull on the needle [% of its peak, RMS]": "{pull_error_percent:.1f}",
        "not converged": "{not_converged}",
        "step [µs]: free": "{median_step_us[0]:.0f}",
        f"1 to {CROWDED - 1} nodes pushed": "{median_step_us[1]:.0f}",
        f"{CROWDED} or more": "{median_step_us[2]:.0f}",
    }
    console.print(figures_table(title, rows, columns))
    log("the loop closed: the needle moves by the coils, and the poses are noisy")
    loops = measure_closed_loop()
    console.print(closed_loop_table(loops))
    log("friction by itself")
    friction = measure_friction()
    console.print(*friction_tables(friction))
    log(f"a thread that touches itself: {options.motions} random motions")
    selves = measure_self_contact(options.motions)
    console.print(self_contact_table(selves))
    passed = all(row["deepest_m"] <= MAX_DEPTH and row["not_converged"] == 0 for row in rows)
    passed = passed and selves["model"]["crossed"] == selves["rig"]["crossed"] == 0
    return {"cases": rows, "closed_loop": loops, "friction": friction, "self_contact": selves}, passed


def _with_friction(setup: Setup, friction: float) -> Setup:
    """Return a setup whose rig and scene have friction."""
    shapes = tuple(replace(shape, friction=friction) for shape in setup.scene.shapes)
    scene = replace(setup.scene, dish=replace(setup.scene.dish, wall_friction=friction), shapes=shapes)
    return replace(setup, rig=replace(setup.rig, thread_friction=friction)).with_scene(scene)


def _simulate(setup: Setup, poses: list[NeedlePose]) -> tuple[list[Points], Points]:
    """Return the rod's nodes at each pose, and its pull on the needle, shape (T, 2) [N]."""
    rig, angles = setup.rig, np.unwrap([float(np.arctan2(pose.heading[1], pose.heading[0])) for pose in poses])
    thread = ThreadProperties(
        length=rig.thread_length,
        segments=TRUE_SEGMENTS,
        bending_stiffness=rig.thread_bending_stiffness,
        stretching_stiffness=rig.thread_stretching_stiffness,
        drag_across=rig.thread_drag_across,
        drag_along=rig.thread_drag_along,
        attachment=NeedleJoint.PINNED,
        diameter=rig.thread_diameter,
    )
    body, surface = NeedleBody(2e-4, 5e-5, 0.0, 0.0, 1.0), rig.surface(setup.scene)
    start = start_centreline(setup)
    rod = RigDynamics(body, thread, surface, None, poses[0].tail, float(angles[0]), start, largest_step=5e-3)
    nodes, pulls = [rod.thread], [rod.thread_pull]
    for before, pose, angle in zip(poses, poses[1:], angles[1:], strict=False):
        rod.drive(pose.tail, float(angle), pose.stamp - before.stamp)
        nodes.append(rod.thread)
        pulls.append(rod.thread_pull)
    return nodes, np.array(pulls)


def _compared(
    setup: Setup, poses: list[NeedlePose], truth: list[Points], pulls: Points, segments: int
) -> dict[str, Any]:
    """Return the figures of the model with n segments."""
    settings, scene = setup.model, setup.scene
    predictor = ThreadPredictor.create(
        settings.material,
        length=settings.thread_length,
        segments=segments,
        viscosity=settings.viscosity,
        scene=scene,
    )
    predictor.warm_up()
    assert isinstance(predictor.formulation, RodFormulation)
    near = Workspace(scene.obstacles, 3e-3, wall_radius=scene.dish.radius)
    predictor.start(poses[0], truth[0])
    errors, steps, pushed, found, deepest, unsolved = [], [], [], [], -np.inf, 0
    at = np.linspace(0.0, TRUE_SEGMENTS, segments + 1)
    before = np.minimum(at.astype(int), TRUE_SEGMENTS - 1)
    part, along = (at - before)[:, None], np.linspace(0.0, 1.0, SAMPLES)[:, None]
    for pose, nodes in zip(poses[1:], truth[1:], strict=True):
        began = time.process_time()
        prediction = predictor.step(pose)
        steps.append(time.process_time() - began)
        pushed.append(np.count_nonzero(predictor.formulation.nodes_in_contact))
        unsolved += not prediction.converged
        x, forces = prediction.positions, prediction.forces
        assert forces is not None
        found.append(forces.needle_force)
        true = (1.0 - part) * nodes[before] + part * nodes[before + 1]
        errors.append(float(np.linalg.norm(x - true, axis=1).mean()) / settings.thread_length)
        points = ((1.0 - along) * x[:-1, None] + along * x[1:, None]).reshape(-1, 2)
        gap = near.near(points).distance.min(initial=np.inf) - 0.5 * predictor.thread.diameter
        deepest = max(deepest, -float(gap))
    times, count = 1e6 * np.array(steps), np.array(pushed)
    kinds = (count == 0, (count > 0) & (count < CROWDED), count >= CROWDED)
    off, peak = np.linalg.norm(np.array(found) - pulls[1:], axis=1), float(np.linalg.norm(pulls, axis=1).max())
    return {
        "segments": segments,
        "friction": scene.dish.wall_friction,
        "error_mean_percent": 100.0 * float(np.mean(errors)),
        "error_max_percent": 100.0 * float(np.max(errors)),
        "deepest_m": deepest,
        "pull_error_percent": 100.0 * float(np.sqrt(np.mean(off**2))) / peak,
        "not_converged": unsolved,
        "median_step_us": [float(np.median(times[kind])) if kind.any() else float("nan") for kind in kinds],
    }
