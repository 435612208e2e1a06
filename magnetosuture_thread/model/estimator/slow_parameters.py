"""Slow parameters on line: what thread and liquid are like, learned from the points that correct the thread's place.

The parameters x (logarithms of what is positive) are constant but for a slow forgetting. Together with the thread's
place they are one Kalman filter, kept in two parts: the place with its gain as it is, and the derivatives V_j of the
estimated nodes by the parameters, which say where the thread would be estimated had they been others. Each frame

    U_j = (step(x + e_j; place + V_j e) - step(x; place)) / e       by a step of the same program for each parameter
    J, s = information and score of the innovations                 see `sensitivity`
    I+ = I - forgotten + J,    x+ = x + I+^-1 s,    place = predicted + sum_j U_j (x+_j - x_j)

and the thread is then corrected from where the model with the new parameters would have predicted it. So a new value
is no jump: the place moves by what was wrong because of the parameter, through the hard constraints, and no more.

Forgetting: in the directions in which a frame informs (the eigenvectors of J against I), I loses at most as much as
J brings, and at most the share dt / T. Without excitation nothing is learned and nothing is forgotten: values and
intervals stay to the last bit. A parameter is excited where what is not known of it beforehand would move the
predicted thread by more than the last estimate was uncertain; noise of the camera bends the estimate by less than
that, and says nothing about stiffness.

Interval: half of it is

    t sqrt(phi_j (I^-1)_jj) + CHAIN L sum_k |U_jk| / (r_j sum_k |U_jk|^2),    r_j^2 = 1 / ((I^-1)_jj I_jj)

phi_j is the mean square of the scores of blocks of time over what the filter expects, at least 1: errors that last
are no noise. The second term is an error of the whole chain of camera, tracker and model along the parameter's effect
in the frames k, of which no other parameter makes up for the share r_j; no block of time can show it, see
`calibration/identifiability.py`.

Source: B. Friedland, Treatment of bias in recursive filtering, 1969; directional forgetting, R. Kulhavy 1987, for
several outputs B. Lai, D. S. Bernstein 2024. Deviation: derivatives by differences of the program's steps, at the
active set that these find; forgetting bounded by what is learned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError, SolverError
from magnetosuture_thread.model.estimator.corrector import Corrector
from magnetosuture_thread.model.estimator.options import EstimatorOptions
from magnetosuture_thread.model.estimator.parameter_kinds import KINDS, NORMAL_95
from magnetosuture_thread.model.formulations import RodFormulation, ThreadState
from magnetosuture_thread.model.prediction import NeedlePose, Prediction
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.model.thread import Thread

Vector = NDArray[np.float64]

DIFFERENCE = 1e-3  # of the prior deviation, in difference quotients
MAX_CHANGE = 0.5  # of the prior deviation, by a frame: beyond, the derivatives say little
BLOCKS = 5  # of time, in the time over which parameters may change
STUDENT_95 = 2.262  # of 2 * BLOCKS - 1 degrees of freedom: so many blocks count, the older ones for less
CHAIN = 5e-4  # of the length: how wrong camera, tracker and model may be alike all the time, as in `calibrate`
MAX_ELAPSED = 1.0  # s; between two frames, in which something can be forgotten


@dataclass(frozen=True)
class SlowParameter:
    """One parameter that is learned on line.

    Attributes:
        name: of it.
        unit: of its value; empty for a ratio.
        value: that the estimate uses.
        low: lower end of its 95 % interval, within its bounds.
        high: upper end.
        excited: whether the last measurement said something about it; if not, value and interval stay.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    excited: bool

    def __str__(self) -> str:
        """Return value and interval in words.

        >>> str(SlowParameter("drag_anisotropy", "", 0.512, 0.47, 0.55, False))
        '0.512, 95 % in 0.47 to 0.55, frozen: not excited'
        """
        value = f"{self.value:.3g} {self.unit}".strip()
        frozen = "" if self.excited else ", frozen: not excited"
        return f"{value}, 95 % in {self.low:.3g} to {self.high:.3g}{frozen}"


@dataclass(frozen=True)
class LearnedState:
    """What is known of p parameters; arrays are never written to.

    Attributes:
        active: whether they are learned; see `EstimatorOptions.automatic`.
        x: of the parameters, shape (p,).
        information: inverse of their covariance, shape (p, p).
        sensitivities: derivatives of the nodes and of their velocities by x, shape (2, p, n + 1, 2) [m], [m/s].
        stamp: of the last measurement [s].
        deviation: root mean square of those of the nodes after the last correction [m].
        excited: by it, shape (p,).
        effect: sums over frames of how far each moves the thread, squared and as it is, by unit of x, shape (2, p).
        block: sums of scores and of their expected squares in the block under way, shape (2, p).
        block_time: since it began [s].
        dispersion: sums over blocks of squared scores and of what was expected, shape (2, p).
    """

    active: bool
    x: Vector
    information: NDArray[np.float64]
    sensitivities: NDArray[np.float64]
    stamp: float
    deviation: float
    excited: NDArray[np.bool_]
    effect: NDArray[np.float64]
    block: NDArray[np.float64]
    block_time: float
    dispersion: NDArray[np.float64]


