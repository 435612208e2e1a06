"""One recorded run as arrays: needle poses, and the measured thread at the frames that are compared."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import InitialObservation, ThreadSession
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.evaluation.metrics import MIN_KNOWN_SHARE, node_errors, target_points
from magnetosuture_thread.evaluation.workers import Log, Progress, TaskRunner, WorkerDiedError
from magnetosuture_thread.geometry.polyline import Indices, Mask, Points, Vector, arc_lengths
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import BagError, GraphError, InvalidInputError
from magnetosuture_thread.thread.prediction import NeedlePose

SETTLING = 1.0  # s after the start that are not compared: the noise of the first centreline straightens out in it
MAX_FRAMES = 600  # compared, evenly over the run; every pose is replayed
MIN_DURATION = 3.0  # s
MIN_FRAMES = 20  # compared
GAP = 500_000_000  # ns without a needle, after which the thread's way is not known
BLOCKS = 10  # of time, in each of which residuals are taken to be alike
SLOW = 0.15  # of the thread's length, by which some point of it moves


@dataclass(frozen=True)
class RecordedRun:
    """One recorded run, from the frame in which the thread is first measured.

    Where the needle was lost for more than `GAP` a new leg begins, from the thread as it is seen then: nobody knows
    which way the needle went, and what is predicted after it would tell of that and not of the thread.

    Attributes:
        name: of the bag.
        stamps: of the poses, increasing, shape (T,) [ns].
        tails: the needle's tail, shape (T, 2) [m].
        headings: unit vectors from tail to tip, shape (T, 2).
        legs: the first pose of each leg.
        initials: the thread as it was seen at these, each of shape (m, 2) [m]; see `InitialObservation`.
        frames: poses at which the prediction is compared, shape (K,).
        targets: where the thread's nodes 1 ... n were, X(s_i), shape (K, n, 2) [m]; not a number where unknown.
        ground_truths: the same of the ground truth, if the bag holds it; else not a number.
        against: what the targets are, `seen` or `truth`.
        simulated: what of it is simulated; empty if nothing says so.
        scene: that the thread moves in; None if it is not known.
        unverified: why any message of the bag may be wrong; empty if nothing speaks against them.
    """

    name: str
    stamps: Indices
    tails: Points
    headings: Points
    legs: tuple[int, ...]
    initials: tuple[Points, ...]
    frames: Indices
    targets: Points
    ground_truths: Points
    against: str = "seen"
    simulated: str = ""
    scene: Scene | None = None
    unverified: str = ""

    @property
    def known(self) -> Mask:
        """Where the targets are known, shape (K, n)."""
        return np.isfinite(self.targets[..., 0])

    @property
    def times(self) -> Vector:
        """Return the time of each compared frame since the first pose [s], shape (K,)."""
        return np.asarray((self.stamps[self.frames] - self.stamps[0]) * 1e-9)

    @property
    def blocks(self) -> Indices:
        """Which block of time each compared frame is in, 0 to `BLOCKS` - 1, shape (K,)."""
        share = self.times / max(float(self.times[-1]), 1e-9)
        return np.asarray(np.minimum((BLOCKS * share).astype(int), BLOCKS - 1))

    @property
    def speed(self) -> float:
        """Speed of the needle's tail while it moves, the camera's noise averaged out [m/s].

        The upper quartile over steps of half a second, so that a needle that stops now and then counts as it goes.
        """
        parts = ((self.stamps - self.stamps[0]) * 1e-9 / 0.5).astype(int)
        means = np.array([self.tails[parts == part].mean(axis=0) for part in np.unique(parts)])
        steps = np.linalg.norm(np.diff(means, axis=0), axis=1) / 0.5
        return float(np.percentile(steps, 75.0)) if len(steps) else 0.0


def read_run(
    name: str,
    observations: Iterable[Observation],
    settings: ThreadModelSettings,
    against: str = "seen",
    simulated: str = "",
    scene: Scene | None = None,
) -> RecordedRun:
    """Return the observations of one bag as arrays.

    Args:
        name: of the bag, for errors and tables.
        observations: by time; they are gone through once.
        settings: the thread's length and number of nodes.
        against: what the prediction is to be compared with, `seen` or `truth`.
        simulated: what of it is simulated.
        scene: that the thread moves in.

    Raises:
        BagError: there is no needle, no thread, no truth where it is asked for, too little of them, or nothing moves.
        InvalidInputError: time goes back.
    """
    counts: Counter[str] = Counter()
    poses: list[tuple[int, Points, Points]] = []
    legs: list[int] = []
    initials: list[Points] = []
    compared: list[tuple[int, Points, Points]] = []
    length, enough = settings.thread_length, MIN_KNOWN_SHARE * settings.thread_length
    start = InitialObservation()
    for observation in observations:
        if not observation.found:
            continue
        stamp, last = observation.stamp, poses[-1][0] if poses else None
        counts.update(needle=1, seen=len(observation.measured) > 1, truth=len(observation.ground_truth) > 1)
        curves = {"seen": observation.measured, "truth": observation.ground_truth}
        nodes = {which: target_points(curve, length, settings.segments) for which, curve in curves.items()}
        if last is not None and stamp <= last:
            if stamp < last - 1_000_000_000:
                back = (last - stamp) * 1e-9
                raise InvalidInputError(name, f"a time {back:.1f} s before the last", "one run, by time, in each bag")
            continue
        if last is None or stamp > last + GAP:
            # As a thread of the node starts; where it does not from this frame, there is no shape.
            pieces = observation.observation
            initial = observation.measured if pieces is None else start.shape(stamp, pieces)
            if initial is None or len(initial) < 2 or arc_lengths(initial)[-1] < enough:
                continue
            legs.append(len(poses))
            initials.append(initial)
        poses.append((stamp, observation.tail, observation.heading))
        # Before, the noise of the leg's first centreline has not straightened out.
        is_settled = stamp >= poses[legs[-1]][0] + round(SETTLING * 1e9)
        if is_settled and nodes[against][1] >= enough:
            compared.append((len(poses) - 1, nodes[against][0], nodes["truth"][0]))
    legs_and_ends = zip(legs, [*legs[1:], len(poses)], strict=False)  # none without poses
    duration = 1e-9 * sum(poses[end - 1][0] - poses[leg][0] for leg, end in legs_and_ends)
    too_short = f"is too short: {duration:.1f} s with needle and thread, expected at least {MIN_DURATION:g} s"
    known = "measured" if against == "seen" else "known from ground truth"
    few = f"in {len(compared)} frames, the first second left out, is half of the thread or more {known}"
    no_truth = "holds no ground truth (ground_truth/thread), as bags of a robot do; compare against seen"
    for is_there, problem in (
        (not counts["needle"], "shows no needle in any frame; is it another setup's?"),
        (not counts["seen"], "shows no thread in any frame: nothing to start from or to compare with"),
        (not poses, "never shows half of the thread or more: nothing to start from"),
        (against == "truth" and not counts["truth"], no_truth),
        (duration < MIN_DURATION, too_short),
        (len(compared) < MIN_FRAMES, f"is of no use: {few}, expected at least {MIN_FRAMES}"),
    ):
        if is_there:
            raise BagError(name, problem)
    chosen = np.unique(np.linspace(0, len(compared) - 1, min(MAX_FRAMES, len(compared))).round().astype(int))
    stamps, tails, headings = map(np.array, zip(*poses, strict=True))
    frames, targets, truths = map(np.array, zip(*(compared[index] for index in chosen), strict=True))
    thread = tuple(legs), tuple(initials), frames, targets, truths
    run = RecordedRun(name, stamps, tails, headings, *thread, against, simulated, scene)
    moved = _moved(run) / length
    if moved < SLOW:
        why = "nothing moves" if moved < 0.02 else "the needle is too slow"
        words = f"needle and thread move by {moved:.1%} of the thread's length in {duration:.0f} s"
        raise BagError(name, f"{why}: {words}, expected {SLOW:.0%} and more")
    return run


def _moved(run: RecordedRun) -> float:
    """Return the diagonal of the box that the needle or a node moves in [m]; means over a second leave noise out."""
    parts = run.times.astype(int)
    nodes = np.ma.masked_invalid(np.concatenate([run.tails[run.frames][:, None], run.targets], axis=1))
    means = np.array([nodes[parts == part].mean(axis=0).filled(np.nan) for part in np.unique(parts)])
    way = means[:, np.isfinite(means[..., 0]).sum(axis=0) > 1]
    extent = np.nanmax(way, axis=0) - np.nanmin(way, axis=0)
    return float(np.hypot(extent[:, 0], extent[:, 1]).max())


Task = tuple[int, ThreadModelSettings]


def replay_with_parameters(run: RecordedRun, settings: ThreadModelSettings) -> Points:
    """Return the predicted nodes at the compared frames, shape (K, n + 1, 2) [m].

    The very session that the node runs, over all poses, anew in each leg. Where a step fails the thread stays as it
    was; where it cannot even start, or such settings can predict nothing, all is not a number.
    """
    kept = np.full((len(run.frames), settings.segments + 1, 2), np.nan)
    settings = replace(settings, estimator=False)  # what is fitted is the prediction alone
    slots = {int(frame): slot for slot, frame in enumerate(run.frames)}
    try:
        for leg, end, initial in zip(run.legs, [*run.legs[1:], len(run.stamps)], run.initials, strict=True):
            session, last = ThreadSession(settings, run.scene), np.full(kept.shape[1:], np.nan)
            for _ in session.on_measured_thread(int(run.stamps[leg]), initial):
                pass
            for index in range(leg, end):
                stamp = int(run.stamps[index])
                result = session.on_pose(stamp, NeedlePose(stamp * 1e-9, run.tails[index], run.headings[index]))
                if result.prediction is not None:
                    last = result.prediction.positions
                elif index == leg:
                    break
                if index in slots:
                    kept[slots[index]] = last
    except InvalidInputError:
        return np.full_like(kept, np.nan)
    return kept


def replay_task(runs: Sequence[RecordedRun], task: Task, log: Log, progress: Progress) -> Points:
    """Return the predicted nodes of one task, as the work of a `TaskRunner`."""
    index, settings = task
    return replay_with_parameters(runs[index], settings)


def across_residuals(vertices: Points, run: RecordedRun, length: float) -> Vector:
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


def offset_residuals(vertices: Points, run: RecordedRun, length: float) -> Vector:
    """Return how far the nodes are from the thread, in both directions, shape (K, 2 n).

    For the first fits: far from the solution, a prediction that lies across the thread looks good by
    `across_residuals`.
    """
    offset = (vertices[:, 1:] - run.targets) / length
    return np.concatenate([_filled(offset[..., axis], run.known) for axis in (0, 1)], axis=1)


def _filled(values: Vector, known: Mask) -> Vector:
    """Return 0 where the thread is not known, and 1 where it is not predicted."""
    return np.where(known, np.where(np.isfinite(values), values, 1.0), 0.0)


def mean_across(vertices: Points, run: RecordedRun, length: float) -> float:
    """Return the mean of |r_i| of `across_residuals` over all that is known [% of length]."""
    return 100.0 * float(np.abs(across_residuals(vertices, run, length))[run.known].mean())


def mean_error(vertices: Points, targets: Points, length: float) -> float:
    """Return the mean over the frames of the prediction error [% of length], see `evaluation.metrics`.

    A node that is not predicted counts as a length off; not a number if nothing is known.
    """
    errors, known = node_errors(vertices, targets, length), np.isfinite(targets[..., 0])
    frames = np.ma.masked_array(np.where(np.isfinite(errors), errors, 100.0), ~known).mean(axis=1)
    return float(frames.mean()) if known.any() else math.nan


class Replays:
    """Replays recorded runs, remembers the last predictions and the best, and reports the progress of a search.

    Args:
        runs: the recorded runs.
        runner: of tasks, whose work is `replay_task`.
        expected: how many replays the search takes, roughly.
        progress: called with the share of these that is done.
        log: called with a line at the end of each stage.

    Attributes:
        runs: that are replayed.
        best: settings of the least mean prediction error over the runs so far; None before anything is known.
        best_vertices: predicted with them, of each run.
        first_vertices: predicted with the settings that were tried first.
        count: how many runs have been replayed.
    """

    def __init__(
        self, runs: Sequence[RecordedRun], runner: TaskRunner, expected: int, progress: Progress, log: Log
    ) -> None:
        self.runs, self.count = tuple(runs), 0
        self.best: ThreadModelSettings | None = None
        self.best_vertices: list[Points] = []
        self.first_vertices: list[Points] = []
        self._runner, self._expected, self._progress, self._log = runner, expected, progress, log
        self._known: dict[Task, Points] = {}
        self._errors: dict[ThreadModelSettings, float] = {}

    def of(self, many: Sequence[ThreadModelSettings], which: Sequence[int] | None = None) -> list[list[Points]]:
        """Return the predicted nodes of each of some settings on some of the runs; all of them if None."""
        chosen = range(len(self.runs)) if which is None else which
        tasks = dict.fromkeys((index, settings) for settings in many for index in chosen)
        missing = [task for task in tasks if task not in self._known]
        for index, vertices in self._runner.run(missing):
            if isinstance(vertices, WorkerDiedError):
                raise GraphError("a process that replayed a bag died; is there enough memory for --workers?")
            self._known[missing[index]] = vertices
        result = [[self._known[index, settings] for index in chosen] for settings in many]
        # Of the last 16 settings: a Jacobian asks again for its middle.
        for task in list(self._known)[: -16 * len(self.runs)]:
            del self._known[task]
        self.count += len(missing)
        if len(chosen) == len(self.runs):
            for settings, of_runs in zip(many, result, strict=True):
                self._keep_best(settings, of_runs)
        self._progress(min(0.99, self.count / self._expected))
        return result

    def _keep_best(self, settings: ThreadModelSettings, vertices: list[Points]) -> None:
        if settings not in self._errors:
            pairs = zip(vertices, self.runs, strict=True)
            errors = [mean_error(v, run.targets, settings.thread_length) for v, run in pairs]
            self._errors[settings] = float(np.mean(errors))
        self.first_vertices = self.first_vertices or vertices
        if self.best is None or self._errors[settings] < self._errors[self.best]:
            self.best, self.best_vertices = settings, vertices

    def error(self, settings: ThreadModelSettings) -> float:
        """Return the mean over the runs of the prediction error [% of length]."""
        if settings not in self._errors:
            self.of([settings])
        return self._errors[settings]

    def report(self, result: str) -> None:
        """Log what a stage of the search came to."""
        error = min(self._errors.values())
        self._log(f"{result}; least distance of the nodes {error:.3g} % of the length after {self.count} replays")
