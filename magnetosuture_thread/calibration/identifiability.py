"""Which parameters the data identify, with 95 % intervals, and why not the others.

A number cannot be identified where

- the fit ends at its bound;
- its estimate goes with another's: |correlation| > `COLLINEAR`; the one with less effect is given up;
- half of its 95 % interval is wider than `Parameter.widest`: a factor of 1.5 for what is positive;
- its effect is too small to build on: a change that counts, a factor of two for what is positive, moves the predicted
  thread by less than `FLOOR` of its length that no other number makes up for. That is what the whole chain of
  camera, tracker and model is wrong by (0.05 to 0.2 %, docs/results.md), so such an estimate may come from the chain
  itself;
- it is the stiffness, and acts within a small part of the thread only. Behind a needle of speed V bending and drag
  are in balance over the length

      l = (B / V)^(1/3)

  at its ends and in tight bends; elsewhere the thread goes where it is pulled, however stiff. Within a part l / L of
  less than `SHORTEST_BEND` how it is tied, its knot and the model's segments matter as much.

The effect that others make up for counts for nothing, because what they are is not known either.

Source: l by scaling, zeta_perp V ~ EI / l^3. Deviation: none.

The intervals believe in blocks of time, not in single residuals. Residuals of neighbouring nodes and frames are
anything but independent. With A = J' W J and, for each block g of time (`RecordedRun.blocks`), its score
u_g = J_g' W r_g, the covariance is the sandwich

    C = A^-1 ( G / (G - 1) sum_g u_g u_g' ) A^-1

for G blocks; with three runs and more also with each run as one block, and the wider one counts. What no
block can tell, because it is wrong in all of them alike, comes on top: an error of the whole chain of camera, tracker
and model that lies along a parameter's own effect moves that parameter by

    CHAIN / (mean size of its effect that no other parameter makes up for)

so that half of the interval is t_{0.975, G-1} sqrt(C_kk) + CHAIN / effect_k.

Source: cluster-robust covariance, K.-Y. Liang, S. L. Zeger, Biometrika 73 (1986). Deviation: the term of the chain.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from magnetosuture_thread.calibration.fit import Array, FitSolution
from magnetosuture_thread.calibration.parameters import STIFFNESS_OVER_DRAG
from magnetosuture_thread.calibration.recorded_run import RecordedRun

COLLINEAR = 0.95
FLOOR = 2e-3  # of the length
MIN_BEND = 0.07  # of the length; silk of 150 mm has 0.03, polyamide of 19 mm 0.2 to 0.6
CLUSTERS = 3  # runs, from which on each is a block too
CHAIN = 5e-4  # of the length: how wrong camera, tracker and model may be alike all the time
MIN_EFFECT = 1e-12  # effect of a number, as a share of the length, below which it has none


class Uncertainty(NamedTuple):
    """How well numbers are determined.

    Attributes:
        half: half of the 95 % interval of each, in the scale of the fit, shape (P,).
        effect: mean size of d residual / d x of each that no other makes up for, as a share of the length, shape (P,).
        correlation: of their estimates, from J' W J, shape (P, P).
    """

    half: Array
    effect: Array
    correlation: Array


def estimate_uncertainty(solution: FitSolution, runs: Sequence[RecordedRun], columns: Sequence[int]) -> Uncertainty:
    """Return how well some of a solution's numbers are determined, the others taken as they are.

    Args:
        solution: of a fit.
        runs: that it was fitted to.
        columns: of the numbers.
    """
    jacobian = [j[..., list(columns)] for j in solution.jacobian]
    flat = np.concatenate([j[run.known] for j, run in zip(jacobian, runs, strict=True)])
    weights = np.concatenate([w[run.known] for w, run in zip(solution.weights, runs, strict=True)])
    size = np.maximum(np.sqrt((weights[:, None] * flat**2).sum(axis=0)), MIN_EFFECT)
    inverse = np.linalg.pinv((flat / size).T @ (weights[:, None] * flat / size), rcond=1e-12, hermitian=True)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    correlation = np.clip(inverse / np.outer(deviation, deviation), -1.0, 1.0)
    effect = np.array([_own_effect(flat, weights, index) for index in range(len(columns))])
    blocks, whole = [], []  # J' W r of each block of time, and of each run
    for j, r, w, run in zip(jacobian, solution.residuals, solution.weights, runs, strict=True):
        by_frame, block = np.einsum("knp,kn->kp", j / size, w * r), run.blocks
        blocks += [by_frame[block == index].sum(axis=0) for index in np.unique(block)]
        whole.append(by_frame.sum(axis=0))
    half = _half(inverse, np.array(blocks))
    if len(runs) >= CLUSTERS:
        half = np.maximum(half, _half(inverse, np.array(whole)))
    return Uncertainty(half / size + CHAIN / np.maximum(effect, MIN_EFFECT), effect, correlation)


def _half(inverse: Array, scores: Array) -> Array:
    """Return half of each 95 % interval by the scores of blocks, shape (G, P)."""
    count = len(scores)
    if count < 2:
        return np.full(scores.shape[1], np.inf)
    middle = count / (count - 1.0) * scores.T @ scores
    variance = np.maximum(np.diag(inverse @ middle @ inverse), 0.0)
    return np.asarray(stdtrit(count - 1, 0.975) * np.sqrt(variance))


def _own_effect(flat: Array, weights: Array, index: int) -> float:
    """Return the mean size of a column of the Jacobian, less what the other columns make up for."""
    own, others = flat[:, index], np.delete(flat, index, axis=1)
    if others.shape[1]:
        root = np.sqrt(weights)[:, None]
        scale = np.maximum(np.linalg.norm(root * others, axis=0), MIN_EFFECT)
        own = own - (others / scale) @ np.linalg.lstsq(root * others / scale, root[:, 0] * own, rcond=None)[0]
    return float(np.abs(own).mean())


class Identifiability(NamedTuple):
    """Identifiability of one parameter, with its confidence interval.

    Attributes:
        reason: why it cannot be identified; empty if it can.
        half: half of its 95 % interval, in the scale of the fit.
        effect: of a change that counts, as a share of the length.
    """

    reason: str
    half: float
    effect: float


def assess_identifiability(solution: FitSolution, runs: Sequence[RecordedRun]) -> list[Identifiability]:
    """Return the identifiability of each parameter of a solution.

    Args:
        solution: of a fit to all that is unknown.
        runs: that it was fitted to.
    """
    parameters, settings = solution.parameters, solution.settings
    counts = np.array([parameter.counts(settings) for parameter in parameters])
    found: dict[int, Identifiability] = {}
    for index, parameter in enumerate(parameters):
        if solution.at_bound(index):
            reason = f"the fit ends at its bound, {parameter.from_fit(float(solution.x[index])):.3g}"
            found[index] = Identifiability(reason, np.inf, 0.0)
    left = [index for index in range(len(parameters)) if index not in found]
    while left:
        uncertainty = estimate_uncertainty(solution, runs, left)
        half, effect = uncertainty.half.tolist(), (uncertainty.effect * counts[left]).tolist()
        pairs = np.abs(uncertainty.correlation - np.eye(len(left)))
        if pairs.max() <= COLLINEAR:
            for place, index in enumerate(left):
                reason = _too_short(solution, index, runs) or _reason(solution, index, effect[place], half[place])
                found[index] = Identifiability(reason, half[place], effect[place])
            break
        one, other = sorted(np.unravel_index(int(pairs.argmax()), pairs.shape), key=lambda place: effect[place])
        name, value = parameters[left[other]].name, uncertainty.correlation[one, other]
        reason = f"cannot be told apart from {name}: correlation {value:.2f}"
        found[left.pop(one)] = Identifiability(reason, half[one], effect[one])
    return [found[index] for index in range(len(parameters))]


def _reason(solution: FitSolution, index: int, effect: float, half: float) -> str:
    parameter, settings = solution.parameters[index], solution.settings
    if effect < FLOOR:
        change = (
            f"{parameter.counts(settings):.3g} {parameter.unit}" if parameter.kind == "plain" else "a factor of two"
        )
        moved = f"{change} moves the prediction by {100.0 * effect:.2g} % of the length only"
        return f"{moved}, less than the {100.0 * FLOOR:g} % that camera, tracker and model are wrong by"
    if half > parameter.widest(settings):
        low, high = parameter.interval(float(solution.x[index]), half)
        return f"its 95 % interval is {low:.3g} to {high:.3g} {parameter.unit}".rstrip() + ", too wide to be of use"
    return ""


def _too_short(solution: FitSolution, index: int, runs: Sequence[RecordedRun]) -> str:
    """Return in words that the stiffness acts on too small a part of the thread; empty if it does not."""
    parameter, length = solution.parameters[index], solution.settings.thread_length
    speed = min(run.speed for run in runs)
    if parameter is not STIFFNESS_OVER_DRAG or speed <= 0.0:
        return ""
    bend = float(np.cbrt(parameter.from_fit(float(solution.x[index])) / speed))
    if bend >= MIN_BEND * length:
        return ""
    part = f"{1e3 * bend:.1f} mm, {bend / length:.1%} of the thread"
    return f"bending acts within {part} only; elsewhere it goes where it is pulled, however stiff"
