"""Measure the thread estimator against ground truth, beside the prediction alone.

The truth is the rod of the simulated rig behind a needle that wanders through the dish; the camera gives points of it,
with correlated noise, gaps and outliers. Errors are distances of nodes from the truth, in % of the thread's length.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import figures_table
from magnetosuture_thread.bags.reading import pose_deviation
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.estimator.estimator import EstimatorSession, ThreadEstimate, ThreadEstimator
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, Workspace
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, lay_behind_needle, points_at
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.rig.camera import CameraScene, DishCamera
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import TrackerSession

LENGTH, WALL_RADIUS, POST_RADIUS = 0.019, 0.0175, 1.2e-3  # m; of thread, dish and post
SEGMENTS = 25  # of the model
RATE, DURATION = 30.0, 25.0  # frames a second, and s
SPACING, DEVIATION = 1.6e-4, 2e-5  # m; of points along the thread, two pixels, and across it, a quarter
HIDDEN_TIME = (10.0, 15.0)  # s; from when to when a part is covered
FOUND_TIME, CONSISTENCY_WINDOW = 0.5, 5.0  # s; in which an unknown contact is to be found
THREADS = (("polyamide_7_0", "pinned"), ("polyamide_7_0", "clamped"), ("silk_6_0", "pinned"))


@dataclass(frozen=True)
class Run:
    """What happened: the needle and the thread at each frame.

    Attributes:
        thread: as the model should know it.
        poses: of the needle.
        threads: nodes of the rod, shape (T, m, 2) [m].
        posts: in the dish.
        wall_radius: of the dish [m].
    """

    thread: Thread
    poses: tuple[NeedlePose, ...]
    threads: NDArray[np.float64]
    posts: tuple[Disc, ...]
    wall_radius: float


def wander(seed: int, duration: float) -> tuple[Points, NDArray[np.float64]]:
    """Return tails, shape (T, 2) [m], and headings, shape (T,), of a needle that wanders through the dish.

    Its turn rate is a sum of slow sines, and close to the wall it turns away from it.
    """
    rng = np.random.default_rng(seed)
    frequencies, phases = rng.uniform(0.02, 0.12, 4), rng.uniform(0.0, 2.0 * math.pi, 4)
    amplitudes, steps = rng.uniform(0.15, 0.45, 4), 20
    h = 1.0 / (RATE * steps)
    place, heading = rng.uniform(-0.004, 0.004, 2), float(rng.uniform(0.0, 2.0 * math.pi))
    tails, headings = [], []
    for k in range(int(duration * RATE * steps)):
        if k % steps == 0:
            tails.append(place.copy())
            headings.append(heading)
        ahead = place + 0.003 * np.array([math.cos(heading), math.sin(heading)])
        turn = float(amplitudes @ np.sin(2.0 * math.pi * frequencies * k * h + phases))
        excess = float(np.linalg.norm(ahead)) - 0.0075
        if excess > 0.0:
            away = math.atan2(-place[1], -place[0])
            turn += math.copysign(1.2, math.remainder(away - heading, 2.0 * math.pi)) * min(excess / 0.003, 1.0)
        heading += h * turn
        place = place + h * 1.5e-3 * np.array([math.cos(heading), math.sin(heading)])
    return np.array(tails), np.array(headings)


def simulate(
    material: str,
    attachment: str,
    seed: int,
    duration: float,
    posts: tuple[Disc, ...] = (),
    *,
    stiffness: float = 1.0,
    viscosity: float = 1.0,
    flow: tuple[float, float] = (0.0, 0.0),
) -> Run:
    """Drive the rod's needle through the dish.

    Args:
        material: of the thread, in glycerin.
        attachment: to the needle.
        seed: of its way.
        duration: [s]
        posts: what stands in the dish.
        stiffness: factor on the bending stiffness of the true thread.
        viscosity: factor on its drag.
        flow: velocity of the liquid; only without posts and wall, as the rod is simulated in the liquid's frame [m/s].
    """
    thread = Thread.of(MATERIALS[material], length=LENGTH, segments=SEGMENTS, attachment=Attachment(attachment))
    properties = ThreadProperties(
        length=LENGTH,
        segments=114,
        bending_stiffness=stiffness * thread.bending_stiffness,
        stretching_stiffness=2.0,  # N; the drag of the needle then stretches it by 1e-5
        drag_across=viscosity * thread.medium.drag_across,
        drag_along=viscosity * thread.medium.drag_along,
        attachment=NeedleJoint(attachment),
        diameter=thread.diameter,
    )
    (tails, headings), moving = wander(seed, duration), np.array(flow)
    wall = math.inf if moving.any() else WALL_RADIUS
    unit = np.column_stack([np.cos(headings), np.sin(headings)])
    path = lay_behind_needle(tails[0], unit[0], 1.05 * LENGTH, WALL_RADIUS - 0.5 * thread.diameter - 1e-4)
    needle, surface = NeedleBody(2e-3, 4e-4, 0.0, 0.0, 1.0), Surface(posts, wall_radius=wall)
    rig = RigDynamics(needle, properties, surface, None, tails[0], float(headings[0]), path, largest_step=5e-3)
    threads = [rig.thread]
    for index in range(1, len(tails)):
        drift = moving * (index / RATE)
        rig.drive(tails[index] - drift, float(headings[index]), 1.0 / RATE)
        threads.append(rig.thread + drift)
    poses = tuple(NeedlePose(k / RATE, tails[k], unit[k]) for k in range(len(tails)))
    return Run(thread, poses, np.array(threads), posts, wall)


@dataclass(frozen=True)
class Case:
    """What the model is told, what is true, and what the camera gives.

    Attributes:
        name: of the case.
        limits: of the mean and the greatest error, in % of the length.
        truth: what of thread and liquid is not as told; see `simulate`.
        outliers: part of the points that the camera puts 5 mm away.
        scale: factor of the camera on all lengths about the dish's middle.
        hidden: arc lengths between which the thread is covered for a while [m].
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
    outliers: float = 0.0
    scale: float = 1.0
    hidden: tuple[float, float] = (0.0, 0.0)
    post: str = ""
    every: int = 1
    lost: float = 0.0
    latency: int = 0
    start: str = "measured"
    second: bool = False
    better: bool = False