def _drags(thread: Thread) -> tuple[float, float]:
    return thread.medium.drag_across, thread.medium.drag_along


class SlowParameters:
    """Learns parameters of the thread while its predictor runs; with none it does nothing.

    Args:
        predictor: of the estimator.
        options: which parameters, and over what time they may change.

    Attributes:
        kinds: of the parameters.
        state: what is known of them.

    Raises:
        ConfigurationError: the thread has no stiffness or no drag.
    """

    def __init__(self, predictor: ThreadPredictor, options: EstimatorOptions) -> None:
        self._predictor, self._thread, self._time = predictor, predictor.thread, options.slow_time
        thread, names, self._automatic = self._thread, options.slow_parameters, options.automatic
        resists = min(thread.bending_stiffness, *_drags(thread)) > 0.0
        if self._automatic:
            names = ("stiffness_over_drag",) if resists else ()
        if names and not resists:
            raise ConfigurationError(
                "estimator.slow_parameters",
                list(options.slow_parameters),
                "none for a thread without stiffness or drag",
            )
        self.kinds = tuple(kind for name in dict.fromkeys(names) for kind in KINDS[name])
        self._start = np.array([kind.to_x(kind.read(thread)) for kind in self.kinds])
        bounds = np.array([[kind.to_x(each) for each in kind.bounds(thread)] for kind in self.kinds]).reshape(-1, 2)
        # What is set counts, even where nobody would look for it.
        self._low, self._high = np.minimum(bounds[:, 0], self._start), np.maximum(bounds[:, 1], self._start)
        self._deviation = np.array([kind.deviation(thread) for kind in self.kinds])
        if self._automatic:  # a thread that is held looks like one without stiffness: that is reported, not learned
            known = NORMAL_95 * self._deviation
            self._low = np.maximum(self._low, self._start - known)
            self._high = np.minimum(self._high, self._start + known)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        count, nodes = len(self.kinds), self._thread.segments + 1
        self.restore(
            LearnedState(
                bool(self.kinds) and not self._automatic,
                self._start,
                np.diag(self._deviation**-2.0),
                np.zeros((2, count, nodes, 2)),
                math.nan,
                math.inf,
                np.zeros(count, dtype=np.bool_),
                np.zeros((2, count)),
                np.zeros((2, count)),
                0.0,
                np.zeros((2, count)),
            )
        )

    def restore(self, state: LearnedState) -> None:
        """Go back to a state."""
        self.state = state
        if self.kinds:
            self._use(state.x)

    @property
    def active(self) -> bool:
        """Whether anything is learned."""
        return self.state.active

    def activate(self) -> None:
        """Begin to learn, where that waited for the model to be found wrong."""
        if self.kinds and not self.active:
            self.state = replace(self.state, active=True)

    def restart(self) -> None:
        """Take the thread's place as one that does not depend on the parameters, as where it was measured whole."""
        self.state = replace(self.state, sensitivities=np.zeros_like(self.state.sensitivities))

    @property
    def thread(self) -> Thread:
        """The thread with what is learned."""
        return self._with(self.state.x)

    def _with(self, x: Vector) -> Thread:
        thread = self._thread
        for kind, each, start in zip(self.kinds, x.tolist(), self._start.tolist(), strict=True):
            if each != start:  # a logarithm and back would change the last bit
                thread = kind.write(thread, kind.from_x(each))
        return thread

    def _use(self, x: Vector) -> None:
        formulation = self._predictor.formulation
        assert isinstance(formulation, RodFormulation)
        formulation.set_thread(self._with(x))

    def step(self, pose: NeedlePose) -> Prediction:
        """Let the predictor follow the needle to its next pose, and propagate the derivatives with it.

        Raises:
            InvalidInputError, SolverError: see `ThreadPredictor.step`.
        """
        predictor, state = self._predictor, self.state
        formulation, last_pose, before = predictor.formulation, predictor.pose, predictor.state
        if not self.active or last_pose is None or before is None:
            return predictor.step(pose)
        warm_start = formulation.warm_start()
        prediction = predictor.step(pose)
        after, after_pose, kept = predictor.state, predictor.pose, formulation.warm_start()
        assert after is not None
        sensitivities = np.zeros_like(state.sensitivities)
        for j, by in enumerate(
            np.where(state.x < 0.5 * (self._low + self._high), 1.0, -1.0) * DIFFERENCE * self._deviation
        ):
            moved = by * state.sensitivities[:, j]
            if not np.abs(moved[0]).max() < 0.5 * self._thread.segment_length:
                continue  # no derivative any more; it begins anew
            self._use(state.x + by * (np.arange(len(state.x)) == j))
            predictor.pose = last_pose
            predictor.state = ThreadState(before.positions + moved[0], before.velocities + moved[1], before.interval)
            formulation.restore(warm_start)
            try:
                predictor.step(pose)
            except SolverError:
                continue
            sensitivities[0, j] = (predictor.state.positions - after.positions) / by
            sensitivities[1, j] = (predictor.state.velocities - after.velocities) / by
        self._use(state.x)
        predictor.pose, predictor.state = after_pose, after
        formulation.restore(kept)
        self.state = replace(state, sensitivities=sensitivities)
        return prediction

    def learn(self, corrector: Corrector, predicted: ThreadState, stamp: float) -> ThreadState:
        """Learn from a frame; return where the thread is predicted with what was learned.

        Args:
            corrector: that has solved the correction of the predicted thread.
            predicted: that thread.
            stamp: of the frame [s].
        """
        state, unit = self.state, self._thread.segment_length
        found = corrector.sensitivities(state.sensitivities[0] / unit)
        if not (np.isfinite(found.information).all() and np.isfinite(found.score).all()):
            return predicted
        moved = np.sqrt((state.sensitivities[0] ** 2).sum(axis=2).mean(axis=1))
        excited = moved * self._deviation > state.deviation
        # Where not even the innovations that are left are as expected, a frame says less.
        both = excited / max(1.0, found.square / max(found.independent, 1.0))
        information, score = np.outer(both, excited) * found.information, both * found.score
        elapsed = min(stamp - state.stamp, MAX_ELAPSED) if math.isfinite(state.stamp) else 0.0
        forgetting = -math.expm1(-elapsed / self._time)
        before = np.linalg.inv(state.information)
        expected = np.diag(information) + np.einsum("ij,jk,ki->i", information, before, information)
        root = np.linalg.cholesky(state.information)
        inverse = np.linalg.inv(root)
        gained, basis = np.linalg.eigh(inverse @ information @ inverse.T)
        gained, basis = np.maximum(gained, 0.0), root @ basis
        new = (
            (basis * (1.0 - np.minimum(forgetting, gained) + gained)) @ basis.T if excited.any() else state.information
        )
        change = np.linalg.solve(new, score)
        change /= max(1.0, float(np.abs(change / self._deviation).max()) / MAX_CHANGE)
        x = np.clip(state.x + change, self._low, self._high)
        share = np.diag(information) / np.diag(state.information)
        effect = state.effect * (1.0 - np.minimum(forgetting, share)) + np.where(
            excited, np.array([moved**2, moved]), 0.0
        )
        self.state = self._with_block(
            replace(state, x=x, information=new, stamp=stamp, excited=excited, effect=effect),
            np.array([score, expected]),
            elapsed if excited.any() else 0.0,
        )
        if not excited.any():
            return predicted
        self._use(x)
        by = np.einsum("j,cjna->cna", x - state.x, state.sensitivities)
        return ThreadState(predicted.positions + by[0], predicted.velocities + by[1], predicted.interval)

    def correct(self, corrector: Corrector, variance: Vector) -> None:
        """Take over what a correction makes of the derivatives.

        Args:
            corrector: that has solved it.
            variance: of the nodes after it, shape (n + 1,) [D^2].
        """
        if self.active:
            unit, sensitivities = self._thread.segment_length, self.state.sensitivities.copy()
            found = corrector.sensitivities(sensitivities[0] / unit)
            sensitivities[0] = unit * np.where(np.isfinite(found.corrected), found.corrected, 0.0)
            deviation = unit * math.sqrt(max(float(variance.mean()), 0.0))
            self.state = replace(self.state, sensitivities=sensitivities, deviation=deviation)

    def _with_block(self, state: LearnedState, sums: NDArray[np.float64], elapsed: float) -> LearnedState:
        """Return a state in which a frame's score is counted, and its block of time where that ends."""
        block, time, dispersion = state.block + sums, state.block_time + elapsed, state.dispersion
        if time >= self._time / BLOCKS:
            keep = np.where(block[1] > 0.0, math.exp(-time / self._time), 1.0)
            dispersion = keep * dispersion + np.array([block[0] ** 2, block[1]])
            block, time = np.zeros_like(block), 0.0
        return replace(state, block=block, block_time=time, dispersion=dispersion)

    def report(self) -> tuple[SlowParameter, ...]:
        """Return the parameters as they are known now."""
        state = self.state
        if not self.active:
            return ()
        variance = np.diag(np.linalg.inv(state.information))
        own = 1.0 / np.sqrt(variance * np.diag(state.information))  # of the effect of each, no other makes up for
        ratio = np.maximum(state.dispersion[0] / np.maximum(state.dispersion[1], 1e-300), 1.0)
        square, effect = state.effect
        chain = CHAIN * self._thread.length * effect / (own * np.where(square > 0.0, square, 1.0))
        half = np.minimum(STUDENT_95 * np.sqrt(ratio * variance) + chain, NORMAL_95 * self._deviation)
        low, high = np.maximum(state.x - half, self._low), np.minimum(state.x + half, self._high)
        values = [
            [kind.from_x(float(x)) for x in ends] for kind, *ends in zip(self.kinds, state.x, low, high, strict=True)
        ]
        return tuple(
            SlowParameter(kind.name, kind.unit, value, first, last, bool(excited))
            for kind, (value, first, last), excited in zip(self.kinds, values, state.excited, strict=True)
        )
