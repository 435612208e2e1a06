"""Innovations: what the points say against the prediction, by windows, and what the correction makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_inline
from magnetosuture_thread.model.estimator.correction import CorrectionBuffers, MeasuredPoints, robust_weights

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Innovations:
    """What a frame says against the prediction, by windows of equal arc length from the needle to the free end.

    Attributes:
        mean: of the points' innovations across the thread, positive to the left; nan where nothing is measured [m].
        variance: that the filter expects of it [m^2].
    """

    mean: Vector
    variance: Vector

    @property
    def normalised_squared(self) -> Vector:
        """Normalised innovation squared of each window, 1 in the mean; nan where nothing is measured."""
        return np.asarray(self.mean**2 / self.variance)

    @property
    def total(self) -> tuple[float, int]:
        """Sum of the windows' normalised innovations squared, and its degrees of freedom: those that are measured."""
        squares = self.normalised_squared
        return float(np.nansum(squares)), int(np.isfinite(squares).sum())


class WindowSums(NamedTuple):
    """Of each window of equal arc length, shape (w,).

    Attributes:
        mean: mean innovation of its points, nan where there is none [D].
        own: variance of it by the points' own, inf where there is none [D^2].
        known: variance of the prior, in the points' mean [D^2].
        independent: number of its points that err independently.
    """

    mean: Vector
    own: Vector
    known: Vector
    independent: Vector

    @classmethod
    def of(cls, windows: int) -> WindowSums:
        """Return arrays for so many windows."""
        return cls(*(np.empty(windows) for _ in range(4)))


@compiled_inline
def _at(values: Vector, place: float) -> float:
    low = min(int(place), len(values) - 2)
    return float((1.0 - (place - low)) * values[low] + (place - low) * values[low + 1])


@compiled
def weigh(points: MeasuredPoints, variance: Vector, weights: Vector, sums: WindowSums) -> None:
    """Write the robust weights of the points against the prior, and the sums of the windows.

    Args:
        points: the points.
        variance: of the prior at each node across the thread, shape (n + 1,) [D^2].
        weights: written, shape (m,).
        sums: written.
    """
    count, windows, segments = len(weights), len(sums.mean), len(variance) - 1
    expected = np.empty(count)
    for p in range(count):
        expected[p] = points.variance[p] + _at(variance, points.place[p])
    robust_weights(points, points.innovation, expected, weights)
    sums.mean[:], sums.known[:], sums.own[:], sums.independent[:] = 0.0, 0.0, 0.0, 0.0
    for p in range(count):
        w = min(int(points.place[p] * windows / segments), windows - 1)
        precision = weights[p] * points.share[p] / points.variance[p]
        sums.own[w] += precision
        sums.independent[w] += weights[p] * points.share[p]
        sums.mean[w] += precision * points.innovation[p]
        sums.known[w] += precision * (expected[p] - points.variance[p])
    for w in range(windows):
        total = sums.own[w]
        sums.mean[w] = sums.mean[w] / total if total > 0.0 else np.nan
        sums.known[w] = sums.known[w] / total if total > 0.0 else np.nan
        sums.own[w] = 1.0 / total if total > 0.0 else np.inf


@compiled
def take_over(
    points: MeasuredPoints,
    weights: Vector,
    work: CorrectionBuffers,
    density: Vector,
    variance: Vector,
    applied: Vector,
) -> float:
    """Take over a correction: the information gained, what is left of the variance, and what each window was moved by.

    Args:
        points: the points.
        weights: robust ones.
        work: of the correction.
        density: v of each node; written [D^2].
        variance: of each node across the thread; written [D^2].
        applied: mean correction of the points of each window; written, shape (w,) [D].

    Returns:
        The part of the thread that no point shows.
    """
    segments, windows = len(density) - 1, len(applied)
    gained, total, seen = np.zeros(segments + 1), np.zeros(windows), np.zeros(segments, dtype=np.bool_)
    across = np.empty(segments + 1)
    for i in range(segments + 1):
        n, c = work.normals[i], work.covariance[i]
        variance[i] = n[0] * n[0] * c[0, 0] + 2.0 * n[0] * n[1] * c[0, 1] + n[1] * n[1] * c[1, 1]
        across[i] = n[0] * work.moved[i, 0] + n[1] * work.moved[i, 1]
    applied[:] = 0.0
    for p in range(len(weights)):
        low = min(int(points.place[p]), segments - 1)
        part = points.place[p] - low
        precision = weights[p] * points.share[p] / points.variance[p]
        gained[low] += precision * (1.0 - part)
        gained[low + 1] += precision * part
        w = min(int(points.place[p] * windows / segments), windows - 1)
        total[w] += precision
        applied[w] += precision * _at(across, points.place[p])
        seen[low] = True
    for w in range(windows):
        applied[w] = applied[w] / total[w] if total[w] > 0.0 else 0.0
    for i in range(1, segments + 1):
        density[i] = 1.0 / (1.0 / density[i] + gained[i])
    density[0] = 0.0
    hidden = 0
    for i in range(segments):
        hidden += 0 if seen[i] else 1
    return hidden / segments
