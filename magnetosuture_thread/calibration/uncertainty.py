"""How well a fit determines its numbers: 95 % intervals that believe in blocks of time, not in single residuals.

Residuals of neighbouring nodes and frames are anything but independent. With A = J' W J and, for each block g of
time (`BLOCKS` of each passage), its score u_g = J_g' W r_g, the covariance is the sandwich

    C = A^-1 ( G / (G - 1) sum_g u_g u_g' ) A^-1

for G blocks; with three passages and more also with each passage as one block, and the wider one counts. What no
block can tell, because it is wrong in all of them alike, comes on top: an error of the whole chain of camera, tracker
and model that lies along a parameter's own effect moves that parameter by

    CHAIN / (mean size of its effect that no other parameter makes up for)

so that half of the interval is t_{0.975, G-1} sqrt(C_kk) + CHAIN / effect_k.

Source: cluster-robust covariance, K.-Y. Liang, S. L. Zeger, Biometrika 73 (1986). Deviation: the term of the chain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from magnetosuture_thread.calibration.fit import FitSolution
from magnetosuture_thread.calibration.passage import Passage

Array = NDArray[np.float64]

BLOCKS = 10  # of each passage
CLUSTERS = 3  # passages, from which on each is a block too
CHAIN = 5e-4  # of the length: how wrong camera, tracker and model may be alike all the time
MIN_EFFECT = 1e-12  # effect of a number, as a share of the length, below which it has none


@dataclass(frozen=True)
class Uncertainty:
    """How well numbers are determined.

    Attributes:
        half: half of the 95 % interval of each, in the scale of the fit, shape (P,).
        effect: mean size of d residual / d x of each that no other makes up for, as a share of the length, shape (P,).
        correlation: of their estimates, from J' W J, shape (P, P).
    """

    half: Array
    effect: Array
    correlation: Array


def uncertainty_of(solution: FitSolution, passages: Sequence[Passage], columns: Sequence[int]) -> Uncertainty:
    """Return how well some of a solution's numbers are determined, the others taken as they are.

    Args:
        solution: of a fit.
        passages: that it was fitted to.
        columns: of the numbers.
    """
    count = len(columns)
    jacobian = [j[..., list(columns)] for j in solution.jacobian]
    flat = np.concatenate([j[passage.known] for j, passage in zip(jacobian, passages, strict=True)])
    weights = np.concatenate([w[p.known] for w, p in zip(solution.weights, passages, strict=True)])
    size = np.maximum(np.sqrt((weights[:, None] * flat**2).sum(axis=0)), MIN_EFFECT)
    scaled = flat / size
    gram = scaled.T @ (weights[:, None] * scaled)
    inverse = np.linalg.pinv(gram, rcond=1e-12, hermitian=True)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    correlation = np.clip(inverse / np.outer(deviation, deviation), -1.0, 1.0)
    effect = np.array([_own_effect(flat, weights, index) for index in range(count)])
    blocks, whole = _scores(solution, jacobian, passages, size)
    half = _half(inverse, blocks) / size
    if len(passages) >= CLUSTERS:
        half = np.maximum(half, _half(inverse, whole) / size)
    return Uncertainty(half + CHAIN / np.maximum(effect, MIN_EFFECT), effect, correlation)


def _half(inverse: Array, scores: Array) -> Array:
    """Return half of each 95 % interval by the scores of blocks, shape (G, P)."""
    count = len(scores)
    if count < 2:
        return np.full(scores.shape[1], np.inf)
    middle = count / (count - 1.0) * scores.T @ scores
    variance = np.maximum(np.diag(inverse @ middle @ inverse), 0.0)
    return np.asarray(student.ppf(0.975, count - 1) * np.sqrt(variance))


def _scores(
    solution: FitSolution, jacobian: Sequence[Array], passages: Sequence[Passage], size: Array
) -> tuple[Array, Array]:
    """Return J' W r of each block of time, and of each passage."""
    blocks, whole = [], []
    for j, r, w, passage in zip(jacobian, solution.residuals, solution.weights, passages, strict=True):
        by_frame = np.einsum("knp,kn->kp", j / size, w * r)
        share = passage.times / max(float(passage.times[-1]), 1e-9)
        block = np.minimum((BLOCKS * share).astype(int), BLOCKS - 1)
        blocks += [by_frame[block == index].sum(axis=0) for index in np.unique(block)]
        whole.append(by_frame.sum(axis=0))
    return np.array(blocks), np.array(whole)


def _own_effect(flat: Array, weights: Array, index: int) -> float:
    """Return the mean size of a column of the Jacobian, less what the other columns make up for."""
    own, others = flat[:, index], np.delete(flat, index, axis=1)
    if others.shape[1]:
        root = np.sqrt(weights)[:, None]
        scale = np.maximum(np.linalg.norm(root * others, axis=0), MIN_EFFECT)
        own = own - (others / scale) @ np.linalg.lstsq(root * others / scale, root[:, 0] * own, rcond=None)[0]
    return float(np.abs(own).mean())
