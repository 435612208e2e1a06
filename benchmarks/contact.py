"""Hold the thread in contact against the simulated rig: a recorded steering through the hernia, forces and depths.

The thread model first steers its needle, a point, as `magnetosuture reproduce hernia` does. Then the rig's rod, of
springs and with many more segments, is driven along the same way, and the model, with several n, is compared with it.
The same with friction, of the rig's own code and the model's; then closed loops of setups' path followers, in which the
needle moves by the coils' currents and the model follows noisy poses; friction alone: capstans.
Last, random motions in which the thread may not pass through itself.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop import LoopRecord, PathControl
from benchmarks.friction import measure_friction
from benchmarks.report import figures_table
from benchmarks.self_contact import measure_self_contact, self_contact_table
from magnetosuture_thread import NeedlePose, ThreadPredictor, Workspace
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.evaluation import hernia
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.rig.closed_loop import START, ClosedLoop
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, ThreadProperties
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.thread.rod import RodFormulation

TRUE_SEGMENTS = 240
MAX_DEPTH = 5e-6  # m, of any point of a chord
CROWDED = 10  # pushed nodes, from which on a step counts as one of many contacts
FRICTION = 0.2  # of the rig's thread on everything, and of the model's scene
LOOPS = (("petri_35mm_polyamide", 25), ("petri_35mm_polyamide_post", 25), *(("hernia_ring", n) for n in (40, 60, 80)))
SETTLING, MAX_DURATION = 0.5, 90.0  # s, of a loop: until the model has velocities of its own, and in all


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option, steering = parser.add_argument, Path("examples/hernia_steering")
    option("--bag", type=Path, default=steering, metavar="BAG", help="steering to repeat (default: the example)")
    option("--motions", type=int, default=1000, metavar="N", help="random motions of a thread that touches itself")
    option("--segments", type=int, nargs="+", default=[40, 60, 80], metavar="N", help="of the model")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures, and whether no chord is too deep, all steps converged and nothing passed through."""
    log = terminal.log
    smooth = read_setup("hernia_ring")
    log("the thread model steers its needle")
    needle = hernia.point_filter(smooth.scene, smooth.coils.keep_out, smooth.coils.approach_rate)
    start, steering = hernia.start_centreline(smooth), hernia.read_steering(Bag(options.bag))
    poses = []
    for instant in hernia.replay_steering(hernia.paper_model(smooth), start, steering, needle).instants:
        tail, first = instant.prediction.positions[:2]
        poses.append(NeedlePose(instant.time, tail, (tail - first) / np.linalg.norm(tail - first)))
    scene = smooth.scene
    shapes = tuple(replace(shape, friction=FRICTION) for shape in scene.shapes)
    scene = replace(scene, dish=replace(scene.dish, wall_friction=FRICTION), shapes=shapes)
    rough = replace(smooth, rig=replace(smooth.rig, thread_friction=FRICTION)).with_scene(scene)
    rows = []
    for setup, words in ((smooth, "without"), (rough, "with")):
        log(f"the rig's rod of {TRUE_SEGMENTS} segments follows the same way, {words} friction")
        truth, pulls = _simulate(setup, poses)
        rows += [_compared(setup, poses, truth, pulls, segments) for segments in options.segments]
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
    terminal.print(figures_table(title, rows, columns))
    log("the loop closed: the needle moves by the coils, and the poses are noisy")
    loops = [_closed_loop(read_setup(name), segments) for name, segments in LOOPS]
    title = f"closed loop, rig of {TRUE_SEGMENTS} segments, simulated; pull in % of its peak, nodes in % of the length"
    columns = {
        "setup": "{setup}",
        "n": "{segments}",
        "pull, RMS": "{pull_error_percent:.1f}",
        "prediction, mean (maximum)": "{prediction[mean_percent]:.3f} ({prediction[max_percent]:.2f})",
        "estimate": "{estimate[mean_percent]:.3f} ({estimate[max_percent]:.2f})",
    }
    terminal.print(figures_table(title, loops, columns))
    log("friction by itself")
    friction = measure_friction()
    columns = {"mu": "{friction:g}", "turns": "{turns:g}", "off [%]": "{error_percent:+.2f}"}
    terminal.print(figures_table("capstans: T2 / T1 over exp(mu theta), less 1", friction, columns))
    log(f"a thread that touches itself: {options.motions} random motions")
    selves = measure_self_contact(options.motions)
    terminal.print(self_contact_table(selves))
    passed = all(row["deepest_m"] <= MAX_DEPTH and row["not_converged"] == 0 for row in rows)
    passed = passed and selves["model"]["crossed"] == selves["rig"]["crossed"] == 0
    return {"cases": rows, "closed_loop": loops, "friction": friction, "self_contact": selves}, passed


