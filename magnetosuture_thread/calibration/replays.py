"""Replays of passages with given settings, and how far the predictions are from the threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.calibration.passage import Passage
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.evaluation.metrics import error_figures, mean_over_nodes, node_errors
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.predictor import NeedlePose
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings

REMEMBERED = 16  # settings, with all that they predict; a Jacobian asks again for its middle

Task = tuple[int, ThreadModelSettings]
Run = Callable[[Sequence[Task]], list[Points]]
Array = NDArray[np.float64]


def replay_with_parameters(passage: Passage, settings: ThreadModelSettings) -> Points:
    """Return the predicted nodes at the compared frames, shape (K, n + 1, 2) [m].

    The very session that the node runs, over all poses, anew in each leg. Where a step fails the thread stays as it
    was; where it cannot even start, all is not a number.
    """
    nothing = np.full((settings.segments + 1, 2), np.nan)
    kept = np.repeat(nothing[None], len(passage.frames), axis=0)
    slots = {int(frame): slot for slot, frame in enumerate(passage.frames)}
    stamps = passage.stamps.tolist()
    for leg, end, initial in zip(passage.legs, [*passage.legs[1:], len(stamps)], passage.initials, strict=True):
        session, last = ThreadSession(settings, passage.scene), nothing
        for _ in session.on_measured_thread(stamps[leg], initial):
            pass
        for index in range(leg, end):
            pose = NeedlePose(stamps[index] * 1e-9, passage.tails[index], passage.headings[index])
            outcome = session.on_pose(stamps[index], pose)
            if outcome.prediction is not None:
                last = outcome.prediction.positions
            elif index == leg:
                break
            if index in slots:
                kept[slots[index]] = last
    return kept


def across(vertices: Points, passage: Passage, length: float) -> Array:
    """Return how far the nodes are from the thread, measured across the prediction.

        r_i = n_i . (x_i - X(s_i)) / L,    n_i across x_{i+1} - x_{i-1}

    Along the thread nothing is compared: it cannot stretch, so all that moves along it is the arc length's
    scale, which a noisy centreline inflates (30 um on points 0.4 mm apart by 0.6 %) and which would bias the fit.

    Args:
        vertices: predicted, shape (K, n + 1, 2) [m]; not a number where there is no prediction.
        passage: the thread.
        length: L [m].

    Returns:
        Shape (K, n); 0 where the thread is not known, 1 where it is not predicted.
    """
    along = np.empty_like(vertices)
    along[:, 1:-1] = vertices[:, 2:] - vertices[:, :-2]
    along[:, 0], along[:, -1] = vertices[:, 1] - vertices[:, 0], vertices[:, -1] - vertices[:, -2]
    size = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-12)
    offset = vertices[:, 1:] - passage.targets
    crossed = along[:, 1:, 0] * offset[..., 1] - along[:, 1:, 1] * offset[..., 0]
    return _filled(crossed / (size[:, 1:] * length), passage.known)


def apart(vertices: Points, passage: Passage, length: float) -> Array:
    """Return how far the nodes are from the thread, in both directions, shape (K, 2 n).

    For the first fits: far from the solution, a prediction that lies across the thread looks good from `across`.
    """
    offset = (vertices[:, 1:] - passage.targets) / length
    return np.concatenate([_filled(offset[..., axis], passage.known) for axis in (0, 1)], axis=1)


def _filled(values: Array, known: NDArray[np.bool_]) -> Array:
    """Return 0 where the thread is not known, and 1 where it is not predicted."""
    return np.where(known, np.where(np.isfinite(values), values, 1.0), 0.0)


def mean_across(vertices: Points, passage: Passage, length: float) -> float:
    """Return the mean of |r_i| of `across` over all that is known [% of length]."""
    return 100.0 * float(np.abs(across(vertices, passage, length))[passage.known].mean())


def frame_errors(vertices: Points, targets: Points, length: float) -> Array:
    """Return the prediction error of each frame, shape (K,) [% of length]; see `evaluation.metrics`.

    Not a number where nothing is known; a node that is not predicted counts as a length off.
    """
    found = node_errors(vertices, targets, length)
    return mean_over_nodes(np.where(np.isfinite(found), found, 100.0), np.isfinite(targets[..., 0]))


def mean_error(vertices: Points, targets: Points, length: float) -> float:
    """Return the mean over the frames of the prediction error [% of length]; not a number if nothing is known."""
    figures = error_figures(frame_errors(vertices, targets, length))
    return figures["mean"] if figures is not None else float("nan")


@dataclass
class Best:
    """The best that a search has come to, told at every moment.

    Attributes:
        settings: of it; None before anything is known.
        error: mean over the passages of the prediction error [% of length].
        vertices: predicted with them, of each passage.
        first: predicted with the settings that were tried first.
        replays: how many passages have been replayed.
    """

    settings: ThreadModelSettings | None = None
    error: float = float("inf")
    vertices: list[Points] = field(default_factory=list)
    first: list[Points] = field(default_factory=list)
    replays: int = 0

    def offer(self, settings: ThreadModelSettings, error: float, vertices: list[Points]) -> None:
        """Keep the better one."""
        self.first = self.first or vertices
        if error < self.error:
            self.settings, self.error, self.vertices = settings, error, vertices


class Replays:
    """Replays all passages, by whatever runs the tasks, and remembers the last ones.

    Args:
        passages: the runs.
        run: gives the predicted nodes of tasks, in their order.
        best: is told of every whole set of replays.
    """

    def __init__(self, passages: Sequence[Passage], run: Run | None = None, best: Best | None = None) -> None:
        self.passages = tuple(passages)
        self.best = best or Best()
        self._run = run or self._here
        self._known: dict[Task, Points] = {}
        self._errors: dict[ThreadModelSettings, float] = {}
        self._told: Callable[[int], None] = lambda count: None

    def tell(self, told: Callable[[int], None]) -> None:
        """Call something after each batch of replays, with their number."""
        self._told = told

    def of(self, many: Sequence[ThreadModelSettings], which: Sequence[int] | None = None) -> list[list[Points]]:
        """Return the predicted nodes of each of some settings on some of the passages; all of them if None."""
        chosen = range(len(self.passages)) if which is None else which
        tasks = list(dict.fromkeys((index, settings) for settings in many for index in chosen))
        missing = [task for task in tasks if task not in self._known]
        found = dict(zip(missing, self._run(missing), strict=True)) if missing else {}
        self._known |= found
        result = [[self._known[index, settings] for index in chosen] for settings in many]
        for task in list(self._known)[: max(0, len(self._known) - REMEMBERED * len(self.passages))]:
            del self._known[task]
        self.best.replays += len(missing)
        if len(chosen) == len(self.passages):
            for settings, vertices in zip(many, result, strict=True):
                if settings not in self._errors:
                    pairs = zip(vertices, self.passages, strict=True)
                    means = [mean_error(v, passage.targets, settings.thread_length) for v, passage in pairs]
                    self._errors[settings] = float(np.mean(means))
                    self.best.offer(settings, self._errors[settings], vertices)
        self._told(len(missing))
        return result

    def error(self, settings: ThreadModelSettings) -> float:
        """Return the mean over the passages of the prediction error [% of length]."""
        if settings not in self._errors:
            self.of([settings])
        return self._errors[settings]

    def _here(self, tasks: Sequence[Task]) -> list[Points]:
        return [attempt(self.passages[index], settings) for index, settings in tasks]


def attempt(passage: Passage, settings: ThreadModelSettings) -> Points:
    """Return `replay`, or nothing but not a number where such settings can predict nothing."""
    try:
        return replay_with_parameters(passage, settings)
    except InvalidInputError:
        return np.full((len(passage.frames), settings.segments + 1, 2), np.nan)