STIFFER, SOFTER = {"stiffness": 5.0}, {"stiffness": 0.2}
FIRST, MIDDLE, LAST = (0.0, 0.5 * LENGTH), (0.25 * LENGTH, 0.75 * LENGTH), (0.5 * LENGTH, LENGTH)
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
        Case("camera scale + 1 %", scale=1.01),
        Case("starts straight", start="straight"),
        Case("starts wrong by 20 %", start="bent"),
        Case("first half hidden", hidden=FIRST),
        Case("middle hidden", hidden=MIDDLE),
        Case("last half hidden", hidden=LAST),
        Case("middle, stiffness x 5", (2.0, 6.0), STIFFER, hidden=MIDDLE),
        Case("last half, stiffness x 5", (2.0, 6.0), STIFFER, hidden=LAST),
        Case("last half, stiffness / 5", (2.0, 6.0), SOFTER, hidden=LAST),
        Case("5 frames a second", every=6),
        Case("30 % lost", lost=0.3),
        Case("latency 0.2 s", latency=6),
        Case("all three", every=6, lost=0.3, latency=6),
        Case("10 % outliers", outliers=0.1),
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


def estimator_of(run: Run, case: Case) -> ThreadEstimator:
    """Return an estimator that knows of a run what the case lets it."""
    workspace = Workspace(() if case.post == "unknown" else run.posts, 5e-3, wall_radius=run.wall_radius)
    estimator = ThreadEstimator(ThreadPredictor(run.thread, workspace))
    estimator.warm_up()
    return estimator


def observations(case: Case, run: Run, seed: int) -> list[ThreadObservation | None]:
    """Return what each frame shows; None for a frame that never comes."""
    rng, seen = np.random.default_rng(seed), list[ThreadObservation | None]()
    # Another thread lies across the dish, waving slowly.
    angle = float(np.random.default_rng(seed).uniform(0.0, math.pi))
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    along = np.linspace(-0.009, 0.009, 60)
    for index, (pose, nodes) in enumerate(zip(run.poses, run.threads, strict=True)):
        length, (low, high) = float(arc_lengths(nodes)[-1]), case.hidden
        stretches = [(0.0, length)]
        if high > low and HIDDEN_TIME[0] <= pose.stamp < HIDDEN_TIME[1]:
            stretches = [(a, b) for a, b in ((0.0, low), (high, length)) if b - a > 4.0 * SPACING]
        pieces = [_piece(case, nodes, a, b, length, rng) for a, b in stretches]
        if case.second:
            other = np.column_stack([along, 2e-3 * np.sin(400.0 * along + 0.3 * pose.stamp)]) @ turn
            points = points_at(other, np.arange(0.0, float(arc_lengths(other)[-1]), SPACING))
            noisy, ends = points + rng.normal(0.0, DEVIATION, points.shape), (PieceEnd.UNKNOWN, PieceEnd.UNKNOWN)
            pieces.append(ThreadPiece(noisy, np.full(len(noisy), DEVIATION), *ends, (np.nan, np.nan), False))
        lost = rng.random() < case.lost and index > 0
        observation = ThreadObservation(tuple(pieces), complete=stretches == [(0.0, length)])
        seen.append(observation if index % case.every == 0 and not lost else None)
    return seen