def _simulate(setup: Setup, poses: list[NeedlePose]) -> tuple[list[Points], Points]:
    """Return the rod's nodes at each pose, and its pull on the needle, shape (T, 2) [N]."""
    rig, angles = setup.rig, np.unwrap([float(np.arctan2(pose.heading[1], pose.heading[0])) for pose in poses])
    stiffness = rig.thread_bending_stiffness, rig.thread_stretching_stiffness
    drag = rig.thread_drag_across, rig.thread_drag_along
    joint = NeedleJoint.PINNED
    thread = ThreadProperties(rig.thread_length, TRUE_SEGMENTS, *stiffness, *drag, joint, diameter=rig.thread_diameter)
    body, surface = NeedleBody(2e-4, 5e-5, 0.0, 0.0, 1.0), rig.surface(setup.scene)
    start = hernia.start_centreline(setup)
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
    size: dict[str, Any] = {"length": settings.thread_length, "segments": segments, "viscosity": settings.viscosity}
    predictor = ThreadPredictor.create(settings.material, scene=scene, **size)
    predictor.warm_up()
    assert isinstance(predictor.formulation, RodFormulation)
    near = Workspace(scene.obstacles, 3e-3, wall_radius=scene.dish.radius)
    predictor.start(poses[0], truth[0])
    errors, times, pushed, forces, deepest, unsolved = [], [], [], [], -np.inf, 0
    at = np.linspace(0.0, TRUE_SEGMENTS, segments + 1)
    before = np.minimum(at.astype(int), TRUE_SEGMENTS - 1)
    part, along = (at - before)[:, None], np.linspace(0.0, 1.0, 21)[:, None]  # of a chord, for its depth
    for pose, nodes in zip(poses[1:], truth[1:], strict=True):
        began = time.process_time()
        prediction = predictor.step(pose)
        times.append(1e6 * (time.process_time() - began))
        pushed.append(np.count_nonzero(predictor.formulation.nodes_in_contact))
        unsolved += not prediction.converged
        assert prediction.forces is not None
        forces.append(prediction.forces.needle_force)
        x, true = prediction.positions, (1.0 - part) * nodes[before] + part * nodes[before + 1]
        errors.append(100.0 * float(np.linalg.norm(x - true, axis=1).mean()) / settings.thread_length)
        points = ((1.0 - along) * x[:-1, None] + along * x[1:, None]).reshape(-1, 2)
        gap = near.near(points).distance.min(initial=np.inf) - 0.5 * predictor.thread.diameter
        deepest = max(deepest, -float(gap))
    kinds = np.digitize(pushed, (1, CROWDED))
    return {
        "segments": segments,
        "friction": scene.dish.wall_friction,
        "error_mean_percent": float(np.mean(errors)),
        "error_max_percent": max(errors),
        "deepest_m": deepest,
        "pull_error_percent": _pull_error(np.array(forces), pulls[1:]),
        "not_converged": unsolved,
        "median_step_us": [float(np.median(np.array(times)[kinds == k])) if k in kinds else np.nan for k in range(3)],
    }


def _pull_error(pulls: Points, true: Points) -> float:
    """Return by how much pulls on the needle are off, shapes (T, 2) [N]: RMS in % of the peak."""
    error, peak = np.sqrt(np.mean(np.sum((pulls - true) ** 2, axis=1))), np.linalg.norm(true, axis=1).max()
    return 100.0 * float(error / peak)


def _closed_loop(setup: Setup, segments: int) -> dict[str, Any]:
    """Return the figures of a path follower's loop: pull, and nodes of prediction and estimate, against the rig's."""
    rig, model = replace(setup.rig, thread_segments=TRUE_SEGMENTS), replace(setup.model, segments=segments)
    setup = replace(setup, rig=rig, model=model).with_scene(setup.scene)
    control, record = PathControl(setup), LoopRecord()
    loop = ClosedLoop(setup, Rig(setup.rig, setup.scene), control, recorder=record)
    while loop.now < START + MAX_DURATION and not control.done:
        loop.step()
    begin = record.frames[0][1].tail
    moved = dropwhile(lambda frame: (frame[1].tail == begin).all(), record.frames)
    true = {now: frame for now, frame in moved}
    pulls = list[tuple[float, NDArray[np.float64], NDArray[np.float64]]]()
    errors: dict[str, list[float]] = {"prediction": [], "estimate": []}
    for measured, result, _ in record.measured:
        if (frame := true.get(measured.stamp)) is None:
            continue
        if result.prediction is not None and result.prediction.forces is not None:
            pulls.append((measured.stamp, result.prediction.forces.needle_force, frame.pull))
        for name, thread in (("prediction", result.prediction), ("estimate", result.estimate)):
            if thread is not None:
                at_nodes = np.linspace(0.0, float(arc_lengths(frame.thread)[-1]), len(thread.positions))
                off = np.linalg.norm(thread.positions - points_at(frame.thread, at_nodes), axis=1)
                errors[name].append(100.0 * float(off.mean()) / model.thread_length)
    stamps, forces, expected = map(np.array, zip(*pulls, strict=True))
    settled = stamps >= stamps[0] + SETTLING
    nodes = {name: {"mean_percent": float(np.mean(off)), "max_percent": max(off)} for name, off in errors.items()}
    pull = _pull_error(forces[settled], expected[settled])
    return {"setup": setup.name, "segments": segments, "pull_error_percent": pull, **nodes}
