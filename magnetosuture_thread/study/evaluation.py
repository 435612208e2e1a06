"""Scores a formulation on reference trajectories."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.choices import make_formulation, make_solver
from magnetosuture_thread.model.formulations import PaperOptions
from magnetosuture_thread.model.medium import Medium
from magnetosuture_thread.model.predictor import NeedlePose, ThreadPredictor
from magnetosuture_thread.model.program import SOLVED
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Thread
from magnetosuture_thread.study.reference import NOT_ONE, ReferenceTrajectory, read_reference

TOLERANCE = 1e-6  # of the residuals
NEAR = 3e-3  # m; within this of an obstacle, depths are looked at


Progress = Callable[[float], None]


@dataclass(frozen=True)
class CaseScore:
    """How a formulation did on one trajectory.

    Attributes:
        name: of the case.
        mean_error_percent: mean over time of the mean distance of the nodes [% of the length].
        max_error_percent: the largest over time.
        max_stretch: greatest length of a segment over what it should be, less one.
        max_penetration_m: deepest that a node was in the obstacle, 0 if none was.
        step_median_s: of the wall-clock time of a sample's step, without the margins' message [s].
        step_p99_s: of the same [s].
        max_residual: the largest scaled residual of a solve.
        fallbacks: steps that needed another solver or a cold start, or did not converge.
    """

    name: str
    mean_error_percent: float
    max_error_percent: float
    max_stretch: float
    max_penetration_m: float
    step_median_s: float
    step_p99_s: float
    max_residual: float
    fallbacks: int


@dataclass(frozen=True)
class Evaluation:
    """The scores of a set of trajectories; on simulated ones unless they are said to be others.

    Attributes:
        formulation: its name.
        solver: its name.
        cases: one score for each trajectory.
    """

    formulation: str
    solver: str
    cases: tuple[CaseScore, ...]

    @property
    def mean_error_percent(self) -> float:
        """Mean over the cases."""
        return float(np.mean([case.mean_error_percent for case in self.cases]))

    @property
    def worst_error_percent(self) -> float:
        """The largest mean of a case."""
        return max(case.mean_error_percent for case in self.cases)

    def to_mapping(self) -> dict[str, Any]:
        """Return what goes into JSON."""
        return {
            "formulation": self.formulation,
            "solver": self.solver,
            "cases": [asdict(case) for case in self.cases],
            "mean_error_percent": self.mean_error_percent,
            "worst_error_percent": self.worst_error_percent,
        }


@dataclass(frozen=True)
class Course:
    """One evaluated trajectory over time.

    Attributes:
        reference: the trajectory.
        vertices: predicted, shape (T, n + 1, 2) [m].
        error_percent: shape (T,).
        score: the figures.
    """

    reference: ReferenceTrajectory
    vertices: NDArray[np.float64]
    error_percent: NDArray[np.float64]
    score: CaseScore


def find_references(folder: Path) -> list[Path]:
    """Return the trajectories of a folder, in the order of their names.

    Raises:
        BagError: there are none.
    """
    if folder.is_file():
        return [folder]
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise BagError(folder, "holds no reference trajectories (.npz)" if folder.is_dir() else "does not exist")
    return paths


def score(
    paths: Sequence[Path],
    *,
    formulation: str,
    solver: str,
    segments: int | None = None,
    progress: Callable[[float], None],
    keep: Callable[[Course], None] = lambda course: None,
) -> Evaluation:
    """Score a formulation on trajectories: each with its own thread and parameters, nothing tuned for a case.

    Args:
        paths: the trajectories.
        formulation: its name.
        solver: its name.
        segments: n, of all cases; without it each case has the paper's.
        progress: is told the share done.
        keep: is given each case's course.

    Raises:
        BagError: a file is no reference trajectory.
        SolverError: a step could not be solved.
    """

    def one(reference: ReferenceTrajectory, path: Path, share: Progress) -> Course:
        return score_one(reference, path, formulation, solver, segments, share)

    return Evaluation(formulation, solver, score_each(paths, one, progress, keep))


def score_each(
    paths: Sequence[Path],
    one: Callable[[ReferenceTrajectory, Path, Progress], Course],
    progress: Progress,
    keep: Callable[[Course], None],
) -> tuple[CaseScore, ...]:
    """Score trajectories one after another.

    Args:
        paths: the trajectories.
        one: scores one of them, and is given what it tells the share done to.
        progress: is told the share of all that is done.
        keep: is given each case's course.

    Raises:
        BagError: a file is no reference trajectory.
    """
    scores = []
    for index, path in enumerate(paths):

        def share(part: float, index: int = index) -> None:
            progress((index + part) / len(paths))

        course = one(read_reference(path), path, share)
        scores.append(course.score)
        keep(course)
    return tuple(scores)


def score_one(
    reference: ReferenceTrajectory,
    path: Path,
    formulation: str,
    solver: str,
    segments: int | None,
    progress: Callable[[float], None],
) -> Course:
    """Score a formulation on one trajectory; see `score`.

    Source: reference set, "How a prediction is scored". Deviation: none.
    """
    thread, paper = thread_of(reference, path, segments)
    workspace = Workspace(reference.discs, NEAR)
    chosen = make_formulation(formulation, thread, workspace, make_solver(solver, TOLERANCE), TOLERANCE, paper)
    predictor = ThreadPredictor(chosen, thread)
    predictor.warm_up()
    truth = np.stack([resampled(curve, thread.segments) for curve in reference.threads])
    headings = np.column_stack([np.cos(reference.headings), np.sin(reference.headings)])
    predictor.start_at(NeedlePose(reference.times[0], reference.tails[0], headings[0]), truth[0])
    count = len(reference.times)
    vertices, took = np.empty_like(truth), np.zeros(count)
    vertices[0] = truth[0]
    stretch, depth, residual, fallbacks = -np.inf, 0.0, 0.0, 0
    for k in range(1, count):
        pose = NeedlePose(reference.times[k], reference.tails[k], headings[k])
        began = time.perf_counter()
        prediction = predictor.step(pose)
        took[k] = time.perf_counter() - began
        vertices[k] = prediction.vertices
        stretch, residual = max(stretch, float(prediction.stretch.max())), max(residual, prediction.residual)
        fallbacks += prediction.status != SOLVED
        for disc in reference.discs:
            # The needle's own way is given, so only the thread's nodes can be blamed.
            outside = disc.signed_distance(prediction.vertices[1:])[0] - 0.5 * thread.diameter
            depth = max(depth, -float(outside.min()))
        if k % 50 == 0:
            progress(k / count)
    error = 100.0 * np.linalg.norm(vertices[:, 1:] - truth[:, 1:], axis=2).mean(axis=1) / thread.length
    figures = CaseScore(
        name=reference.name,
        mean_error_percent=float(error.mean()),
        max_error_percent=float(error.max()),
        max_stretch=stretch,
        max_penetration_m=depth,
        step_median_s=float(np.median(took[1:])),
        step_p99_s=float(np.percentile(took[1:], 99)),
        max_residual=residual,
        fallbacks=fallbacks,
    )
    return Course(reference, vertices, error, figures)


def thread_of(reference: ReferenceTrajectory, path: Path, segments: int | None = None) -> tuple[Thread, PaperOptions]:
    """Return the thread that a trajectory's metadata describes, and the options of `paper` for its material.

    Those are of silk where the kind says silk, else of polyamide: W_stiff is tuned for these two only.

    Raises:
        BagError: the metadata lacks something, or holds what is none.
    """
    try:
        given = reference.metadata["material"]
        kind = str(given["kind"])
        attachment = {"pinned": Attachment.PINNED, "clamped": Attachment.GLUED}[reference.metadata["boundary"]]
        thread = Thread(
            material=kind,
            length=float(given["L_m"]),
            segments=segments or int(given["paper_nodes"]),
            diameter=float(given["diameter_m"]),
            bending_stiffness=float(given["EI_Nm2"]),
            medium=Medium(float(given["zeta_perp_Pa_s"]), float(given["zeta_par_Pa_s"])),
            attachment=attachment,
        )
    except NOT_ONE as error:
        raise BagError(path, f"has no thread in its metadata: {type(error).__name__} {error}") from None
    values = (thread.length, thread.diameter, thread.bending_stiffness, thread.medium.drag_along)
    if not (all(np.isfinite(value) and value > 0.0 for value in values) and thread.segments >= 3):
        raise BagError(path, "has a thread whose length, diameter, stiffness, drag or segments are not positive")
    family = "silk_6_0" if "silk" in kind else "polyamide_7_0"
    return thread, PaperOptions.tuned(MATERIALS[family].stiffness_weight)


def resampled(curve: Points, segments: int) -> Points:
    """Return n + 1 points of a curve whose own points are equally spaced in arc length."""
    given, wanted = np.linspace(0.0, 1.0, len(curve)), np.linspace(0.0, 1.0, segments + 1)
    return np.column_stack([np.interp(wanted, given, curve[:, axis]) for axis in range(curve.shape[1])])
