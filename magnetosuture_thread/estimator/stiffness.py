"""Stiffness over drag, learned on line from the points that correct the thread's place.

x = ln B, B = EI / zeta_perp, is constant but for a slow forgetting. Together with the thread's place it is one Kalman
filter, kept in two parts: the place with its gain as it is, and the derivative V of the estimated nodes by x, which
says where the thread would be estimated had x been another. Each frame

    U = (step(x + e; place + V e) - step(x; place)) / e     by one more step of the same program
    J, s = information and score of the innovations         see `Corrector.sensitivity`
    I+ = I - forgotten + J,    x+ = x + s / I+,    place = predicted + U (x+ - x)

and the thread is then corrected from where the model with the new x would have predicted it. So a new value is no
jump: the place moves by what was wrong because of x, through the hard constraints, and no more.

Forgetting: I loses at most as much as J brings, and at most the share dt / T. Without excitation nothing is learned
and nothing is forgotten: value and interval stay to the last bit. x is excited where what is not known of it beforehand
would move the predicted thread by more than the last estimate was uncertain; noise of the camera bends the estimate by
less than that, and says nothing about stiffness.

Interval: half of it is

    t sqrt(phi / I) + CHAIN L sum_k |U_k| / sum_k |U_k|^2

phi is the mean square of the scores of blocks of time over what the filter expects, at least 1: errors that last are
no noise. The second term is an error of the whole chain of camera, tracker and model along the effect of x, as in
`calibrate`, which no number of frames averages out.

Source: B. Friedland, Treatment of bias in recursive filtering, 1969; directional forgetting, R. Kulhavy 1987.
Deviation: derivatives by differences of the program's steps, at the active set that these find; forgetting bounded by
what is learned.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.estimator.correction import Corrector
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.settings.errors import ConfigurationError, SolverError
from magnetosuture_thread.thread.prediction import NeedlePose, Prediction
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.step import ThreadState

AUTOMATIC, STIFFNESS_OVER_DRAG = "auto", "stiffness_over_drag"
NORMAL_95 = 1.959963984540054
STIFFNESS_KNOWN = 10.0  # 95 % of true values are within this factor of what is set; automatic learning stays within
STIFFNESS_RANGE = 1e3  # learning that is asked for stays within this factor, as `calibrate` does
DEVIATION = math.log(STIFFNESS_KNOWN) / NORMAL_95  # of x, before anything is measured
DIFFERENCE = 1e-3 * DEVIATION  # in difference quotients
MAX_CHANGE = 0.5 * DEVIATION  # by a frame: beyond, the derivative says little
SLOW_TIME = 10.0  # s; T, over which the stiffness may change
BLOCK_TIME = 2.0  # s; of the blocks of scores
CHAIN = 5e-4  # of the length: how wrong camera, tracker and model may be alike all the time, as in `calibrate`


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

        >>> str(SlowParameter("stiffness_over_drag", "m^4/s", 1.3e-9, 1.2e-9, 1.5e-9, False))
        '1.3e-09 m^4/s, 95 % in 1.2e-09 to 1.5e-09; kept, as this motion does not show it'
        """
        value = f"{self.value:.3g} {self.unit}".strip()
        kept = "" if self.excited else "; kept, as this motion does not show it"
        return f"{value}, 95 % in {self.low:.3g} to {self.high:.3g}{kept}"


@dataclass(frozen=True)
class LearnedState:
    """What is known of the stiffness; arrays are never written to.

    Attributes:
        active: whether it is learned.
        x: ln B.
        derivative: V, of the nodes and of their velocities by x, shape (2, n + 1, 2) [m], [m/s].
        information: I, inverse of the variance of x.
        stamp: of the last measurement [s].
        deviation: root mean square of those of the nodes after the last correction [m].
        excited: by the last measurement.
        effect: sums over frames of how far x moves the thread, squared and as it is [m^2], [m].
        block: sums of scores and of their expected squares in the block of time under way, and since when [s].
        dispersion: sums over blocks of squared scores and of what was expected.
    """

    active: bool
    x: float
    derivative: Points
    information: float = DEVIATION**-2.0
    stamp: float = math.nan
    deviation: float = math.inf
    excited: bool = False
    effect: tuple[float, float] = (0.0, 0.0)
    block: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dispersion: tuple[float, float] = (0.0, 0.0)


