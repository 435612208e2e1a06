"""Slow parameters on line: what the thread and the liquid are, learned from the same points as the thread's place.

DOC
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError, SolverError
from magnetosuture_thread.model.estimator.corrector import CorrectedSensitivities
from magnetosuture_thread.model.estimator.options import EstimatorOptions
from magnetosuture_thread.model.formulations import RodFormulation, ThreadState
from magnetosuture_thread.model.predictor import NeedlePose, Prediction, ThreadPredictor
from magnetosuture_thread.model.settings import MAX_REST_ANGLE
from magnetosuture_thread.model.thread import Thread

Vector = NDArray[np.float64]

DIFFERENCE = 1e-3  # of the prior deviation, in difference quotients
NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class SlowParameter:
    """One parameter that is learned on line.

    Attributes:
        name: of it.
        unit: of its value; empty for a ratio.
        value: that the estimate uses.
        low: lower end of its 95 % interval, within its bounds.
        high: upper end.
        excited: whether the last measurements said something about it; if not, value and interval stay.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    excited: bool


@dataclass(frozen=True)
class ParameterKind:
    """How a parameter enters a thread, and what is known of it beforehand.

    Attributes:
        name: of it.
        unit: of its value.
        logarithmic: whether it is positive and estimated as x = ln value, or else as x = value.
        read: its value in a thread.
        write: a thread with another value.
        bounds: of its value.
        deviation: of x, before anything is measured.
    """

    name: str
    unit: str
    logarithmic: bool
    read: Callable[[Thread], float]
    write: Callable[[Thread, float], Thread]
    bounds: Callable[[Thread], tuple[float, float]]
    deviation: Callable[[Thread], float]

    def to_x(self, value: float) -> float:
        """Return x of a value."""
        return math.log(value) if self.logarithmic else value

    def from_x(self, x: float) -> float:
        """Return the value of x."""
        return math.exp(x) if self.logarithmic else x


def _stiffness(thread: Thread) -> float:
    return thread.bending_stiffness / thread.medium.drag_across


def _with_stiffness(thread: Thread, value: float) -> Thread:
    return replace(thread, bending_stiffness=value * thread.medium.drag_across)


def _anisotropy(thread: Thread) -> float:
    return thread.medium.drag_along / thread.medium.drag_across


def _with_anisotropy(thread: Thread, value: float) -> Thread:
    return replace(thread, medium=replace(thread.medium, drag_along=value * thread.medium.drag_across))


def _curvature(thread: Thread) -> float:
    return float(np.mean(thread.rest_curvature))


def _with_curvature(thread: Thread, value: float) -> Thread:
    """Return a thread whose curvature at rest is that on the average, and differs along it as before."""
    if isinstance(thread.rest_curvature, tuple):
        more = value - _curvature(thread)
        return replace(thread, rest_curvature=tuple(each + more for each in thread.rest_curvature))
    return replace(thread, rest_curvature=value)


def _max_curvature(thread: Thread) -> tuple[float, float]:
    most = min(2000.0, 0.99 * MAX_REST_ANGLE / thread.segment_length)
    return -most, most


def _flow(axis: int) -> ParameterKind:
    def read(thread: Thread) -> float:
        return (thread.medium.flow or (0.0, 0.0))[axis]

    def write(thread: Thread, value: float) -> Thread:
        both = list(thread.medium.flow or (0.0, 0.0))
        both[axis] = value
        return replace(thread, medium=replace(thread.medium, flow=tuple(both)))

    return ParameterKind(
        f"flow_{'xy'[axis]}", "m/s", False, read, write, lambda thread: (-MAX_FLOW, MAX_FLOW), lambda thread: FLOW
    )


STIFFNESS_RANGE = 1e3  # within this factor of what is set, as `calibrate` looks for it
MAX_FLOW, FLOW = 0.02, 2e-3  # m/s; the second its prior deviation
KINDS = {
    "stiffness_over_drag": (
        ParameterKind(
            "stiffness_over_drag",
            "m^4/s",
            True,
            _stiffness,
            _with_stiffness,
            lambda thread: (_stiffness(thread) / STIFFNESS_RANGE, _stiffness(thread) * STIFFNESS_RANGE),
            lambda thread: math.log(10.0) / NORMAL_95,
        ),
    ),
    "drag_anisotropy": (
        ParameterKind(
            "drag_anisotropy",
            "",
            True,
            _anisotropy,
            _with_anisotropy,
            lambda thread: (0.05, 1.0),
            lambda thread: math.log(3.0) / NORMAL_95,
        ),
    ),
    "rest_curvature": (
        ParameterKind(
            "rest_curvature",
            "1/m",
            False,
            _curvature,
            _with_curvature,
            _max_curvature,
            lambda thread: 2.0 / thread.length,
        ),
    ),
    "flow": (_flow(0), _flow(1)),
}


@dataclass(frozen=True)
class LearnedState:
    """What is known of the parameters; arrays are never written to.

    Attributes:
        x: of the parameters, shape (p,).
        information: inverse of their covariance, shape (p, p).
        sensitivities: derivatives of the nodes and of their velocities by x, shape (2, p, n + 1, 2) [m], [m/s].
        activity: of each parameter, shape (p,).
    """

    x: Vector
    information: NDArray[np.float64]
    sensitivities: NDArray[np.float64]
    activity: Vector


