"""Plays the cases through estimator and predictor: errors, consistency and time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.estimator.cases import CASES, RATE, Case, contact_frame, free_run, run_of, second_thread
from benchmarks.estimator.truth import Run
from magnetosuture_thread.estimator import EstimatorOptions, EstimatorSession, ThreadEstimate, ThreadEstimator
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points, points_at
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread_observation import ThreadObservation

THREADS = (("polyamide_7_0", "pinned"), ("polyamide_7_0", "clamped"), ("silk_6_0", "pinned"))
CONSISTENCY_WINDOW = 5.0  # s
FOUND_TIME = 0.5  # s


def errors_of(errors: NDArray[np.float64]) -> dict[str, float]:
    """Return mean and maximum of distances of nodes from the truth, of any shape, in % of the length."""
    return (
        {"mean": float(errors.mean()), "maximum": float(errors.max())} if errors.size else {"mean": 0.0, "maximum": 0.0}
    )


def targets(run: Run, segments: int) -> NDArray[np.float64]:
    """Return where the nodes of a thread are in truth at each frame, shape (T, n + 1, 2) [m]."""
    at = np.linspace(0.0, run.thread.length, segments + 1)
    return np.array([points_at(thread, at) for thread in run.threads])


def estimator_of(thread: Thread, run: Run, case: Case | None = None) -> ThreadEstimator:
    """Return an estimator that knows of a run what the case lets it."""
    posts = () if case is not None and case.post == "unknown" else run.posts
    options = EstimatorOptions(slow_parameters=case.learned) if case is not None and case.learned else None
    estimator = ThreadEstimator(ThreadPredictor(thread, Workspace(posts, 5e-3, wall_radius=run.wall_radius)), options)
    estimator.warm_up()
    return estimator


def observations(case: Case, run: Run, seed: int) -> list[ThreadObservation | None]:
    """Return what each frame shows; None for a frame that never comes."""
    rng, other = np.random.default_rng(seed), second_thread(seed)
    seen: list[ThreadObservation | None] = []
    for index, (pose, nodes) in enumerate(zip(run.poses, run.threads, strict=True)):
        others = (other(pose.stamp),) if case.second else ()
        observation = case.camera.observe(nodes, pose.stamp, rng, others)
        lost = rng.random() < case.lost and index > 0
        seen.append(observation if index % case.every == 0 and not lost else None)
    return seen


def _bent(nodes: Points, length: float) -> Points:
    """Return a shape that is off by a fifth of the length at the free end."""
    aside = np.array([nodes[-1, 1] - nodes[0, 1], nodes[0, 0] - nodes[-1, 0]])
    aside = 0.2 * length * aside / max(float(np.linalg.norm(aside)), 1e-9)
    return np.asarray(nodes + np.linspace(0.0, 1.0, len(nodes))[:, None] * aside)


class Played(NamedTuple):
    """Estimates of a run.

    Attributes:
        current: at each pose but the first, as it is known when the pose comes.
        measured: at the stamps of the observations, which may come late.
    """

    current: list[ThreadEstimate]
    measured: list[ThreadEstimate]


def play(
    case: Case, run: Run, seen: Sequence[ThreadObservation | None], estimator: ThreadEstimator, first: Points
) -> Played:
    """Return the estimates of a run."""
    session = EstimatorSession(estimator)
    estimator.reset()
    poses = [replace(pose, tail=pose.tail * case.camera.scale) for pose in run.poses]
    played = Played([], [])
    for index, pose in enumerate(poses):
        late = seen[index - case.latency] if index >= case.latency else None
        observed = late if case.start == "measured" or index > 0 else None
        if index == 0 and case.start == "bent":
            session.start(pose, _bent(first, estimator.thread.length))
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
            played.current.append(result.estimate)
            if result.measured is not None and observed is not None:
                played.measured.append(result.measured)
    return played


def predict(run: Run, estimator: ThreadEstimator, first: Points) -> NDArray[np.float64]:
    """Return the nodes of the model alone at each pose but the first, from the true first shape."""
    predictor = estimator.predictor
    estimator.reset()  # what it learned of the thread too
    predictor.start_at(run.poses[0], first)
    return np.array([predictor.step(pose).positions for pose in run.poses[1:]])


def measure_case(case: Case, count: int, seed: int, segments: int, progress: Callable[[], None]) -> dict[str, Any]:
    """Measure one case over all threads and a number of seeds.

    Returns:
        `estimate` and `prediction` (of the model alone, from the true first shape): errors; `consistent`: part of the
        windows of 5 s in which the mean normalised innovation squared is within its 95 % band; `innovation`: its mean;
        `worse`: runs whose estimate is worse than the prediction alone; `found`: contacts nobody told of that were
        found within 0.5 s, of so many `runs`; `false_alarms`: runs with a report before any contact; `met`: whether
        the limits hold.
    """
    errors, alone = [np.empty(0)], [np.empty(0)]
    inside, innovations = list[bool](), [np.ones(1)]
    worse = runs = found = alarms = 0
    for material, attachment in THREADS:
        for number in range(seed, seed + count):
            progress()
            run = run_of(case, material, attachment, number)
            if run is None:
                continue
            thread = replace(run.thread, segments=segments)
            truth, estimator = targets(run, segments), estimator_of(thread, run, case)
            estimates, measured = play(case, run, observations(case, run, number), estimator, truth[0])
            contact = contact_frame(run) if case.post else len(truth)
            judged = _judged(case, run, contact, segments)
            errors.append(_off(np.array([each.positions for each in estimates]), truth, thread.length)[judged].ravel())
            alone.append(_off(predict(run, estimator, truth[0]), truth, thread.length)[judged].ravel())
            worse += bool(errors[-1].mean() > alone[-1].mean())
            runs += 1
            squared = _squared(measured)
            inside += _within_band(measured, squared)
            innovations.append(squared[np.isfinite(squared)])
            alarms_at = [index + 1 for index, each in enumerate(estimates) if each.disturbances]
            if case.post == "unknown":
                found += any(contact <= index <= contact + FOUND_TIME * RATE for index in alarms_at)
            alarms += any(index < contact for index in alarms_at)
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


def _off(nodes: NDArray[np.float64], truth: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Return errors of all nodes but the needle's, in % of the length, shape (T - 1, n)."""
    return np.asarray(100.0 / length * np.linalg.norm(nodes[:, 1:] - truth[1:, 1:], axis=2))