class StiffnessLearner:
    """Learns stiffness over drag while the predictor runs; otherwise it does nothing.

    Args:
        predictor: of the estimator.
        formulation: its own.
        learned: nothing, `STIFFNESS_OVER_DRAG`, or `AUTOMATIC`: from the first disturbance on.

    Attributes:
        state: what is known.
        thread: with what is learned.

    Raises:
        ConfigurationError: the stiffness is to be learned of a thread without stiffness or drag.
    """

    def __init__(self, predictor: ThreadPredictor, formulation: RodFormulation, learned: tuple[str, ...]) -> None:
        self._predictor, self._formulation = predictor, formulation
        self.thread = self._given = predictor.thread
        medium, stiffness = self._given.medium, self._given.bending_stiffness
        resists = min(stiffness, medium.drag_across, medium.drag_along) > 0.0
        if STIFFNESS_OVER_DRAG in learned and not resists:
            expected = "none for a thread without stiffness or drag"
            raise ConfigurationError("estimator.slow_parameters", list(learned), expected)
        self._learns, self._automatic = bool(learned) and resists, AUTOMATIC in learned
        # A thread that is held looks like one without stiffness: automatically that is reported, not learned.
        factor = STIFFNESS_KNOWN if self._automatic else STIFFNESS_RANGE
        self._start = math.log(stiffness / medium.drag_across) if resists else 0.0
        self._low, self._high = self._start - math.log(factor), self._start + math.log(factor)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        derivative = np.zeros((2, self._given.segments + 1, 2))
        self.restore(LearnedState(self._learns and not self._automatic, self._start, derivative))

    def restore(self, state: LearnedState) -> None:
        """Go back to a state."""
        self.state = state
        if self._learns:
            self._use(state.x)

    def _use(self, x: float) -> None:
        """Let the predictor step a thread of another stiffness."""
        self.thread = self._given
        if x != self._start:  # a logarithm and back would change the last bit
            self.thread = replace(self._given, bending_stiffness=math.exp(x) * self._given.medium.drag_across)
        self._formulation.set_thread(self.thread)

    def activate(self) -> None:
        """Begin to learn, where that waited for the model to be found wrong."""
        self.state = replace(self.state, active=self._learns)

    def restart(self) -> None:
        """Take the thread's place as one that does not depend on the stiffness, as where it was measured whole."""
        self.state = replace(self.state, derivative=np.zeros_like(self.state.derivative))

    def step(self, pose: NeedlePose) -> Prediction:
        """Let the predictor follow the needle to its next pose, and propagate the derivative with it.

        Raises:
            InvalidInputError, SolverError: see `ThreadPredictor.step`.
        """
        predictor, formulation, state = self._predictor, self._formulation, self.state
        last_pose, before = predictor.pose, predictor.state
        if not state.active or last_pose is None or before is None:
            return predictor.step(pose)
        warm_start = formulation.warm_start()
        prediction = predictor.step(pose)
        after, kept = predictor.state, formulation.warm_start()
        assert after is not None
        change = DIFFERENCE if state.x < self._start else -DIFFERENCE
        moved, derivative = change * state.derivative, np.zeros_like(state.derivative)
        if np.abs(moved[0]).max() < 0.5 * self._given.segment_length:  # beyond it is no derivative: it begins anew
            self._use(state.x + change)
            formulation.restore(warm_start)
            predictor.pose = last_pose
            predictor.state = ThreadState(before.positions + moved[0], before.velocities + moved[1], before.interval)
            with suppress(SolverError):
                predictor.step(pose)
                other = predictor.state
                derivative[:] = other.positions - after.positions, other.velocities - after.velocities
                derivative /= change
            self._use(state.x)
            formulation.restore(kept)
            predictor.pose, predictor.state = pose, after
        self.state = replace(state, derivative=derivative)
        return prediction

    def learn(self, corrector: Corrector, predicted: ThreadState, stamp: float) -> ThreadState:
        """Learn from a frame; return where the thread is predicted with what was learned.

        Args:
            corrector: that has solved the correction of the predicted thread.
            predicted: that thread.
            stamp: of the frame [s].
        """
        state = self.state
        found = corrector.sensitivity(state.derivative[0] / self._given.segment_length)
        if not (math.isfinite(found.information) and math.isfinite(found.score)):
            return predicted
        moved = math.sqrt(float((state.derivative[0] ** 2).sum(axis=1).mean()))
        if not moved * DEVIATION > state.deviation:
            self.state = replace(state, stamp=stamp, excited=False)
            return predicted
        # Where not even the innovations that are left are as expected, a frame says less.
        trust = 1.0 / max(1.0, found.square / max(found.independent, 1.0))
        score, gained = trust * found.score, trust * found.information / state.information
        elapsed = min(stamp - state.stamp, 1.0) if math.isfinite(state.stamp) else 0.0
        kept = 1.0 - min(-math.expm1(-elapsed / SLOW_TIME), gained)
        information = state.information * (kept + gained)
        change = min(max(score / information, -MAX_CHANGE), MAX_CHANGE)
        x = min(max(state.x + change, self._low), self._high)
        scores, expected, time = np.add(state.block, (score, gained * state.information * (1.0 + gained), elapsed))
        block, dispersion = (scores, expected, time), state.dispersion
        if time >= BLOCK_TIME:
            old = math.exp(-time / SLOW_TIME) if expected > 0.0 else 1.0
            block, dispersion = (0.0, 0.0, 0.0), (old * dispersion[0] + scores**2, old * dispersion[1] + expected)
        effect = state.effect[0] * kept + moved**2, state.effect[1] * kept + moved
        self.state = LearnedState(
            True, x, state.derivative, information, stamp, state.deviation, True, effect, block, dispersion
        )
        self._use(x)
        positions, velocities = (x - state.x) * state.derivative
        return ThreadState(predicted.positions + positions, predicted.velocities + velocities, predicted.interval)

    def correct(self, corrector: Corrector, variance: float) -> None:
        """Take over what a correction makes of the derivative.

        Args:
            corrector: that has solved it.
            variance: of the nodes after it, in the mean [D^2].
        """
        unit, derivative = self._given.segment_length, self.state.derivative.copy()
        corrected = corrector.sensitivity(derivative[0] / unit).corrected
        derivative[0] = unit * np.where(np.isfinite(corrected), corrected, 0.0)
        self.state = replace(self.state, derivative=derivative, deviation=unit * math.sqrt(max(variance, 0.0)))

    def report(self) -> tuple[SlowParameter, ...]:
        """Return what is known now; empty where nothing is learned."""
        state = self.state
        if not state.active:
            return ()
        ratio = max(state.dispersion[0] / max(state.dispersion[1], 1e-300), 1.0)
        square, effect = state.effect
        chain = CHAIN * self._given.length * effect / (square or 1.0)
        # Student's t at 95 % of 2 T / BLOCK_TIME - 1 = 9 degrees of freedom, as older blocks count for less.
        half = min(2.262 * math.sqrt(ratio / state.information) + chain, NORMAL_95 * DEVIATION)
        value, low, high = map(math.exp, (state.x, max(state.x - half, self._low), min(state.x + half, self._high)))
        return (SlowParameter(STIFFNESS_OVER_DRAG, "m^4/s", value, low, high, state.excited),)