class SlowParameters:
    """Learns parameters while a predictor runs.

    Args:
        predictor: of the estimator.
        names: of the parameters, keys of `KINDS`.
        time: over which they may change [s].

    Raises:
        ConfigurationError: a name is unknown, or the medium is none that drags.
    """

    def __init__(self, predictor: ThreadPredictor, options: EstimatorOptions) -> None:
        names, self._time = options.slow_parameters, options.slow_time
        self._predictor, self._thread = predictor, predictor.thread
        self.kinds = tuple(kind for name in dict.fromkeys(names) for kind in KINDS[name])
        thread = self._thread
        self._start = np.array([kind.to_x(kind.read(thread)) for kind in self.kinds])
        bounds = np.array([[kind.to_x(each) for each in kind.bounds(thread)] for kind in self.kinds]).reshape(-1, 2)
        self._low, self._high = bounds[:, 0], bounds[:, 1]
        self._deviation = np.array([kind.deviation(thread) for kind in self.kinds])
        self._low, self._high = np.minimum(self._low, self._start), np.maximum(self._high, self._start)
        self.state = self._fresh()

    def _fresh(self) -> LearnedState:
        count, nodes = len(self.kinds), self._thread.segments + 1
        return LearnedState(
            self._start.copy(), np.diag(self._deviation**-2.0), np.zeros((2, count, nodes, 2)), np.zeros(count)
        )

    def restart(self) -> None:
        """Forget how the thread's place depends on the parameters, as where it is laid along a measured line."""
        self.state = replace(self.state, sensitivities=np.zeros_like(self.state.sensitivities))

    def _thread_of(self, x: Vector) -> Thread:
        thread = self._thread
        for kind, each in zip(self.kinds, x.tolist(), strict=True):
            thread = kind.write(thread, kind.from_x(each))
        return thread

    def use(self, x: Vector) -> None:
        formulation = self._predictor.formulation
        assert isinstance(formulation, RodFormulation)
        formulation.set_thread(self._thread_of(x))

    def reset(self) -> None:
        """Forget everything."""
        self.restore(self._fresh())

    def restore(self, state: LearnedState) -> None:
        """Go back to a state."""
        self.state = state
        if self.kinds:
            self.use(state.x)

    def step(self, pose: NeedlePose) -> Prediction:
        """Let the predictor follow the needle, and propagate the sensitivities with it."""
        predictor, state = self._predictor, self.state
        formulation, last_pose, before = predictor.formulation, predictor.pose, predictor.state
        if not self.kinds or before is None:
            return predictor.step(pose)
        warm_start = formulation.warm_start()
        prediction = predictor.step(pose)
        after, after_pose = predictor.state, predictor.pose
        assert after is not None
        kept = formulation.warm_start()
        result = np.zeros_like(state.sensitivities)
        for j, deviation in enumerate(self._deviation):
            e = DIFFERENCE * deviation
            x = state.x.copy()
            x[j] += e if x[j] + e <= self._high[j] else -e
            e = x[j] - state.x[j]
            moved = ThreadState(
                before.positions + e * state.sensitivities[0, j],
                before.velocities + e * state.sensitivities[1, j],
                before.interval,
            )
            self.use(x)
            predictor.pose, predictor.state = last_pose, moved
            formulation.restore(warm_start)
            try:
                predictor.step(pose)
                result[0, j] = (predictor.state.positions - after.positions) / e
                result[1, j] = (predictor.state.velocities - after.velocities) / e
            except SolverError:
                pass
        self.use(state.x)
        predictor.pose, predictor.state = after_pose, after
        formulation.restore(kept)
        self.state = replace(state, sensitivities=result)
        return prediction

    def correct(self, corrector, start, density, points, weights, end) -> None:
        """Take what a correction makes of the sensitivities."""
        if self.kinds:
            unit, both = self._thread.segment_length, self.state.sensitivities.copy()
            both[0] = unit * corrector.sensitivities(start, density, points, weights, end, both[0] / unit).corrected
            self.state = replace(self.state, sensitivities=both)

    def learn(self, corrector, start, density, points, weights, end, pose, thread: ThreadState) -> ThreadState:
        """Return the thread as predicted with what a frame says of the parameters."""
        state, unit = self.state, self._thread.segment_length
        elapsed = 1 / 30.0
        said = corrector.sensitivities(start, density, points, weights, end, state.sensitivities[0] / unit)
        fit = max(1.0, said.square / max(said.independent, 1.0))
        self.debug = (said.square, said.independent, said.information.copy(), said.score.copy())
        J, s = said.information / fit, said.score / fit
        L = np.linalg.cholesky(state.information)
        Li = np.linalg.inv(L)
        mu, Q = np.linalg.eigh(Li @ J @ Li.T)
        mu = np.maximum(mu, 0.0)
        keep = 1.0 - np.minimum(1.0 - math.exp(-elapsed / self._time), mu)
        basis = L @ Q
        information = (basis * (keep + mu)) @ basis.T
        change = np.linalg.solve(information, s)
        largest = float(np.abs(change / self._deviation).max())
        part = min(1.0, 0.5 / largest) if largest > 0 else 1.0
        x = np.clip(state.x + part * change, self._low, self._high)
        change = x - state.x
        self.state = replace(state, x=x, information=information)
        self.use(x)
        shift = np.einsum("j,cjna->cna", change, state.sensitivities)
        return ThreadState(thread.positions + shift[0], thread.velocities + shift[1], thread.interval)

    def report(self) -> tuple[SlowParameter, ...]:
        covariance = np.linalg.inv(self.state.information)
        half = NORMAL_95 * np.sqrt(np.diag(covariance))
        found = []
        for j, kind in enumerate(self.kinds):
            low, high = max(self.state.x[j] - half[j], self._low[j]), min(self.state.x[j] + half[j], self._high[j])
            found.append(SlowParameter(kind.name, kind.unit, *(kind.from_x(float(v)) for v in (self.state.x[j], low, high)), True))
        return tuple(found)
