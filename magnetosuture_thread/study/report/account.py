"""What is kept of a bag while it is evaluated: columns, worst moments and the map along the thread; no threads."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from magnetosuture_thread.geometry.obstacles import Obstacle
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.study.replayed import KINDS, LeastMargin, Spread, error_figures
from magnetosuture_thread.study.report.along import AlongThread, node_errors
from magnetosuture_thread.study.report.figures import Figures, LiveFigures
from magnetosuture_thread.study.report.moments import Moment, WorstMoments
from magnetosuture_thread.study.report.timeline import Timeline
from magnetosuture_thread.study.score import prediction_error_percent
from magnetosuture_thread.study.sight import Sight
from magnetosuture_thread.study.tally import instant_of

TARGETS = ("truth", "seen")  # what a prediction is held against, the better one first
MOST_REASONS = 12  # kept, why the needle was not found


class Account:
    """Takes a bag's sights and predictions as they come, and gives the figures.

    Args:
        length: of the thread [m].
        start: time that is 0 in the report [ns].
        targets: what the predictions are held against, of `truth` and `seen`.
        recorded: whether the predictions that the bag itself holds are judged too.

    Attributes:
        targets: as given.
        predicted: columns of the frames with a prediction.
        looked: column `processing` of all frames [s].
        lost: from and to when the needle was not found [s].
        reasons: why not.
    """

    def __init__(self, length: float, start: int, targets: Sequence[str] = TARGETS, recorded: bool = False) -> None:
        self.targets = tuple(target for target in TARGETS if target in targets)
        errors = [f"error_{target}" for target in self.targets]
        of_bag = [f"recorded_{name}" for name in errors] if recorded else []
        margins = [f"margin_{kind}" for kind in KINDS]
        self.predicted = Timeline([*errors, *of_bag, *margins, "stretch", "step_time"])
        self.looked = Timeline(["processing"])
        self.lost: list[list[float]] = []
        self.reasons: Counter[str] = Counter()
        self._length, self._start = length, start
        self._tracked = self._contact = 0
        self._residual, self._seen_share = 0.0, 0.0
        self._least: dict[str, LeastMargin] = {}
        self._along = {target: AlongThread(length) for target in self.targets}
        self._worst = {target: WorstMoments() for target in self.targets}
        self._found = True

    def look(self, sight: Sight) -> None:
        """Take what one frame, or one recorded pose, says."""
        time = self._time(sight.stamp)
        self.looked.add(time, {"processing": sight.processing})
        self._tracked += sight.found
        if sight.found:
            self._found = True
            return
        self.reasons[self._reason(sight.reason)] += 1
        if self._found:
            self.lost.append([time, time])
        self.lost[-1][1] = time
        self._found = False

    def _reason(self, reason: str) -> str:
        known = reason in self.reasons or len(self.reasons) < MOST_REASONS
        return (reason or "not said") if known else "others"

    def predict(
        self,
        sight: Sight,
        prediction: Prediction,
        margins: Margins | None,
        step_time: float,
        recorded: Points | None = None,
        obstacles: tuple[Obstacle, ...] = (),
    ) -> None:
        """Take what was predicted for one frame.

        Args:
            sight: what was seen.
            prediction: of it.
            margins: of the prediction, if they prove anything.
            step_time: that the prediction took [s].
            recorded: the prediction of the same frame that the bag holds, shape (n + 1, 2) [m].
            obstacles: in force.
        """
        time = self._time(sight.stamp)
        instant = instant_of(sight, prediction, margins, step_time)
        row = {"stretch": instant.stretch, "step_time": step_time}
        for target in self.targets:
            curve = sight.truth if target == "truth" else sight.seen
            if len(curve) < 2:
                continue
            row[f"error_{target}"] = error = prediction_error_percent(instant.vertices, curve, self._length)
            if recorded is not None:
                row[f"recorded_error_{target}"] = prediction_error_percent(recorded, curve, self._length)
            if math.isfinite(error):
                self._along[target].add(time, node_errors(instant.vertices, curve, self._length))
                self._worst[target].add(time, error, instant, obstacles)
        row |= {f"margin_{kind}": clearance for kind, clearance in instant.least.items()}
        self.predicted.add(time, row)
        self._residual = max(self._residual, prediction.residual)
        if len(sight.seen) > 1:
            self._seen_share += min(1.0, float(arc_lengths(sight.seen)[-1]) / self._length)
        for least in margins.least if margins is not None else ():
            kind = KINDS[least.kind]
            if kind not in self._least or least.clearance < self._least[kind].clearance:
                self._least[kind] = LeastMargin(kind, least.clearance, least.node, least.obstacle, time)
        self._contact += margins is not None and bool(margins.touching)

    @property
    def target(self) -> str:
        """Return what the worst moments and the map are held against: the truth where there is any."""
        there = [target for target in self.targets if self.predicted.has(f"error_{target}")]
        return there[0] if there else ""

    def moments(self) -> list[Moment]:
        """Return the worst moments, the worst first."""
        return self._worst[self.target].found() if self.target else []

    def along(self) -> AlongThread | None:
        """Return the map of the error along the thread."""
        return self._along.get(self.target)

    def figures(self, live: LiveFigures | None = None) -> Figures:
        """Return the figures.

        Args:
            live: what the recording itself says of the graph.
        """
        table = self.predicted
        errors = {target: table.column(f"error_{target}") for target in self.targets}
        of_bag = {
            target: error_figures(table.column(f"recorded_error_{target}").tolist())
            for target in self.targets
            if f"recorded_error_{target}" in table.names
        }
        stretch = table.column("stretch")
        return Figures(
            frames=len(self.looked),
            tracked=self._tracked,
            predicted=len(table),
            error={target: error_figures(values.tolist()) for target, values in errors.items()},
            recorded_error=of_bag,
            target=self.target,
            seen_share=self._seen_share / len(table) if len(table) else math.nan,
            stretch=float(np.nanmax(stretch)) if np.isfinite(stretch).any() else math.nan,
            residual=self._residual if len(table) else math.nan,
            least={kind: self._least[kind] for kind in KINDS if kind in self._least},
            contact_frames=self._contact,
            step_time=Spread.of(table.column("step_time").tolist()),
            processing=Spread.of(self.looked.column("processing").tolist()),
            interval=self._interval(),
            live=live or LiveFigures(),
        )

    def _interval(self) -> float:
        steps = np.diff(self.looked.times)
        return float(np.median(steps)) if len(steps) else math.nan

    def _time(self, stamp: int) -> float:
        return (stamp - self._start) * 1e-9
