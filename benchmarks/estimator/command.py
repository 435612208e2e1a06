"""Measure the thread estimator against ground truth, beside the prediction alone.

The truth is the rod of the simulated rig behind a needle that wanders through the dish; the camera gives points of it,
with correlated noise, gaps and outliers. Errors are distances of nodes from the truth, in % of the thread's length.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.estimator.truth import LENGTH, RATE, WALL_RADIUS, CameraModel, Run, simulate
from magnetosuture_thread.bags.reading import pose_deviation
from magnetosuture_thread.commands.command import make_log, progress
from magnetosuture_thread.estimator import EstimatorSession, ThreadEstimate, ThreadEstimator
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, Workspace
from magnetosuture_thread.geometry.polyline import Points, points_at
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.rig.camera import CameraScene, DishCamera
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import TrackerSession

DURATION = 25.0  # s
POST_RADIUS = 1.2e-3  # m
FOUND_TIME = 0.5  # s; in which an unknown contact is to be found
CONSISTENCY_WINDOW = 5.0  # s
THREADS = (("polyamide_7_0", "pinned"), ("polyamide_7_0", "clamped"), ("silk_6_0", "pinned"))


@dataclass(frozen=True)
class Case:
    """What the model is told, what is true, and what the camera gives.

    Attributes:
        name: of the case.
        limits: of the mean and the greatest error, in % of the length.
        truth: what of thread and liquid is not as told; see `simulate`.
        camera: what is seen.
        post: whether a post stands in the thread's way; `known` or `unknown` to the model, or empty.
        every: frames a pose, 1 for each.
        lost: part of the frames that never come.
        latency: of the camera, in frames.
        start: `measured`, `straight`, or `bent`: wrong by a fifth of the length.
        second: whether another thread lies in the dish.
        better: whether the estimate must be better than the prediction alone, too.
    """

    name: str
    limits: tuple[float, float] = (0.3, 1.5)
    truth: dict[str, Any] = field(default_factory=dict)
    camera: CameraModel = field(default_factory=CameraModel)
    post: str = ""
    every: int = 1
    lost: float = 0.0
    latency: int = 0
    start: str = "measured"
    second: bool = False
    better: bool = False


def _hidden(first: float, last: float) -> CameraModel:
    return CameraModel(hidden=(first * LENGTH, last * LENGTH))


STIFFER, SOFTER = {"stiffness": 5.0}, {"stiffness": 0.2}
CASES = {
    case.name: case
    for case in (
        Case("right, free", (0.03, 0.15), better=True),
        Case("right, post", (0.03, 0.15), post="known", better=True),
        Case("stiffness x 5", truth=STIFFER),
        Case("stiffness / 5", truth=SOFTER),
        Case("viscosity x 2", truth={"viscosity": 2.0}),
        Case("viscosity / 2", truth={"viscosity": 0.5}),
        Case("flow 1 mm/s", truth={"flow": (1e-3, 0.0)}),
        Case("camera scale + 1 %", camera=CameraModel(scale=1.01)),
        Case("starts straight", start="straight"),
        Case("starts wrong by 20 %", start="bent"),
        Case("first half hidden", camera=_hidden(0.0, 0.5)),
        Case("middle hidden", camera=_hidden(0.25, 0.75)),
        Case("last half hidden", camera=_hidden(0.5, 1.0)),
        Case("middle, stiffness x 5", (2.0, 6.0), STIFFER, _hidden(0.25, 0.75)),
        Case("last half, stiffness x 5", (2.0, 6.0), STIFFER, _hidden(0.5, 1.0)),
        Case("last half, stiffness / 5", (2.0, 6.0), SOFTER, _hidden(0.5, 1.0)),
        Case("5 frames a second", every=6),
        Case("30 % lost", lost=0.3),
        Case("latency 0.2 s", latency=6),
        Case("all three", every=6, lost=0.3, latency=6),
        Case("10 % outliers", camera=CameraModel(outliers=0.1)),
        Case("second thread", second=True),
        Case("unknown post", (0.5, 2.0), post="unknown"),
    )
}


@cache
def free_run(material: str, attachment: str, seed: int) -> Run:
    """Return a run in which nothing stands in the way."""
    return simulate(material, attachment, seed, DURATION)


def run_of(case: Case, material: str, attachment: str, seed: int) -> Run | None:
    """Return what happens in a case; None where the seed has no post that could stand in the way."""
    if not case.truth and not case.post:
        return free_run(material, attachment, seed)
    post = _post_in_the_way(material, attachment, seed) if case.post else None
    if case.post and post is None:
        return None
    return simulate(material, attachment, seed, DURATION, () if post is None else (post,), **case.truth)


@cache
def _post_in_the_way(material: str, attachment: str, seed: int) -> Disc | None:
    """Return a post that the thread of a free run would sweep over, not at once, and the needle not; None for none."""
    run, rng = free_run(material, attachment, seed), np.random.default_rng(seed)
    tails, third = np.array([pose.tail for pose in run.poses]), len(run.threads) // 3
    for _ in range(2000):
        centre = rng.uniform(-0.011, 0.011, 2)
        gap = np.array([np.min(np.linalg.norm(thread - centre, axis=1)) for thread in run.threads[::10]]) - POST_RADIUS
        apart = float(np.min(np.linalg.norm(tails - centre, axis=1))) - POST_RADIUS
        if gap[: third // 10].min() > 3e-4 and gap[third // 10 : third // 5].min() < -2e-4 and apart > 1e-4:
            return Disc((float(centre[0]), float(centre[1])), POST_RADIUS)
    return None


def contact_frame(run: Run) -> int:
    """Return the first frame in which the thread touches a post; the number of frames if it never does."""
    for index, thread in enumerate(run.threads):
        for post in run.posts:
            gap = float(np.min(np.linalg.norm(thread - np.array(post.centre), axis=1))) - post.radius
            if gap < 0.5 * run.thread.diameter + 3e-6:
                return index
    return len(run.threads)


def estimator_of(run: Run, case: Case, segments: int = 25) -> ThreadEstimator:
    """Return an estimator that knows of a run what the case lets it."""
    workspace = Workspace(() if case.post == "unknown" else run.posts, 5e-3, wall_radius=run.wall_radius)
    estimator = ThreadEstimator(ThreadPredictor(replace(run.thread, segments=segments), workspace))
    estimator.warm_up()
    return estimator


def observations(case: Case, run: Run, seed: int) -> list[ThreadObservation | None]:
    """Return what each frame shows; None for a frame that never comes."""
    rng, seen = np.random.default_rng(seed), []
    # Another thread lies across the dish, waving slowly.
    angle = float(np.random.default_rng(seed).uniform(0.0, math.pi))
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    along = np.linspace(-0.009, 0.009, 60)
    for index, (pose, nodes) in enumerate(zip(run.poses, run.threads, strict=True)):
        other = np.column_stack([along, 2e-3 * np.sin(400.0 * along + 0.3 * pose.stamp)]) @ turn
        observation = case.camera.observe(nodes, pose.stamp, rng, (other,) if case.second else ())
        lost = rng.random() < case.lost and index > 0
        seen.append(observation if index % case.every == 0 and not lost else None)
    return seen


def play(
    case: Case, run: Run, seen: Sequence[ThreadObservation | None], estimator: ThreadEstimator, first: Points
) -> tuple[list[ThreadEstimate], list[ThreadEstimate]]:
    """Return estimates at each pose but the first, as known when it comes, and at the stamps of the observations."""
    session, current, measured = EstimatorSession(estimator), list[ThreadEstimate](), list[ThreadEstimate]()
    poses = [replace(pose, tail=pose.tail * case.camera.scale) for pose in run.poses]
    for index, pose in enumerate(poses):
        late = seen[index - case.latency] if index >= case.latency else None
        observed = late if case.start == "measured" or index > 0 else None
        if index == 0 and case.start == "bent":  # off by a fifth of the length at the free end
            aside = np.array([first[-1, 1] - first[0, 1], first[0, 0] - first[-1, 0]])
            aside *= 0.2 * LENGTH / max(float(np.linalg.norm(aside)), 1e-9)
            session.start(pose, first + np.linspace(0.0, 1.0, len(first))[:, None] * aside)
            continue
        if case.latency == 0 and observed is not None:
            session.on_observation(pose.stamp, observed)
        result = session.on_pose(pose)
        if case.latency and observed is not None:
            result = session.on_observation(poses[index - case.latency].stamp, observed)
        if result.problem is not None:
            raise result.problem
        if index > 0:
            assert result.estimate is not None
            current.append(result.estimate)
            if result.measured is not None and observed is not None:
                measured.append(result.measured)
    return current, measured


def measure_case(case: Case, count: int, seed: int, segments: int, advance: Callable[[], None]) -> dict[str, Any]:
    """Measure one case over all threads and a number of seeds.

    Returns:
        `estimate` and `prediction` (of the model alone, from the true first shape): errors after the first second, of
        a hidden part while it is, of an unknown post from the contact on; `consistent`: part of the windows of 5 s in
        which the mean normalised innovation squared is within its 95 % band; `innovation`: its mean; `worse`: runs
        whose estimate is worse than the prediction alone; `found`: contacts nobody told of that were found within
        0.5 s, of so many `runs`; `false_alarms`: runs with a report before any contact; `met`: whether the limits hold.
    """
    errors, alone, innovations = [np.empty(0)], [np.empty(0)], [np.ones(1)]
    inside = list[bool]()
    worse = runs = found = alarms = 0
    for material, attachment in THREADS:
        for number in range(seed, seed + count):
            advance()
            run = run_of(case, material, attachment, number)
            if run is None:
                continue
            at = np.linspace(0.0, LENGTH, segments + 1)
            truth = np.array([points_at(thread, at) for thread in run.threads])
            estimator, contact = estimator_of(run, case, segments), contact_frame(run) if case.post else len(truth)
            estimates, measured = play(case, run, observations(case, run, number), estimator, truth[0])
            estimator.reset()  # what it learned of the thread too
            estimator.predictor.start_at(run.poses[0], truth[0])
            predicted = [estimator.predictor.step(pose).positions for pose in run.poses[1:]]
            frames, nodes = slice(int(RATE), None), slice(1, None)
            if case.camera.hidden[1] > 0.0:
                low, high = (round(bound / LENGTH * segments) for bound in case.camera.hidden)
                frames = slice(*(round(bound * RATE) - 1 for bound in case.camera.hidden_time))
                nodes = slice(max(low, 1), high + 1)
            elif case.post == "unknown":
                frames = slice(min(contact, len(truth) - 2), None)
            for shapes, into in (([each.positions for each in estimates], errors), (predicted, alone)):
                off = np.linalg.norm(np.array(shapes) - truth[1:], axis=2)[frames, nodes]
                into.append(100.0 / LENGTH * off.ravel())
            worse += bool(errors[-1].mean() > alone[-1].mean())
            runs += 1
            shown = [each for each in measured if each.innovations is not None]
            squares = [each.innovations.normalised_squared for each in shown if each.innovations is not None]
            stamps, squared = np.array([each.stamp for each in shown]), np.array(squares)
            innovations.append(squared[np.isfinite(squared)])
            for begin in np.arange(stamps[0], stamps[-1] - 0.99 * CONSISTENCY_WINDOW, CONSISTENCY_WINDOW):
                values = squared[(stamps >= begin) & (stamps < begin + CONSISTENCY_WINDOW)]
                values = values[np.isfinite(values)]
                if len(values):
                    inside.append(bool(abs(values.mean() - 1.0) <= 1.96 * np.sqrt(2.0 / len(values))))
            reports = [index + 1 for index, each in enumerate(estimates) if each.disturbances]
            found += case.post == "unknown" and any(0 <= k - contact <= FOUND_TIME * RATE for k in reports)
            alarms += any(index < contact for index in reports)
    estimate = errors_of(np.concatenate(errors))
    met = estimate["mean"] <= case.limits[0] and estimate["maximum"] <= case.limits[1]
    return {
        "name": case.name,
        "limits": case.limits,
        "estimate": estimate,
        "prediction": errors_of(np.concatenate(alone)),
        "consistent": float(np.mean(inside)) if inside else 0.0,
        "innovation": float(np.mean(np.concatenate(innovations))),
        "worse": worse,
        "runs": runs,
        "found": found,
        "false_alarms": alarms,
        "met": met and runs > 0 and not (case.better and worse) and (case.post != "unknown" or found >= 0.95 * runs),
    }


def errors_of(errors: NDArray[np.float64]) -> dict[str, float]:
    """Return mean and maximum of errors in % of the length."""
    return (
        {"mean": float(errors.mean()), "maximum": float(errors.max())} if errors.size else {"mean": 0.0, "maximum": 0.0}
    )


def measure_cost(segments: int, seed: int) -> dict[str, float]:
    """Return median processor times of a step with and without a measurement [s], and the number of points."""
    case, run = CASES["right, free"], free_run("silk_6_0", "pinned", seed)
    estimator, (first, *seen) = estimator_of(run, case, segments), observations(case, run, seed)
    assert first is not None
    figures = {"points": float(len(first.pieces[0].points))}
    for name, measured in (("estimate_s", True), ("prediction_s", False)):
        estimator.start_observed(run.poses[0], first)
        times = [time.process_time()]
        for pose, each in zip(run.poses[1:], seen, strict=True):
            estimator.step(pose, each if measured else None)
            times.append(time.process_time())
        figures[name] = float(np.median(np.diff(times)))
    return figures


def play_rendered(run: Run, case: Case, seed: int, frames: int) -> tuple[dict[int, ThreadEstimate], set[int]]:
    """Return the estimates by rendered frames and the tracker, and the frames in which the needle is not tracked.

    Posts are not drawn: they are of glass.
    """
    scene = CameraScene(dish_diameter=2.0 * WALL_RADIUS, thread_diameter=run.thread.diameter)
    camera = DishCamera(scene, DishView((322.0, 238.0), 8e-5), seed=seed)
    settings = VisionTrackerSettings(needle_length=0.007, needle_width=0.0004, thread_length=LENGTH)
    tracker, session = TrackerSession(settings, Scene()), EstimatorSession(estimator_of(run, case))
    estimates, lost = {}, set[int]()
    for index, (pose, thread) in enumerate(zip(run.poses[:frames], run.threads, strict=False)):
        heading = float(np.arctan2(pose.heading[1], pose.heading[0]))
        seen = tracker.on_image(pose.stamp, camera.render(pose.tail, heading, thread))
        if not seen.tracked:
            lost.add(index)
            continue
        session.on_observation(pose.stamp, seen.track.observation)
        deviation = pose_deviation(np.diag(seen.track.covariance))
        found = session.on_pose(NeedlePose(pose.stamp, seen.track.tail, seen.track.heading, deviation))
        if found.estimate is not None:
            estimates[index] = found.estimate
    return estimates, lost


def measure_rendered(count: int, seed: int) -> dict[str, Any]:
    """Return how many unknown contacts were found in time, and false reports, with a post and without."""
    errors, names = (
        list[Points](),
        ("runs", "found", "late", "untracked_at_contact", "early", "runs_without_post", "false_reports"),
    )
    figures: dict[str, Any] = dict.fromkeys(names, 0)
    for number in range(seed, seed + count):
        for material, attachment in THREADS:
            run = run_of(CASES["unknown post"], material, attachment, number)
            contact = contact_frame(run) if run is not None else 0
            if run is not None and contact < len(run.threads):
                until = contact + round(2.0 * RATE)
                estimates, lost = play_rendered(run, CASES["unknown post"], number, until)
                reports = [index for index, each in estimates.items() if each.disturbances]
                first = min((index for index in reports if index >= contact), default=len(run.threads))
                figures["runs"] += 1
                figures["early"] += any(index < contact for index in reports)
                figures["found"] += first <= contact + FOUND_TIME * RATE
                figures["late"] += contact + FOUND_TIME * RATE < first < len(run.threads)
                figures["untracked_at_contact"] += contact in lost
            run = free_run(material, attachment, number)
            estimates, _ = play_rendered(run, CASES["right, free"], number, len(run.threads))
            figures["runs_without_post"] += 1
            figures["false_reports"] += any(each.disturbances for each in estimates.values())
            at = np.linspace(0.0, LENGTH, run.thread.segments + 1)
            off = [each.positions - points_at(run.threads[k], at) for k, each in estimates.items() if k >= RATE]
            errors.append(100.0 / LENGTH * np.linalg.norm(off, axis=2).ravel())
    of_all = errors_of(np.concatenate(errors))
    return figures | {"estimate_mean": of_all["mean"], "estimate_maximum": of_all["maximum"]}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--count", type=int, default=2, metavar="N", help="runs of each case and thread (default: 2)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the first run (default: 1)")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), metavar="CASE", help="only these; default: all")
    parser.add_argument("--segments", type=int, default=25, metavar="N", help="of the model (default: 25)")
    parser.add_argument(
        "--rendered", type=int, default=0, metavar="N", help="also N seeds of unknown posts, by rendered frames"
    )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Measure the cases; return the figures, and whether all limits hold."""
    names, done, figures = options.cases or list(CASES), 0, []
    table = Table(title="mean, greatest error in % of the length", title_justify="left", title_style="bold")
    for name in ("case", "limit", "estimate", "prediction", "consistent", "found", "met"):
        table.add_column(name, justify="left" if name == "case" else "right", no_wrap=True)
    with progress(console, "estimator") as report:

        def advance() -> None:
            nonlocal done
            report(done / (len(names) * len(THREADS) * options.count))
            done += 1

        for name in names:
            each = measure_case(CASES[name], options.count, options.seed, options.segments, advance)
            figures.append(each)
            pairs = each["limits"], each["estimate"].values(), each["prediction"].values()
            found = f"{each['found']} of {each['runs']}" if name == "unknown post" else ""
            errors = ["{:.3f} {:6.2f}".format(*pair) for pair in pairs]
            table.add_row(name, *errors, f"{each['consistent']:.0%}", found, "yes" if each["met"] else "no")
        more: dict[str, Any] = {"cost": measure_cost(81, options.seed)}
        if options.rendered:
            more["rendered"] = measure_rendered(options.rendered, options.seed)
    console.print(table)
    log, cost = make_log(console), more["cost"]
    log(
        f"n = 81, {cost['points']:.0f} points: {1e6 * cost['estimate_s']:.0f} us a frame,"
        f" {1e6 * (cost['estimate_s'] - cost['prediction_s']):.0f} us more than without a measurement"
    )
    if options.rendered:
        log("rendered frames: " + ", ".join(f"{name} {value:.4g}" for name, value in more["rendered"].items()))
    return {"cases": figures, **more}, all(each["met"] for each in figures)