def _piece(case: Case, nodes: Points, begin: float, end: float, length: float, rng: np.random.Generator) -> ThreadPiece:
    at = np.linspace(begin, end, max(int((end - begin) / SPACING), 2) + 1)
    points = points_at(nodes, at)
    along = np.gradient(points, axis=0)
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    # Errors that are alike over a length: an Ornstein-Uhlenbeck process along the thread.
    keep = float(np.exp(-2.0 * SPACING / 2.5e-4))  # m; over which neighbours err alike
    error = rng.normal(0.0, DEVIATION, len(points))
    for k in range(1, len(points)):
        error[k] = keep * error[k - 1] + (1.0 - keep * keep) ** 0.5 * error[k]
    noisy = points + error[:, None] * normal
    wrong, angle = rng.random(len(points)) < case.outliers, rng.uniform(0.0, 2.0 * np.pi, len(points))
    noisy += wrong[:, None] * 5e-3 * np.column_stack([np.cos(angle), np.sin(angle)])
    first = PieceEnd.TAIL if begin == 0.0 else PieceEnd.COVERED
    last = PieceEnd.FREE if end == length else PieceEnd.COVERED
    # What is known of the arc length: of the piece at the needle all, of one at the free end what is left.
    known = (0.0, 0.0) if begin == 0.0 else (0.98 * begin, min(1.02 * begin, length))
    return ThreadPiece(noisy * case.scale, np.full(len(noisy), DEVIATION), first, last, known)


def play(
    case: Case, run: Run, seen: Sequence[ThreadObservation | None], estimator: ThreadEstimator, first: Points
) -> tuple[list[ThreadEstimate], list[ThreadEstimate]]:
    """Return estimates at each pose but the first, as known when it comes, and at the stamps of the observations."""
    session, current, measured = EstimatorSession(estimator), list[ThreadEstimate](), list[ThreadEstimate]()
    poses = [replace(pose, tail=pose.tail * case.scale) for pose in run.poses]
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


def measure_case(case: Case, count: int, seed: int, advance: Callable[[], None]) -> dict[str, Any]:
    """Measure one case over all threads and a number of seeds.

    Returns:
        `estimate` and `prediction` (of the model alone, from the true first shape): errors after the first second, of
        a hidden part while it is, of an unknown post from the contact on; `consistent`: part of the windows of 5 s in
        which the mean normalised innovation squared is within its 95 % band; `worse`: runs whose estimate is worse than
        the prediction alone; `found`: contacts nobody told of that were found within 0.5 s, of so many `runs`; `met`:
        whether the limits hold.
    """
    errors: dict[str, list[NDArray[np.float64]]] = {"estimate": [], "prediction": []}
    consistent, at = list[bool](), np.linspace(0.0, LENGTH, SEGMENTS + 1)
    worse = runs = found = 0
    for material, attachment in THREADS:
        for number in range(seed, seed + count):
            advance()
            run = run_of(case, material, attachment, number)
            if run is None:
                continue
            truth = np.array([points_at(thread, at) for thread in run.threads])
            estimator, contact = estimator_of(run, case), contact_frame(run) if case.post else len(truth)
            estimates, measured = play(case, run, observations(case, run, number), estimator, truth[0])
            estimator.reset()  # what it learned of the thread too
            estimator.predictor.start_at(run.poses[0], truth[0])
            predicted = [estimator.predictor.step(pose).positions for pose in run.poses[1:]]
            frames, nodes = slice(int(RATE), None), slice(1, None)
            if case.hidden[1] > 0.0:
                low, high = (round(bound / LENGTH * SEGMENTS) for bound in case.hidden)
                frames = slice(*(round(bound * RATE) - 1 for bound in HIDDEN_TIME))
                nodes = slice(max(low, 1), high + 1)
            elif case.post == "unknown":
                frames = slice(min(contact, len(truth) - 2), None)
            for name, shapes in (("estimate", [e.positions for e in estimates]), ("prediction", predicted)):
                off = np.linalg.norm(np.array(shapes) - truth[1:], axis=2)[frames, nodes]
                errors[name].append(100.0 / LENGTH * off.ravel())
            worse += bool(errors["estimate"][-1].mean() > errors["prediction"][-1].mean())
            runs += 1
            consistent += _consistent_windows(measured)
            reports = [index + 1 for index, estimate in enumerate(estimates) if estimate.disturbances]
            found += case.post == "unknown" and any(0 <= k - contact <= FOUND_TIME * RATE for k in reports)
    spread = {
        name: {"mean": float(np.mean(off)), "maximum": float(np.max(off))}
        for name, off in ((name, np.concatenate([np.zeros(int(not parts)), *parts])) for name, parts in errors.items())
    }
    met = spread["estimate"]["mean"] <= case.limits[0] and spread["estimate"]["maximum"] <= case.limits[1]
    met = met and runs > 0 and not (case.better and worse) and (case.post != "unknown" or found >= 0.95 * runs)
    counts = {"worse": worse, "runs": runs, "found": found}
    share = float(np.mean(consistent)) if consistent else 0.0
    return {"name": case.name, "limits": case.limits, **spread, "consistent": share, **counts, "met": met}


