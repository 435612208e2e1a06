"""One frame: what was observed of needle and thread, and what was predicted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles import Obstacle
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.margins import Margins, node_clearance
from magnetosuture_thread.model.predictor import Prediction


def _none() -> Points:
    return np.empty((0, 2))


@dataclass(frozen=True)
class Observation:
    """What one camera frame, or one recorded pose, says.

    Attributes:
        stamp: of the frame [ns].
        tail: the needle's tail, shape (2,) [m]; shape (0,) where the needle was not found.
        heading: unit vector from tail to tip, shape (2,); shape (0,) where the needle was not found.
        seen: the thread's measured centreline, from the tail on, shape (m, 2) [m]; m = 0 for none.
        truth: the thread's ground truth, if the bag holds it, shape (m, 2) [m].
        reason: why the needle was not found.
        processing: time that the tracker took for the frame [s]; nan where the poses were recorded.
    """

    stamp: int
    tail: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    heading: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    seen: Points = field(default_factory=_none)
    truth: Points = field(default_factory=_none)
    reason: str = ""
    processing: float = float("nan")

    @property
    def found(self) -> bool:
        """Whether the needle was found."""
        return len(self.tail) > 0


@dataclass
class FrameResult:
    """What was predicted of one frame, beside what was measured and the ground truth.

    Attributes:
        stamp: of the frame [ns].
        vertices: predicted thread, shape (n + 1, 2) [m].
        strain: greatest absolute strain of a segment.
        residual: of the solves.
        step_time: of the model [s].
        margins: None if they prove nothing.
        in_contact: whether the thread touches an obstacle or the wall.
        seen: the thread's measured centreline, shape (m, 2) [m].
        truth: its ground truth, if the bag holds it, shape (m, 2) [m].
        tail: the needle's measured tail, shape (2,) [m].
        heading: the needle's measured angle [rad].
        obstacles: in force.
        recorded: the prediction that the bag holds of the same frame, shape (n + 1, 2) [m].
        seen_share: part of the thread's length that was measured.
        error_seen: prediction error against the measured centreline [% of length].
        error_truth: the same against the ground truth.
    """

    stamp: int
    vertices: Points = field(default_factory=_none)
    strain: float = math.nan
    residual: float = math.nan
    step_time: float = math.nan
    margins: Margins | None = None
    in_contact: bool = False
    seen: Points = field(default_factory=_none)
    truth: Points = field(default_factory=_none)
    tail: Points = field(default_factory=lambda: np.empty(0))
    heading: float = math.nan
    obstacles: tuple[Obstacle, ...] = ()
    recorded: Points | None = None
    seen_share: float = 0.0
    error_seen: float = math.nan
    error_truth: float = math.nan

    @classmethod
    def of(
        cls,
        observation: Observation,
        prediction: Prediction,
        margins: Margins | None,
        step_time: float,
        *,
        recorded: Points | None = None,
        obstacles: tuple[Obstacle, ...] = (),
    ) -> FrameResult:
        """Return a prediction beside the observation that it is of.

        Args:
            observation: with a needle.
            prediction: of it.
            margins: of the prediction, if they prove anything.
            step_time: that the prediction took [s].
            recorded: the prediction of the same frame that the bag holds.
            obstacles: in force.
        """
        return cls(
            observation.stamp,
            prediction.positions,
            float(np.maximum.reduce(np.abs(prediction.strain), initial=0.0)),
            prediction.residual,
            step_time,
            margins,
            margins is not None and bool(margins.in_contact),
            observation.seen,
            observation.truth,
            observation.tail,
            math.atan2(observation.heading[1], observation.heading[0]),
            obstacles,
            recorded,
        )

    @property
    def clearance(self) -> NDArray[np.float64]:
        """Minimum clearance of an obstacle or the wall for each node, shape (n + 1,) [m]; inf where none is near."""
        count = len(self.vertices)
        return np.full(count, np.inf) if self.margins is None else node_clearance(self.margins, count)
