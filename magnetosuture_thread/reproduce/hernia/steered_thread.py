"""A thread that is steered in the model alone: the needle is a point, and goes as fast as the filter lets it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import NeedlePose, Prediction
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.safety import FilteredCommand, NeedleSafetyFilter

MAX_COMMAND = 1.0  # m/s; what commands more was meant in another unit
_AHEAD = np.array([1.0, 0.0])  # a point has no heading, and a thread that turns freely asks for none


@dataclass(frozen=True)
class SteeredInstant:
    """A steered thread at one instant.

    Attributes:
        time: since the start [s].
        prediction: of the thread.
        margins: of the prediction.
        command: that led here, filtered; None at the start.
        took: wall-clock time of the whole step, filter, prediction and margins [s].
    """

    time: float
    prediction: Prediction
    margins: Margins
    command: FilteredCommand | None
    took: float


class SteeredThread:
    """The loop of an operator, the needle's filter and the thread, without a rig.

        u_0 = filter(beta^count v_0),    x_0 <- x_0 + dt u_0,    then the thread's step

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback". Deviation: the friction by which
    v_0 is slowed is that of the thread where it is now, as in the source; the thread's step sees the needle where it
    has moved to.

    Args:
        settings: of the thread among its obstacles.
        centreline: where the thread lies at the start, from the needle on, shape (m, 2) [m].
        needle: the filter of a needle that is a point.

    Raises:
        ConfigurationError: an obstacle cannot be used.
        InvalidInputError: the thread cannot begin there.
    """

    def __init__(self, settings: ThreadModelSettings, centreline: Points, needle: NeedleSafetyFilter) -> None:
        self._session = ThreadSession(replace(settings, initial_shape="measured"), needle.scene)
        self._needle = needle
        self._stamp = 0
        self._tail = np.asarray(centreline[0], dtype=np.float64)
        for _ in self._session.on_measured_thread(0, centreline):
            pass
        self.now = self._take(None, 0.0)

    def step(self, interval: float, commanded: NDArray[np.float64]) -> SteeredInstant:
        """Move the needle as it is commanded, as far as it may, and let the thread follow.

        Args:
            interval: dt [s].
            commanded: v_0, shape (2,) [m/s].

        Raises:
            InvalidInputError: the velocity is not finite, or beyond 1 m/s.
            SolverError: a program had no solution, or its linearisation did not converge.
        """
        began = time.perf_counter()
        if not (np.isfinite(commanded).all() and math.hypot(*commanded.tolist()) <= MAX_COMMAND):
            expected = f"finite numbers, at most {MAX_COMMAND:g} m/s"
            raise InvalidInputError("needle velocity", commanded.tolist(), expected)
        slowdown = self.now.margins.friction.slowdown
        command = self._needle.filter(commanded, self._tail, _AHEAD, slowdown=slowdown)
        self._tail = self._tail + interval * command.filtered
        self._stamp += round(interval * 1e9)
        self.now = self._take(command, began)
        return self.now

    def _take(self, command: FilteredCommand | None, began: float) -> SteeredInstant:
        outcome = self._session.on_pose(self._stamp, NeedlePose(self._stamp * 1e-9, self._tail, _AHEAD))
        if outcome.problem is not None:
            raise outcome.problem
        prediction, margins = outcome.prediction, outcome.margins
        assert prediction is not None
        if margins is None:
            raise SolverError(prediction.solver, prediction.status, prediction.residual, 0.0)
        took = time.perf_counter() - began if command is not None else 0.0
        return SteeredInstant(self._stamp * 1e-9, prediction, margins, command, took)
