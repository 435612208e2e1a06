"""The job `magnetosuture evaluate --rig`: the simulated rig's thread against reference trajectories."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.rig.mechanics.dynamics import Attachment, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody
from magnetosuture_thread.study.evaluation import CaseScore, Course, Evaluation, Progress, resampled, score_each
from magnetosuture_thread.study.reference import NOT_ONE, ReferenceTrajectory

SEGMENTS = 100
FORMULATION, SOLVER = "rig", "newton"
DRIVEN = NeedleBody(length=7e-3, diameter=4e-4, curvature=0.0, magnetisation=0.0, viscosity=1.0)
"""Of a needle whose motion is given, the body does not matter."""


def score_rig(
    paths: Sequence[Path],
    segments: int | None = None,
    progress: Progress = lambda share: None,
    keep: Callable[[Course], None] = lambda course: None,
) -> Evaluation:
    """PrescribedMotion the rig's needle along reference trajectories and score its thread, nothing tuned for a case.

    Of the scores, `max_residual` is in units of the drag across the whole thread at the case's greatest speed, and
    `fallbacks` counts steps that had to be halved.

    Args:
        paths: the trajectories.
        segments: n, 100 unless given.
        progress: is told the share done.
        keep: is given each case's course.

    Raises:
        BagError: a file is no reference trajectory.
        SolverError: a step could not be solved.
    """

    def one(reference: ReferenceTrajectory, path: Path, share: Progress) -> Course:
        return score_rig_on(reference, path, segments or SEGMENTS, share)

    return Evaluation(FORMULATION, SOLVER, score_each(paths, one, progress, keep))


def score_rig_on(reference: ReferenceTrajectory, path: Path, segments: int, progress: Progress) -> Course:
    """Score the rig's thread on one trajectory; see `score_rig`.

    Source: reference set, "How a prediction is scored". Deviation: none.
    """
    properties = thread_of(reference, path, segments)
    truth = np.stack([resampled(curve, segments) for curve in reference.threads])
    rig = RigDynamics(
        DRIVEN,
        properties,
        Surface(discs=reference.discs),
        None,
        reference.tails[0],
        float(reference.headings[0]),
        reference.threads[0],
    )
    count = len(reference.times)
    vertices, took = np.empty_like(truth), np.zeros(count)
    vertices[0] = rig.thread
    stretch, depth, residual, halvings = 0.0, 0.0, 0.0, 0
    speed = np.linalg.norm(np.diff(reference.tails, axis=0), axis=1) / np.diff(reference.times)
    for k in range(1, count):
        began = time.perf_counter()
        rig.drive(reference.tails[k], float(reference.headings[k]), reference.times[k] - reference.times[k - 1])
        took[k] = time.perf_counter() - began
        vertices[k] = rig.thread
        stretch = max(stretch, float(rig.tension.max()) / properties.stretching_stiffness)
        residual, halvings = max(residual, rig.residual), halvings + rig.halvings
        for disc in reference.discs:
            outside = disc.signed_distance(vertices[k, 1:])[0] - 0.5 * properties.diameter
            depth = max(depth, -float(outside.min()))
        if k % 50 == 0:
            progress(k / count)
    error = 100.0 * np.linalg.norm(vertices[:, 1:] - truth[:, 1:], axis=2).mean(axis=1) / properties.length
    figures = CaseScore(
        name=reference.name,
        mean_error_percent=float(error.mean()),
        max_error_percent=float(error.max()),
        max_stretch=stretch,
        max_penetration_m=depth,
        step_median_s=float(np.median(took[1:])),
        step_p99_s=float(np.percentile(took[1:], 99)),
        max_residual=residual / (properties.drag_across * properties.length * max(float(speed.max()), 1e-6)),
        fallbacks=halvings,
    )
    return Course(reference, vertices, error, figures)


def thread_of(reference: ReferenceTrajectory, path: Path, segments: int) -> ThreadProperties:
    """Return the thread that a trajectory's metadata describes.

    Raises:
        BagError: the metadata lacks something, or holds what is none.
    """
    names = ("L_m", "EI_Nm2", "EA_N", "zeta_perp_Pa_s", "zeta_par_Pa_s", "diameter_m")
    try:
        given = reference.metadata["material"]
        length, bending, stretching, across, along, diameter = (float(given[name]) for name in names)
        attachment = {"pinned": Attachment.PINNED, "clamped": Attachment.CLAMPED}[reference.metadata["boundary"]]
    except NOT_ONE as error:
        raise BagError(path, f"has no thread in its metadata: {type(error).__name__} {error}") from None
    values = (length, bending, stretching, across, along, diameter)
    if not all(math.isfinite(value) and value > 0.0 for value in values):
        raise BagError(path, f"has a thread with one of {', '.join(names)} not positive")
    return ThreadProperties(length, segments, bending, stretching, across, along, attachment, diameter=diameter)
