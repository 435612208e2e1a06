"""Replays of recorded runs with given settings, the residuals of their predictions, and the progress of a search."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.calibration.recorded_run import RecordedRun
from magnetosuture_thread.errors import GraphError, InvalidInputError
from magnetosuture_thread.evaluation.metrics import mean_over_nodes, node_errors
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread_model.session import ThreadSession
from magnetosuture_thread.thread_model.settings import ThreadModelSettings
from magnetosuture_thread.workers import WorkerDiedError, make_runner

REMEMBERED = 16  # settings, with all that they predict; a Jacobian asks again for its middle
SHARES = {"starts": 0.2, "fit": 0.4, "identified": 0.15, "held out": 0.25}  # of the time, by stage

Task = tuple[int, ThreadModelSettings]
RunTasks = Callable[[Sequence[Task]], list[Points]]
Array = NDArray[np.float64]


def replay_with_parameters(run: RecordedRun, settings: ThreadModelSettings) -> Points:
    """Return the predicted nodes at the compared frames, shape (K, n + 1, 2) [m].

    The very session that the node runs, over all poses, anew in each leg. Where a step fails the thread stays as it
    was; where it cannot even start, or such settings can predict nothing, all is not a number.
    """
    nothing = np.full((settings.segments + 1, 2), np.nan)
    kept = np.repeat(nothing[None], len(run.frames), axis=0)
    settings = replace(settings, estimator=False)  # what is fitted is the prediction alone
    slots = {int(frame): slot for slot, frame in enumerate(run.frames)}
    stamps = run.stamps.tolist()
    try:
        for leg, end, initial in zip(run.legs, [*run.legs[1:], len(stamps)], run.initials, strict=True):
            session, last = ThreadSession(settings, run.scene), nothing
            for _ in session.on_measured_thread(stamps[leg], initial):
                pass
            for index in range(leg, end):
                pose = NeedlePose(stamps[index] * 1e-9, run.tails[index], run.headings[index])
                outcome = session.on_pose(stamps[index], pose)
                if outcome.prediction is not None:
                    last = outcome.prediction.positions
                elif index == leg:
                    break
                if index in slots:
                    kept[slots[index]] = last
    except InvalidInputError:
        return np.full_like(kept, np.nan)
    return kept


@contextmanager
def replay_pool(runs: Sequence[RecordedRun], workers: int, scheduler: str = "") -> Iterator[RunTasks]:
    """Give a function that runs tasks, here or in processes of their own; see `make_runner`.

    Args:
        runs: that tasks name by their index.
        workers: number of processes; with one, no other process is started.
        scheduler: address of a Dask scheduler, whose workers replay in place of those; empty for none.

    Raises:
        GraphError: a process died.
    """
    with make_runner(partial(_run_task, tuple(runs)), workers, scheduler) as runner:

        def run(tasks: Sequence[Task]) -> list[Points]:
            results = dict(runner.run(tasks))
            if any(isinstance(result, WorkerDiedError) for result in results.values()):
                raise GraphError("a process that replayed a bag died; is there enough memory for --workers?")
            return [results[index] for index in range(len(tasks))]

        yield run


def _run_task(
    runs: Sequence[RecordedRun], task: Task, log: Callable[[str], None], progress: Callable[[float], None]
) -> Points:
    index, settings = task
    return replay_with_parameters(runs[index], settings)


def across_residuals(vertices: Points, run: RecordedRun, length: float) -> Array:
    """Return how far the nodes are from the thread, measured across the prediction.

        r_i = n_i . (x_i - X(s_i)) / L,    n_i across x_{i+1} - x_{i-1}

    Along the thread nothing is compared: it cannot stretch, so all that moves along it is the arc length's
    scale, which a noisy centreline inflates (30 um on points 0.4 mm apart by 0.6 %) and which would bias the fit.

    Args:
        vertices: predicted, shape (K, n + 1, 2) [m]; not a number where there is no prediction.
        run: the thread.
        length: L [m].

    Returns:
        Shape (K, n); 0 where the thread is not known, 1 where it is not predicted.
    """
    last = len(run.targets[0])
    along = vertices[:, np.minimum(np.arange(1, last + 1) + 1, last)] - vertices[:, :-1]
    offset = vertices[:, 1:] - run.targets
    size = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-12)
    crossed = along[..., 0] * offset[..., 1] - along[..., 1] * offset[..., 0]
    return _filled(crossed / (size * length), run.known)


def offset_residuals(vertices: Points, run: RecordedRun, length: float) -> Array:
    """Return how far the nodes are from the thread, in both directions, shape (K, 2 n).

    For the first fits: far from the solution, a prediction that lies across the thread looks good by
    `across_residuals`.
    """
    offset = (vertices[:, 1:] - run.targets) / length
    return np.concatenate([_filled(offset[..., axis], run.known) for axis in (0, 1)], axis=1)


def _filled(values: Array, known: NDArray[np.bool_]) -> Array:
    """Return 0 where the thread is not known, and 1 where it is not predicted."""
    return np.where(known, np.where(np.isfinite(values), values, 1.0), 0.0)


def mean_across(vertices: Points, run: RecordedRun, length: float) -> float:
    """Return the mean of |r_i| of `across_residuals` over all that is known [% of length]."""
    return 100.0 * float(np.abs(across_residuals(vertices, run, length))[run.known].mean())


def mean_error(vertices: Points, targets: Points, length: float) -> float:
    """Return the mean over the frames of the prediction error [% of length], see `evaluation.metrics`.

    A node that is not predicted counts as a length off; not a number if nothing is known.
    """
    found = node_errors(vertices, targets, length)
    frames = mean_over_nodes(np.where(np.isfinite(found), found, 100.0), np.isfinite(targets[..., 0]))
    return float(np.nanmean(frames)) if np.isfinite(frames).any() else math.nan


@dataclass
class BestSettings:
    """The best settings that a search has found so far.

    Attributes:
        settings: of it; None before anything is known.
        error: mean over the runs of the prediction error [% of length].
        vertices: predicted with them, of each run.
        first: predicted with the settings that were tried first.
        replays: how many runs have been replayed.
    """

    settings: ThreadModelSettings | None = None
    error: float = math.inf
    vertices: list[Points] = field(default_factory=list)
    first: list[Points] = field(default_factory=list)
    replays: int = 0


class Replays:
    """Replays recorded runs, remembers the last predictions, and reports the progress of a search.

    Args:
        runs: the recorded runs.
        run_tasks: gives the predicted nodes of tasks, in their order; here, one after the other, if None.
        best: is updated with every whole set of replays.
        progress: called with the share done, which never falls.
        log: called with a line at the end of each stage.
    """

    def __init__(
        self,
        runs: Sequence[RecordedRun],
        run_tasks: RunTasks | None = None,
        best: BestSettings | None = None,
        progress: Callable[[float], None] = lambda share: None,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.runs, self.best = tuple(runs), best or BestSettings()
        self._run_tasks = run_tasks or self._run_here
        self._progress, self._log = progress, log
        self._begin = self._width = 0.0
        self._done, self._expected = 0, 1
        self._known: dict[Task, Points] = {}
        self._errors: dict[ThreadModelSettings, float] = {}

    def of(self, many: Sequence[ThreadModelSettings], which: Sequence[int] | None = None) -> list[list[Points]]:
        """Return the predicted nodes of each of some settings on some of the runs; all of them if None."""
        chosen = range(len(self.runs)) if which is None else which
        tasks = dict.fromkeys((index, settings) for settings in many for index in chosen)
        missing = [task for task in tasks if task not in self._known]
        if missing:
            self._known.update(zip(missing, self._run_tasks(missing), strict=True))
        result = [[self._known[index, settings] for index in chosen] for settings in many]
        for task in list(self._known)[: -REMEMBERED * len(self.runs)]:
            del self._known[task]
        self.best.replays += len(missing)
        if len(chosen) == len(self.runs):
            for settings, vertices in zip(many, result, strict=True):
                self._keep_best(settings, vertices)
        self._done += len(missing)
        self._progress(self._begin + self._width * self._done / (self._done + self._expected))
        return result

    def _keep_best(self, settings: ThreadModelSettings, vertices: list[Points]) -> None:
        pairs, best = zip(vertices, self.runs, strict=True), self.best
        if settings not in self._errors:
            errors = [mean_error(v, run.targets, settings.thread_length) for v, run in pairs]
            self._errors[settings] = float(np.mean(errors))
        best.first = best.first or vertices
        if self._errors[settings] < best.error:
            best.settings, best.error, best.vertices = settings, self._errors[settings], vertices

    def error(self, settings: ThreadModelSettings) -> float:
        """Return the mean over the runs of the prediction error [% of length]."""
        if settings not in self._errors:
            self.of([settings])
        return self._errors[settings]

    def begin_stage(self, stage: str, replays: int) -> None:
        """Begin a stage of the search that takes about so many replays."""
        self._begin += self._width
        self._width, self._done, self._expected = SHARES[stage], 0, max(1, replays)
        self._progress(self._begin)

    def end_stage(self, result: str) -> None:
        """Log what a stage came to."""
        error, replays = self.best.error, self.best.replays
        self._log(f"{result}; least distance of the nodes {error:.3g} % of the length after {replays} replays")

    def _run_here(self, tasks: Sequence[Task]) -> list[Points]:
        return [replay_with_parameters(self.runs[index], settings) for index, settings in tasks]
