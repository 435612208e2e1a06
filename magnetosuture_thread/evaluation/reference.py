"""Reference trajectories, needle poses and the thread that an independent simulator found, and scores on them."""

from __future__ import annotations

import json
import math
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.metrics import RunMetrics, node_errors
from magnetosuture_thread.evaluation.workers import Progress
from magnetosuture_thread.geometry.obstacles import Disc, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.settings.errors import BagError, ConfigurationError
from magnetosuture_thread.settings.files import MAX_FILE_BYTES, read_regular
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Medium, Thread
from magnetosuture_thread.thread.paper import PaperOptions
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.program import SOLVED

# What numpy and json raise on files that are something else.
MALFORMED = (
    *(OSError, ValueError, TypeError, AttributeError, LookupError, EOFError, MemoryError, RecursionError),
    *(zipfile.BadZipFile, zlib.error),
)


@dataclass(frozen=True)
class ReferenceTrajectory:
    """One reference trajectory; simulated, not recorded from a robot.

    Attributes:
        name: of the case.
        times: shape (T,) [s].
        tails: the needle's tail, shape (T, 2) [m].
        headings: unwrapped, shape (T,) [rad].
        threads: centreline of equally spaced points from the tail on, shape (T, m, 2) [m].
        discs: round obstacles.
        metadata: everything else that the file says.
    """

    name: str
    times: NDArray[np.float64]
    tails: NDArray[np.float64]
    headings: NDArray[np.float64]
    threads: NDArray[np.float64]
    discs: tuple[Disc, ...]
    metadata: dict[str, Any]

    def at(self, time: float) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
        """Return tail, heading and thread at a time, linear between the samples."""
        index = int(np.clip(np.searchsorted(self.times, time) - 1, 0, len(self.times) - 2))
        part = (time - self.times[index]) / (self.times[index + 1] - self.times[index])
        tail, heading, thread = (
            np.asarray(values[index] + part * (values[index + 1] - values[index]))
            for values in (self.tails, self.headings, self.threads)
        )
        return tail, float(heading), thread


def read_reference(path: Path) -> ReferenceTrajectory:
    """Read a trajectory from an .npz file with the keys t, pose, X and meta.

    Raises:
        BagError: the file is missing, damaged, or not of this format.
    """
    try:
        packed = BytesIO(read_regular(path, MAX_FILE_BYTES))
        with zipfile.ZipFile(packed) as archive:
            if (size := sum(entry.file_size for entry in archive.infolist())) > MAX_FILE_BYTES:
                raise ValueError(f"it unpacks to {size} bytes, more than {MAX_FILE_BYTES}")
        packed.seek(0)
        with np.load(packed, allow_pickle=False) as data:
            times, poses, threads = (np.asarray(data[key], dtype=np.float64) for key in ("t", "pose", "X"))
            if "unit" in data:  # packed: differences in time, in whole units
                threads = float(data["unit"]) * np.cumsum(threads, axis=0)
            metadata = json.loads(str(data["meta"]))
        obstacle = metadata.get("obstacle")
        discs = (Disc((float(obstacle["cx"]), float(obstacle["cy"])), float(obstacle["R"])),) if obstacle else ()
    except FileNotFoundError:
        raise BagError(path, "does not exist; expected a reference trajectory (.npz)") from None
    except MALFORMED as error:
        problem = " ".join(str(error).split())
        raise BagError(path, f"is no reference trajectory with the keys t, pose, X, meta: {problem}") from None
    count, shapes = times.size, (times.shape, poses.shape, threads.shape)
    if count < 2 or shapes != ((count,), (count, 3), (count, *threads.shape[1:2], 2)):
        problem = f"has shapes t {times.shape}, pose {poses.shape}, X {threads.shape}"
        raise BagError(path, f"{problem}; expected t (T,), pose (T, 3), X (T, m, 2)")
    finite = all(np.all(np.isfinite(values)) for values in (times, poses, threads))
    if not (finite and np.all(np.diff(times) > 0.0)):
        raise BagError(path, "has times that do not increase, or values that are not finite")
    name = str(metadata.get("name", path.stem))
    return ReferenceTrajectory(name, times, poses[:, :2], poses[:, 2], threads, discs, metadata)


