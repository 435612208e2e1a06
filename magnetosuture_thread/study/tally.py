"""Keeps the figures of a run as it goes on, and one instant in full: the one that was predicted worst."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.study.replayed import KINDS, SOLID, Instant, LeastMargin
from magnetosuture_thread.study.score import LEAST_SEEN
from magnetosuture_thread.study.sight import Sight

AT_ONCE = 128  # predictions that are scored together
ROUNDING = 1e-9  # of a length, by which a node may be past its end
_SOLID = [KINDS.index(kind) for kind in SOLID]
_NOTHING, _NONE = np.empty((0, 2)), np.empty(0)


def errors_percent(
    vertices: NDArray[np.float64], curves: Sequence[Points], length: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the errors of many predictions, each against its own curve, as `prediction_error_percent` does of one.

    All curves are laid one behind the other, so that one interpolation serves them all.

    Args:
        vertices: predicted nodes of each, shape (b, n + 1, 2) [m].
        curves: where each thread was, shape (m, 2) [m]; m may differ, and be 0.
        length: of the thread, L [m].

    Returns:
        The errors [% of L], shape (b,), nan where less than half of a thread is known; and the curves' lengths [m].
    """
    counts = np.array([len(curve) for curve in curves])
    errors, lengths = np.full(len(curves), np.nan), np.zeros(len(curves))
    there = np.flatnonzero(counts > 1)
    if not len(there):
        return errors, lengths
    points = np.concatenate([curve for curve in curves if len(curve) > 1])
    last = np.cumsum(counts[there]) - 1
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    steps[last[:-1]] = length  # a gap between one curve and the next
    along = np.concatenate([[0.0], np.cumsum(steps)])
    begins = along[last - counts[there] + 1]
    lengths[there] = along[last] - begins
    at = length * np.arange(1, vertices.shape[1]) / (vertices.shape[1] - 1)
    within = at <= lengths[there, None] * (1.0 + ROUNDING)
    wanted = np.minimum(begins[:, None] + at, along[last][:, None])
    off = [np.interp(wanted, along, points[:, axis]) - vertices[there, 1:, axis] for axis in (0, 1)]
    known = within.sum(axis=1)
    mean = np.where(within, np.hypot(*off), 0.0).sum(axis=1) / np.maximum(known, 1)
    scored = (known > 0) & (lengths[there] >= LEAST_SEEN * length)
    errors[there] = np.where(scored, 100.0 / length * mean, np.nan)
    return errors, lengths


def instant_of(sight: Sight, prediction: Prediction, margins: Margins | None, step_time: float) -> Instant:
    """Return a prediction beside what was seen and what is true, not scored yet; see `Tally.take`."""
    instant = _without_clearance(sight, prediction, margins, step_time)
    instant.clearance = _clearance(instant, margins)
    return instant


def _without_clearance(sight: Sight, prediction: Prediction, margins: Margins | None, step_time: float) -> Instant:
    return Instant(
        sight.stamp,
        vertices=prediction.vertices,
        stretch=float(np.maximum.reduce(np.abs(prediction.stretch), initial=0.0)),
        residual=prediction.residual,
        step_time=step_time,
        clearance=_NONE,
        least={} if margins is None else {KINDS[least.kind]: least.clearance for least in margins.least},
        seen=sight.seen,
        truth=sight.truth,
        tail=sight.tail,
        heading=math.atan2(sight.heading[1], sight.heading[0]),
    )


def _clearance(instant: Instant, margins: Margins | None) -> NDArray[np.float64]:
    """Return the least clearance of an obstacle or the wall for each node, inf where none; empty if none is near."""
    if margins is None or not any(kind in instant.least for kind in SOLID):
        return _NONE
    near = np.isin(margins.kind, _SOLID)
    clearance = np.full(len(instant.vertices), np.inf)
    np.minimum.at(clearance, margins.node[near], margins.clearance[near])
    return clearance


class Tally:
    """The figures of all predictions of a run; of each only numbers are kept, so that a run may be long.

    Args:
        length: of the thread [m].

    Attributes:
        contact_frames: those in which the thread touches an obstacle or the wall.
    """

    def __init__(self, length: float) -> None:
        self._length = length
        self._least: dict[int, tuple[float, int, int, int]] = {}
        self._fresh: list[tuple[Instant, Margins | None]] = []
        self._done: list[Instant] = []
        self._worst: Instant | None = None
        self._badness = -math.inf
        self.contact_frames = 0

    def take(self, sight: Sight, prediction: Prediction, margins: Margins | None, step_time: float) -> None:
        """Take a prediction of a sight.

        Args:
            sight: what was seen.
            prediction: of it.
            margins: of the prediction, if they prove anything.
            step_time: that the prediction took [s].
        """
        if margins is not None:
            for least in margins.least:
                if least.clearance < self._least.get(least.kind, (np.inf,))[0]:
                    self._least[least.kind] = (least.clearance, least.node, least.obstacle, sight.stamp)
            self.contact_frames += bool(margins.touching)
        self._fresh.append((_without_clearance(sight, prediction, margins, step_time), margins))
        if len(self._fresh) >= AT_ONCE:
            self._score()

    @property
    def instants(self) -> list[Instant]:
        """Return all predictions, by time, without threads."""
        self._score()
        return self._done

    @property
    def worst(self) -> Instant | None:
        """Return the prediction farthest from what was seen, in full; where nothing was seen, from the truth."""
        self._score()
        return self._worst

    def least_margins(self, start: int) -> list[LeastMargin]:
        """Return the least margin of each kind; times count from `start` [ns]."""
        return [
            LeastMargin(KINDS[kind], clearance, node, obstacle, (stamp - start) * 1e-9)
            for kind, (clearance, node, obstacle, stamp) in sorted(self._least.items())
        ]

    def _score(self) -> None:
        """Score what has come, and keep of it only numbers."""
        fresh, self._fresh = self._fresh, []
        if not fresh:
            return
        instants = [instant for instant, _ in fresh]
        vertices = np.stack([instant.vertices for instant in instants])
        by_seen, lengths = errors_percent(vertices, [instant.seen for instant in instants], self._length)
        by_truth, _ = errors_percent(vertices, [instant.truth for instant in instants], self._length)
        shares = np.minimum(1.0, lengths / self._length)
        # The error that counts; less than any where there is none.
        badness = np.where(np.isfinite(by_seen), by_seen, np.where(np.isfinite(by_truth), by_truth, -1.0))
        for instant, seen, truth, share in zip(
            instants, by_seen.tolist(), by_truth.tolist(), shares.tolist(), strict=True
        ):
            instant.error_seen, instant.error_truth, instant.seen_share = seen, truth, share
        at = int(badness.argmax())
        if badness[at] > self._badness:
            worst, margins = fresh[at]
            self._worst, self._badness = replace(worst, clearance=_clearance(worst, margins)), badness[at]
        for instant in instants:
            instant.vertices = instant.seen = instant.truth = _NOTHING
            instant.tail = _NONE
        self._done += instants
