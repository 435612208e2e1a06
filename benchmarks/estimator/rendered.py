"""Contacts that nobody told of, through rendered frames and the tracker: whether and when they are found."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.estimator.cases import CASES, RATE, contact_frame, free_run, run_of
from benchmarks.estimator.measurements import FOUND_TIME, THREADS, errors_of, estimator_of, targets
from benchmarks.estimator.truth import WALL_RADIUS, Run
from magnetosuture_thread.estimator import EstimatorSession, ThreadEstimate, ThreadEstimator
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.messages.reading import pose_deviation
from magnetosuture_thread.rig.camera import CameraScene, DishCamera
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread_observation import ThreadObservation
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import TrackerSession

VIEW = DishView((322.0, 238.0), 8e-5)
AFTERWARDS = 2.0  # s; of a run after the contact


TrackedFrame = tuple[NeedlePose | None, ThreadObservation | None]
"""What the tracker measures in a frame; None and None where it is not sure of the needle."""


def track(run: Run, seed: int, frames: int) -> list[TrackedFrame]:
    """Return what the tracker measures in rendered frames of a run. Posts are not drawn: they are of glass."""
    scene = CameraScene(dish_diameter=2.0 * WALL_RADIUS, thread_diameter=run.thread.diameter)
    camera = DishCamera(scene, VIEW, seed=seed)
    settings = VisionTrackerSettings(needle_length=0.007, needle_width=0.0004, thread_length=run.thread.length)
    tracker = TrackerSession(settings, Scene())
    found = []
    for pose, thread in zip(run.poses[:frames], run.threads, strict=False):
        heading = float(np.arctan2(pose.heading[1], pose.heading[0]))
        seen = tracker.on_image(pose.stamp, camera.render(pose.tail, heading, thread))
        pose_seen = None
        if seen.tracked:
            deviation = pose_deviation(np.diag(seen.track.covariance))
            pose_seen = NeedlePose(pose.stamp, seen.track.tail, seen.track.heading, deviation)
        found.append((pose_seen, seen.track.observation if seen.tracked else None))
    return found


def play_tracked(frames: list[TrackedFrame], estimator: ThreadEstimator) -> dict[int, ThreadEstimate]:
    """Return the estimates, by the frame's number."""
    session, estimates = EstimatorSession(estimator), {}
    estimator.reset()
    for index, (pose, observation) in enumerate(frames):
        if pose is None:
            continue
        if observation is not None:
            session.on_observation(pose.stamp, observation)
        estimate = session.on_pose(pose).estimate
        if estimate is not None:
            estimates[index] = estimate
    return estimates


def measure_rendered(count: int, seed: int, progress: Callable[[], None]) -> dict[str, Any]:
    """Return how many unknown contacts were found in time, and false reports, with a post and without."""
    case, errors = CASES["unknown post"], []
    names = ("runs", "found", "late", "untracked_at_contact", "early", "runs_without_post", "false_reports")
    figures: dict[str, Any] = dict.fromkeys(names, 0)
    for number in range(seed, seed + count):
        for material, attachment in THREADS:
            progress()
            run = run_of(case, material, attachment, number)
            contact = contact_frame(run) if run is not None else 0
            if run is not None and contact < len(run.threads):
                frames = track(run, number, contact + round(AFTERWARDS * RATE))
                estimates = play_tracked(frames, estimator_of(run.thread, run, case))
                reports = [index for index, each in estimates.items() if each.disturbances]
                first = min((index for index in reports if index >= contact), default=len(run.threads))
                figures["runs"] += 1
                figures["early"] += any(index < contact for index in reports)
                figures["found"] += first <= contact + FOUND_TIME * RATE
                figures["late"] += contact + FOUND_TIME * RATE < first < len(run.threads)
                figures["untracked_at_contact"] += frames[contact][0] is None
            run = free_run(material, attachment, number, 25.0)
            estimates = play_tracked(track(run, number, len(run.threads)), estimator_of(run.thread, run))
            figures["runs_without_post"] += 1
            figures["false_reports"] += any(each.disturbances for each in estimates.values())
            truth = targets(run, run.thread.segments)
            off = [np.linalg.norm(each.positions - truth[k], axis=1) for k, each in estimates.items() if k >= RATE]
            errors.append(100.0 / run.thread.length * np.array(off).ravel())
    of_all = errors_of(np.concatenate(errors))
    return figures | {"estimate_mean": of_all["mean"], "estimate_maximum": of_all["maximum"]}