def _judged(case: Case, run: Run, contact: int, segments: int) -> tuple[slice, slice]:
    """Return the frames and nodes that count."""
    frames, nodes = slice(int(RATE), None), slice(None)
    if case.judged == "hidden":
        low, high = (round(bound / run.thread.length * segments) for bound in case.camera.hidden)
        frames = slice(*(round(bound * RATE) - 1 for bound in case.camera.hidden_time))
        nodes = slice(max(low - 1, 0), high)
    elif case.judged == "contact":
        frames = slice(min(contact, len(run.threads) - 2), None)
    return frames, nodes


def _squared(estimates: Sequence[ThreadEstimate]) -> NDArray[np.float64]:
    """Return normalised innovations squared of each frame's windows, nan where nothing is measured."""
    empty = np.full(len(estimates[0].noise), np.nan)
    return np.array([each.innovations.normalised_squared if each.innovations else empty for each in estimates])


def _within_band(estimates: Sequence[ThreadEstimate], squared: NDArray[np.float64]) -> list[bool]:
    """Return of each window of 5 s whether the mean is within the band that 95 % of means of so many are in."""
    stamps = np.array([each.stamp for each in estimates])
    inside = []
    for begin in np.arange(stamps[0], stamps[-1] - 0.99 * CONSISTENCY_WINDOW, CONSISTENCY_WINDOW):
        values = squared[(stamps >= begin) & (stamps < begin + CONSISTENCY_WINDOW)]
        values = values[np.isfinite(values)]
        if len(values):
            inside.append(bool(abs(values.mean() - 1.0) <= 1.96 * np.sqrt(2.0 / len(values))))
    return inside


def measure_cost(segments: int, seed: int) -> dict[str, float]:
    """Return median processor times of a step with and without a measurement [s], and the number of points."""
    case, run = CASES["right, free"], free_run("silk_6_0", "pinned", seed, 25.0)
    thread = replace(run.thread, segments=segments)
    estimator, seen = estimator_of(thread, run), observations(case, run, seed)
    first = seen[0]
    assert first is not None
    estimator.start_observed(run.poses[0], first)
    times: dict[str, list[float]] = {"estimate_s": [], "prediction_s": []}
    for pose, each in zip(run.poses[1:], seen[1:], strict=True):
        began = time.process_time()
        estimator.step(pose, each)
        times["estimate_s"].append(time.process_time() - began)
    estimator.predictor.start_at(run.poses[0], targets(run, segments)[0])
    for pose in run.poses[1:]:
        began = time.process_time()
        estimator.predictor.step(pose)
        times["prediction_s"].append(time.process_time() - began)
    return {name: float(np.median(values)) for name, values in times.items()} | {
        "points": float(len(first.pieces[0].points))
    }