@dataclass(frozen=True)
class CaseScore:
    """Scores of a formulation on one trajectory.

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
class CaseResult:
    """One evaluated trajectory over time.

    Attributes:
        reference: the trajectory.
        vertices: predicted, shape (T, n + 1, 2) [m].
        score: the figures.
    """

    reference: ReferenceTrajectory
    vertices: NDArray[np.float64]
    score: CaseScore

    @property
    def metrics(self) -> RunMetrics:
        """The trajectory as the metrics of a run, for its picture."""
        segments, stamps = self.vertices.shape[1] - 1, np.rint(1e9 * self.reference.times).astype(np.int64)
        metrics = RunMetrics(float(self.reference.metadata["material"]["L_m"]), int(stamps[0]), ("truth",))
        for stamp, nodes, thread in zip(stamps.tolist(), self.vertices, self.reference.threads, strict=True):
            lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
            strain, discs = float(np.abs(lengths * segments / metrics.length - 1.0).max()), self.reference.discs
            metrics.add(FrameResult(stamp, vertices=nodes, ground_truth=thread, strain=strain, obstacles=discs))
        return metrics


@dataclass(frozen=True)
class Evaluation:
    """The results of a set of trajectories, simulated ones unless their metadata names another source.

    Attributes:
        formulation: its name.
        solver: its name.
        results: one for each trajectory.
    """

    formulation: str
    solver: str
    results: tuple[CaseResult, ...]

    @property
    def cases(self) -> list[CaseScore]:
        """The score of each trajectory."""
        return [result.score for result in self.results]

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


class Simulation(NamedTuple):
    """A thread at the first sample of a trajectory, and what moves it on.

    Attributes:
        initial: the thread, shape (n + 1, 2) [m].
        length: of the thread [m].
        diameter: of the thread [m].
        step: goes to a sample, given by its index; returns the thread, shape (n + 1, 2) [m], the greatest strain of a
            segment, the residual, and the number of fallbacks, see `CaseScore`.
    """

    initial: Points
    length: float
    diameter: float
    step: Callable[[int], tuple[Points, float, float, int]]


def score(
    paths: Sequence[Path], *, formulation: str, solver: str, segments: int | None = None, progress: Progress
) -> Evaluation:
    """Score a formulation on trajectories: each with its own thread and parameters, nothing tuned for a case.

    Args:
        paths: the trajectories.
        formulation: its name.
        solver: its name.
        segments: n, of all cases; without it each case has the paper's.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: a file is no reference trajectory.
        SolverError: a step could not be solved.
    """

    def begin(reference: ReferenceTrajectory, path: Path) -> Simulation:
        thread, paper = reference_thread(reference, path, segments)
        workspace = Workspace(reference.discs, 3e-3)  # m; within this of an obstacle, depths are looked at
        predictor = ThreadPredictor(
            thread, workspace, formulation=formulation, solver=solver, paper=paper, residual_tolerance=1e-6
        )
        predictor.warm_up()
        headings = np.column_stack([np.cos(reference.headings), np.sin(reference.headings)])
        poses = [NeedlePose(*pose) for pose in zip(reference.times, reference.tails, headings, strict=True)]
        initial = resampled(reference.threads[0], thread.segments)
        predictor.start_at(poses[0], initial)

        def step(index: int) -> tuple[Points, float, float, int]:
            prediction = predictor.step(poses[index])
            is_fallback = prediction.status != SOLVED
            return prediction.positions, float(prediction.strain.max()), prediction.residual, int(is_fallback)

        return Simulation(initial, thread.length, thread.diameter, step)

    return Evaluation(formulation, solver, _run_cases(paths, begin, progress))


def score_rig(paths: Sequence[Path], *, segments: int | None = None, progress: Progress) -> Evaluation:
    """Move the rig's needle along reference trajectories and score its thread, nothing tuned for a case.

    Of the scores, `max_residual` is in units of the drag across the whole thread at the case's greatest speed, and
    `fallbacks` counts steps that had to be halved.

    Args:
        paths: the trajectories.
        segments: n, 100 unless given.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: a file is no reference trajectory.
        SolverError: a step could not be solved.
    """
    count = segments or 100
    # Of a needle whose motion is given, the body does not matter.
    body = NeedleBody(length=7e-3, diameter=4e-4, curvature=0.0, magnetisation=0.0, viscosity=1.0)

    def begin(trajectory: ReferenceTrajectory, path: Path) -> Simulation:
        described, _ = reference_thread(trajectory, path, count)
        stretching = trajectory.metadata["material"].get("EA_N")
        if not (isinstance(stretching, (int, float)) and 0.0 < stretching < math.inf):
            raise BagError(path, f"has a thread of the stretching stiffness EA_N {stretching}, expected more than 0 N")
        medium, stiffness = described.medium, (described.bending_stiffness, float(stretching))
        drag, joint = (medium.drag_across, medium.drag_along), NeedleJoint(described.attachment.value)
        thread = ThreadProperties(described.length, count, *stiffness, *drag, joint, described.diameter)
        first, length = trajectory.threads[0], thread.length
        if np.ptp(first, axis=0).max() == 0.0 or np.linalg.norm(first[0] - trajectory.tails[0]) > 0.1 * length / count:
            raise BagError(path, "has a first thread of one point, or one that does not begin at the needle's tail")
        if thread.diameter >= length:
            raise BagError(path, f"has a thread of {thread.diameter:g} m in diameter, expected less than its length")
        surface, heading = Surface(discs=trajectory.discs), float(trajectory.headings[0])
        rig = RigDynamics(body, thread, surface, None, trajectory.tails[0], heading, first)
        speed = np.linalg.norm(np.diff(trajectory.tails, axis=0), axis=1) / np.diff(trajectory.times)
        force = thread.drag_across * length * max(float(speed.max()), 1e-6)

        def step(index: int) -> tuple[Points, float, float, int]:
            interval = trajectory.times[index] - trajectory.times[index - 1]
            rig.drive(trajectory.tails[index], float(trajectory.headings[index]), interval)
            strain = max(0.0, float(rig.tension.max()) / thread.stretching_stiffness)
            return rig.thread, strain, rig.residual / force, rig.halvings

        return Simulation(rig.thread, length, thread.diameter, step)

    return Evaluation("rig", "newton", _run_cases(paths, begin, progress))


def _run_cases(
    paths: Sequence[Path], begin: Callable[[ReferenceTrajectory, Path], Simulation], progress: Progress
) -> tuple[CaseResult, ...]:
    """Step a thread along each trajectory, and score it.

    Args:
        paths: the trajectories.
        begin: returns the thread of one.
        progress: called with the share of all that is done, 0 to 1.

    Source: reference set, "How a prediction is scored". Deviation: none.
    """
    results = []
    for done, path in enumerate(paths):
        reference = read_reference(path)
        thread, count = begin(reference, path), len(reference.times)
        steps, times = [], []
        for k in range(1, count):
            began = time.perf_counter()
            steps.append(thread.step(k))
            times.append(time.perf_counter() - began)
            if k % 50 == 0:
                progress((done + k / count) / len(paths))
        moved, strains, residuals, fallbacks = zip(*steps, strict=True)
        vertices = np.array([thread.initial, *moved])
        # The needle's own way is given, so only the thread's nodes can be blamed.
        nodes, radius = vertices[1:, 1:].reshape(-1, 2), 0.5 * thread.diameter
        gaps = [float(np.hypot(*(nodes - disc.centre).T).min()) - disc.radius - radius for disc in reference.discs]
        truth = np.stack([resampled(curve, len(thread.initial) - 1) for curve in reference.threads])
        error = node_errors(vertices, truth[:, 1:], thread.length).mean(axis=1)
        median, p99 = np.percentile(times, (50, 99)).tolist()
        score = CaseScore(
            name=reference.name,
            mean_error_percent=float(error.mean()),
            max_error_percent=float(error.max()),
            max_stretch=max(strains),
            max_penetration_m=max(0.0, -min(gaps, default=0.0)),
            step_median_s=median,
            step_p99_s=p99,
            max_residual=max(residuals),
            fallbacks=sum(fallbacks),
        )
        results.append(CaseResult(reference, vertices, score))
    return tuple(results)


def reference_thread(
    reference: ReferenceTrajectory, path: Path, segments: int | None = None
) -> tuple[Thread, PaperOptions]:
    """Return the thread that a trajectory's metadata describes, and the options of `paper` for its material.

    Those are of silk where the kind says silk, else of polyamide: W_stiff is tuned for these two only.

    Raises:
        BagError: the metadata lacks something, or holds something that is not valid.
    """
    try:
        material = reference.metadata["material"]
        kind = str(material["kind"])
        thread = Thread(
            material=kind,
            length=float(material["L_m"]),
            segments=segments or int(material["paper_nodes"]),
            diameter=float(material["diameter_m"]),
            bending_stiffness=float(material["EI_Nm2"]),
            medium=Medium(float(material["zeta_perp_Pa_s"]), float(material["zeta_par_Pa_s"])),
            attachment=Attachment(reference.metadata["boundary"]),
        )
    except (*MALFORMED, ConfigurationError) as error:
        raise BagError(path, f"has no thread in its metadata: {type(error).__name__} {error}") from None
    if not thread.bending_stiffness * thread.medium.drag_along > 0.0:
        raise BagError(path, "has a thread whose stiffness or drag are not positive")
    family = "silk_6_0" if "silk" in kind else "polyamide_7_0"
    return thread, PaperOptions.tuned(MATERIALS[family].stiffness_weight)


def resampled(curve: Points, segments: int) -> Points:
    """Return n + 1 points of a curve whose own points are equally spaced in arc length."""
    places, wanted = np.linspace(0.0, 1.0, len(curve)), np.linspace(0.0, 1.0, segments + 1)
    return np.column_stack([np.interp(wanted, places, curve[:, axis]) for axis in range(curve.shape[1])])
