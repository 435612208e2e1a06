"""The job `magnetosuture evaluate --rig`: the simulated rig's thread against reference trajectories."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.reference import (
    NOT_ONE,
    CaseResult,
    Evaluation,
    Progress,
    ReferenceTrajectory,
    StepFigures,
    run_case,
    score_each,
)
from magnetosuture_thread.rig.mechanics.dynamics import NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody

SEGMENTS = 100
FORMULATION, SOLVER = "rig", "newton"
NEEDLE_BODY = NeedleBody(length=7e-3, diameter=4e-4, curvature=0.0, magnetisation=0.0, viscosity=1.0)
"""Of a needle whose motion is given, the body does not matter."""


def score_rig(
    paths: Sequence[Path],
    segments: int | None = None,
    progress: Progress = lambda share: None,
    keep: Callable[[CaseResult], None] = lambda result: None,
) -> Evaluation:
    """PrescribedMotion the rig's needle along reference trajectories and score its thread, nothing tuned for a case.

    Of the scores, `max_residual` is in units of the drag across the whole thread at the case's greatest speed, and
    `fallbacks` counts steps that had to be halved.

    Args:
        paths: the trajectories.
        segments: n, 100 unless given.
        progress: is told the share done.
        keep: is given each case's result.

    Raises:
        BagError: a file is no reference trajectory.
        SolverError: a step could not be solved.
    """

    def score_case(reference: ReferenceTrajectory, path: Path, share: Progress) -> CaseResult:
        thread = rig_thread(reference, path, segments or SEGMENTS)
        first, unit = reference.threads[0], thread.length / (segments or SEGMENTS)
        if np.ptp(first, axis=0).max() == 0.0 or np.linalg.norm(first[0] - reference.tails[0]) > 0.1 * unit:
            raise BagError(path, "has a first thread of one point, or one that does not begin at the needle's tail")
        if thread.diameter >= thread.length:
            raise BagError(path, f"has a thread of {thread.diameter:g} m in diameter, expected less than its length")
        surface, heading = Surface(discs=reference.discs), float(reference.headings[0])
        rig = RigDynamics(NEEDLE_BODY, thread, surface, None, reference.tails[0], heading, reference.threads[0])
        speed = np.linalg.norm(np.diff(reference.tails, axis=0), axis=1) / np.diff(reference.times)
        force = thread.drag_across * thread.length * max(float(speed.max()), 1e-6)

        def step(index: int) -> RigDynamics:
            interval = reference.times[index] - reference.times[index - 1]
            rig.drive(reference.tails[index], float(reference.headings[index]), interval)
            return rig

        def figures(rig: RigDynamics) -> StepFigures:
            strain = max(0.0, float(rig.tension.max()) / thread.stretching_stiffness)
            return StepFigures(rig.thread, strain, rig.residual / force, rig.halvings)

        return run_case(reference, rig.thread, thread.length, thread.diameter, step, figures, share)

    return Evaluation(FORMULATION, SOLVER, score_each(paths, score_case, progress, keep))


def rig_thread(reference: ReferenceTrajectory, path: Path, segments: int) -> ThreadProperties:
    """Return the thread that a trajectory's metadata describes.

    Raises:
        BagError: the metadata lacks something, or holds what is none.
    """
    names = ("L_m", "EI_Nm2", "EA_N", "zeta_perp_Pa_s", "zeta_par_Pa_s", "diameter_m")
    try:
        given = reference.metadata["material"]
        length, bending, stretching, across, along, diameter = (float(given[name]) for name in names)
        attachment = {"pinned": NeedleJoint.PINNED, "clamped": NeedleJoint.CLAMPED}[reference.metadata["boundary"]]
    except NOT_ONE as error:
        raise BagError(path, f"has no thread in its metadata: {type(error).__name__} {error}") from None
    values = (length, bending, stretching, across, along, diameter)
    if not all(math.isfinite(value) and value > 0.0 for value in values):
        raise BagError(path, f"has a thread with one of {', '.join(names)} not positive")
    return ThreadProperties(length, segments, bending, stretching, across, along, attachment, diameter=diameter)