def _consistent_windows(measured: Sequence[ThreadEstimate]) -> list[bool]:
    """Return for each window of 5 s whether the mean normalised innovation squared is within its 95 % band."""
    shown = [(e.stamp, e.innovations.normalised_squared) for e in measured if e.innovations is not None]
    stamps, squared = (np.array(values) for values in zip(*shown, strict=True))
    windows = []
    for begin in np.arange(stamps[0], stamps[-1] - 0.99 * CONSISTENCY_WINDOW, CONSISTENCY_WINDOW):
        values = squared[(stamps >= begin) & (stamps < begin + CONSISTENCY_WINDOW)]
        values = values[np.isfinite(values)]
        if len(values):
            windows.append(bool(abs(values.mean() - 1.0) <= 1.96 * np.sqrt(2.0 / len(values))))
    return windows


def reports_rendered(run: Run, case: Case, seed: int, frames: int) -> list[int]:
    """Return the rendered frames in which a disturbance is reported; posts are not drawn: they are of glass."""
    scene = CameraScene(dish_diameter=2.0 * WALL_RADIUS, thread_diameter=run.thread.diameter)
    camera = DishCamera(scene, DishView((322.0, 238.0), 8e-5), seed=seed)
    settings = VisionTrackerSettings(needle_length=0.007, needle_width=0.0004, thread_length=LENGTH)
    tracker, session = TrackerSession(settings, Scene()), EstimatorSession(estimator_of(run, case))
    reports = []
    for index, (pose, thread) in enumerate(zip(run.poses[:frames], run.threads, strict=False)):
        heading = float(np.arctan2(pose.heading[1], pose.heading[0]))
        seen = tracker.on_image(pose.stamp, camera.render(pose.tail, heading, thread))
        if seen.tracked:
            session.on_observation(pose.stamp, seen.track.observation)
            deviation = pose_deviation(np.diag(seen.track.covariance))
            result = session.on_pose(NeedlePose(pose.stamp, seen.track.tail, seen.track.heading, deviation))
            if result.estimate is not None and result.estimate.disturbances:
                reports.append(index)
    return reports


def measure_rendered(count: int, seed: int) -> dict[str, int]:
    """Return how many unknown contacts were found in time, and false reports in runs without a post."""
    figures = dict.fromkeys(("runs", "found", "runs_without_post", "false_reports"), 0)
    for number in range(seed, seed + count):
        for material, attachment in THREADS:
            run = run_of(CASES["unknown post"], material, attachment, number)
            contact = contact_frame(run) if run is not None else 0
            if run is not None and contact < len(run.threads):
                until = contact + round(2.0 * RATE)
                reports = reports_rendered(run, CASES["unknown post"], number, until)
                figures["runs"] += 1
                figures["found"] += any(contact <= index <= contact + FOUND_TIME * RATE for index in reports)
            run = free_run(material, attachment, number)
            figures["runs_without_post"] += 1
            figures["false_reports"] += bool(reports_rendered(run, CASES["right, free"], number, len(run.threads)))
    return figures


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--count", type=int, default=2, metavar="N", help="runs of each case and thread (default: 2)")
    option("--seed", type=int, default=1, metavar="S", help="of the first run (default: 1)")
    option("--cases", nargs="+", choices=list(CASES), metavar="CASE", help="only these; default: all")
    option("--rendered", type=int, default=0, metavar="N", help="also N seeds of unknown posts, by rendered frames")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Measure the cases; return the figures, and whether all limits hold."""
    names, done, cases = options.cases or list(CASES), 0, []
    with terminal.progress("estimator") as report:

        def advance() -> None:
            nonlocal done
            report(done / (len(names) * len(THREADS) * options.count))
            done += 1

        cases = [measure_case(CASES[name], options.count, options.seed, advance) for name in names]
        rendered = measure_rendered(options.rendered, options.seed) if options.rendered else {}
    columns = {
        "case": "{name}",
        "limit": "{limits[0]:.3f} {limits[1]:6.2f}",
        "estimate": "{estimate[mean]:.3f} {estimate[maximum]:6.2f}",
        "prediction": "{prediction[mean]:.3f} {prediction[maximum]:6.2f}",
        "consistent": "{consistent:.0%}",
        "found": "{found}",
        "runs": "{runs}",
        "met": "{met}",
    }
    terminal.print(figures_table("mean, greatest error in % of the length", cases, columns))
    if rendered:
        terminal.log("rendered frames: " + ", ".join(f"{name} {value}" for name, value in rendered.items()))
    return {"cases": cases, "rendered": rendered}, all(figures["met"] for figures in cases)
