"""Process noise and measurement noise, learned from innovations in windows of equal arc length.

Each window has a bank of scalar Kalman filters of the estimate's mean error e in it, one for each intensity q of the
noise that could be at work:

    e' = e + w,  var w = q dt,        nu = e + v,  var v = r

with nu the mean innovation of the window's points. The weights of the bank are the likelihoods of the q, forgotten
over time; the process noise is their geometric mean. So it falls to nothing where the model is right, and rises
within a frame or two where something happens that the model does not know.

The variance of each node and the density v of `correction` are kept together as an array of shape (2, n + 1) [D^2];
the second is 2 l times the first where nothing was measured.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.estimator.correction import CorrectionBuffers, robust_weights
from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]

WINDOWS = 16
GRID = 10.0 ** np.arange(-17.0, -5.5)
"""Intensities q that a window may have, from 3 nm to 1 mm in a second's root [m^2/s]."""
QUIET = 1e-14  # before anything is measured [m^2/s]
NOISE_TIME = 1.0  # s; over which likelihoods of intensities are forgotten
SCALE_TIME = 5.0  # s; over which the scale of the points' variance is learned
RATIO_TIME = 0.15  # s; over which the covariance of innovations is matched to them; a few frames of 16 windows
LEARNING_PRIOR = 0.2  # s of measurements, that the scale to begin with is worth
MIN_SCALE, MAX_SCALE = 0.25, 16.0
MAX_SQUARE = 4.0  # normalised, of a frame's windows in the mean, that counts in the ratio
SURE = 3.0  # standard deviations
SURE_OF_ALL = 2.0  # mean square of all windows' errors over their variances: 99 % of right ones are less
MIN_INTERVAL = 1e-3  # s; between measurements, in which noise can be at work
SWITCHING = 1e-4  # share of the weights that every intensity gets anew each second: the noise may change at once


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
    """Sums over the points of each window, shape (w,).

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


@compiled
def weigh(points: MeasuredPoints, variance: Vector) -> WindowSums:
    """Write the robust weights of the points against the prior; return the sums of the windows.

    Args:
        points: the points.
        variance: of the prior at each node across the thread, shape (n + 1,) [D^2].
    """
    prior = np.interp(points.place, np.arange(len(variance)) * 1.0, variance)
    robust_weights(points.innovation, points.variance + prior, points.weight)
    own, mean, known, independent = np.zeros(WINDOWS), np.zeros(WINDOWS), np.zeros(WINDOWS), np.zeros(WINDOWS)
    for p in range(len(prior)):
        w = min(int(points.place[p] * WINDOWS / (len(variance) - 1)), WINDOWS - 1)
        information = points.weight[p] * points.share[p]
        own[w] += information / points.variance[p]
        independent[w] += information
        mean[w] += information / points.variance[p] * points.innovation[p]
        known[w] += information / points.variance[p] * prior[p]
    total = np.where(own > 0.0, own, np.nan)
    return WindowSums(mean / total, 1.0 / own, known / total, independent)


@compiled
def at_nodes(values: Vector, nodes: int) -> Vector:
    """Return at each node the windows' values, interpolated in their logarithms between the windows' middles."""
    places = len(values) * np.arange(nodes) / (nodes - 1.0) - 0.5
    return np.asarray(np.exp(np.interp(places, np.arange(len(values)) * 1.0, np.log(values))))


@compiled
def propagate_errors(positions: Points, before: Points, unit: float, added: Vector, errors: Points) -> Points:
    """Return variance and density after a step: errors across the thread stay where they are, and grow.

    The thread slides along itself when it is pulled: a node comes to where another part of the thread was, and has
    that part's error. Behind the needle, whose place is known, comes thread without error.

    Args:
        positions: after the step, shape (n + 1, 2) [m].
        before: before it [m].
        unit: D [m].
        added: noise over the step, of variance and density at each node, shape (2, n + 1) [D^2].
        errors: variance and density before, shape (2, n + 1) [D^2].
    """
    last, slid = len(positions) - 1, np.zeros(len(positions))
    for i in range(last + 1):
        a, b = max(i - 1, 0), min(i + 1, last)
        tx, ty = before[a, 0] - before[b, 0], before[a, 1] - before[b, 1]  # towards the needle
        size = np.hypot(tx, ty)
        if size > 0.0:
            slid[i] = ((positions[i, 0] - before[i, 0]) * tx + (positions[i, 1] - before[i, 1]) * ty) / (size * unit)
    nodes = np.arange(last + 1.0)
    result: Points = added.copy()
    for k in range(2):
        result[k] += np.interp(nodes - slid, nodes, errors[k])
    return result


class NoiseModel:
    """What is learned of process noise and measurement noise over a run.

    Arrays are replaced and never written to, so that a shallow copy keeps a state.

    Attributes:
        error: e of each filter, shape (w, g) [m].
        variance: of it, shape (w, g) [m^2].
        likelihood: of each intensity, rows sum to 1, shape (w, g).
        intensity: geometric mean of the intensities in each window, shape (w,) [m^2/s].
        raised: the same at the last measurement, with what must have come at once, shape (w,) [m^2/s].
        scale: of the points' variance over what the camera says.
        ratio: of squared innovations over what is expected.
        sums: of the windows of the last frame.
    """

    def __init__(self) -> None:
        prior = np.exp(-np.abs(np.log10(GRID / QUIET)))
        self.error = self.variance = np.zeros((WINDOWS, len(GRID)))
        self.likelihood = np.tile(prior / prior.sum(), (WINDOWS, 1))
        self.intensity = self.raised = np.full(WINDOWS, QUIET)
        self.scale = self.ratio = 1.0
        self.sums = WindowSums(*np.full((4, WINDOWS), np.nan))
        self._learned_for = 0.0  # s
        self._last_mean = self._last_variance = np.full(WINDOWS, np.nan)  # of the frame before, as the camera says

    def copied(self) -> NoiseModel:
        """Return a copy."""
        return copy.copy(self)

    def learn(
        self, points: MeasuredPoints, errors: Points, unit: float, elapsed: float, factor: float
    ) -> tuple[Innovations, Points]:
        """Test the innovations of a frame, learn from them, and let the prior grow where the noise rose.

        Args:
            points: of the frame; the robust weights against the prior that has grown are written.
            errors: variance and density of the prior, shape (2, n + 1) [D^2].
            unit: D [m].
            elapsed: since the last measurement [s].
            factor: of the density over the variance.

        Returns:
            The innovations, and the errors that have grown.
        """
        sums = weigh(points, errors[0])
        mean, own = sums.mean * unit, sums.own * unit**2
        ratio, expected = self._match(mean, own, sums.known * unit**2, elapsed)
        before, settled = self.intensity, self._learned_for >= NOISE_TIME
        state = self.error, self.variance, self.likelihood, self.intensity
        self.error, self.variance, self.likelihood, self.intensity = learn(*state, mean, own, elapsed)
        interval = max(elapsed, MIN_INTERVAL)
        state = self.error, self.variance, self.likelihood, self.intensity
        self.raised = raised_intensity(*state, np.isfinite(mean), interval, settled)
        nodes = errors.shape[1]
        extra = at_nodes(np.maximum(before, self.raised), nodes) - at_nodes(before, nodes)
        extra[0] = 0.0
        errors = errors + np.array([[1.0], [factor]]) * extra * (interval / unit**2)
        self.sums = weigh(points, errors[0])
        if self._learned_for == 0.0:
            # Of the first step after a start no noise was known: it is tested with the noise that it shows.
            ratio, expected = self.ratio, self.ratio * (self.sums.own + self.sums.known) * unit**2
        self.ratio = ratio
        self._learned_for += elapsed
        return Innovations(mean, expected), errors

    def _match(self, mean: Vector, own: Vector, known: Vector, elapsed: float) -> tuple[float, Vector]:
        """Match what is expected of innovations to those of a frame.

            E nu^2 = c (r + p)                  c, the ratio: log c <- log c + share (nu^2 / (c (r + p)) - 1)
            E (nu_k - nu_{k-1})^2 = 2 s r       s, the scale: errors of the model last, those of two frames do not

        Args:
            mean: nu of each window, nan where nothing is measured, shape (w,) [m].
            own: r, inf where nothing is measured [m^2].
            known: p [m^2].
            elapsed: since the last measurement [s].

        Returns:
            The new ratio, and what was expected with the ratio before, shape (w,) [m^2].
        """
        expected, ratio, camera = self.ratio * (own + known), self.ratio, own / self.scale
        seen = np.isfinite(mean)
        if seen.any():
            off = min(float((mean[seen] ** 2 / expected[seen]).mean()), MAX_SQUARE) - 1.0
            ratio *= float(np.exp(min(elapsed / RATIO_TIME, 1.0) * off))
        both = seen & np.isfinite(self._last_mean)
        if both.any():
            change = (mean - self._last_mean)[both] ** 2 / (camera + self._last_variance)[both]
            share = min(elapsed / (min(self._learned_for, SCALE_TIME) + LEARNING_PRIOR), 1.0)
            self.scale += share * (float(np.minimum(change, MAX_SCALE).mean()) - self.scale)
            self.scale = min(max(self.scale, MIN_SCALE), MAX_SCALE)
        self._last_mean, self._last_variance = mean, camera
        return ratio, expected

    def take_correction(
        self, points: MeasuredPoints, work: CorrectionBuffers, errors: Points, unit: float
    ) -> tuple[Points, float]:
        """Take over a correction: the information gained, what is left of the variance, and what is no error any more.

        Args:
            points: the points, with their robust weights.
            work: of the correction.
            errors: variance and density before, shape (2, n + 1) [D^2].
            unit: D [m].

        Returns:
            Variance and density after, shape (2, n + 1) [D^2], and the part of the thread that no point shows.
        """
        left, applied, hidden = take_correction(points, work.normals, work.moved, work.covariance, errors[1])
        self.error = self.error - unit * applied[:, None]
        return left, hidden


@compiled
def learn(
    error: Points, variance: Points, likelihood: Points, intensity: Vector, mean: Vector, own: Vector, elapsed: float
) -> tuple[Points, Points, Points, Vector]:
    """Return the filters and intensities of all windows after a frame.

    Args:
        error: see `NoiseModel`, as are the following, which are returned.
        variance: of the errors.
        likelihood: of each intensity.
        intensity: of each window.
        mean: nu of each window, shape (w,) [m].
        own: r of each, inf where nothing is measured, shape (w,) [m^2].
        elapsed: since the last measurement [s].
    """
    keep, switched = np.exp(-elapsed / NOISE_TIME), min(1.0, SWITCHING * elapsed)
    error, variance, likelihood, intensity = (
        error.copy(),
        variance + GRID * elapsed,
        likelihood.copy(),
        intensity.copy(),
    )
    for w in np.flatnonzero(np.isfinite(own)):
        prior, off = variance[w].copy(), mean[w] - error[w]
        expected = prior + own[w]
        logs = keep * np.log(likelihood[w]) - 0.5 * (np.log(expected) + off * off / expected)
        weight = np.exp(logs - logs.max())
        weight = (1.0 - switched) * weight / weight.sum() + switched / len(GRID)
        error[w] += prior / expected * off
        variance[w] = prior * own[w] / expected
        likelihood[w] = np.maximum(weight, 1e-30)
        intensity[w] = np.exp((likelihood[w] * np.log(GRID)).sum())
    return error, variance, likelihood, intensity


@compiled
def raised_intensity(
    error: Points,
    variance: Points,
    likelihood: Points,
    intensity: Vector,
    seen: NDArray[np.bool_],
    interval: float,
    settled: bool,
) -> Vector:
    """Return the process noise of each window, with what must have come at once where it did not explain an error.

    Args:
        error: see `NoiseModel`, as are the following.
        variance: of the errors.
        likelihood: of each intensity.
        intensity: of each window.
        seen: windows in which something is measured, shape (w,).
        interval: since the last measurement [s].
        settled: whether the filters no longer show the error of the first shape.
    """
    left = np.where(seen, (likelihood * error).sum(axis=1), 0.0) ** 2
    doubt = np.where(seen, (likelihood * variance).sum(axis=1), 0.0)  # the variance that the filters expect of it
    tested = doubt > 0.0
    # What the thread is wrong by as a whole is little in each window, but not in all of them together: a thread that
    # is braced between needle and wall bends as a whole under forces that hardly differ, and a rigid prior holds it.
    common, count = 0.0, tested.sum()
    if settled and (left[tested] / doubt[tested]).sum() > SURE_OF_ALL * count:
        common = np.maximum(left - doubt, 0.0).sum() / count
    return np.maximum(intensity + np.maximum(left - SURE**2 * doubt, 0.0) / interval, common / interval)


@compiled
def take_correction(
    points: MeasuredPoints, normals: Points, moved: Points, covariance: NDArray[np.float64], density: Vector
) -> tuple[Points, Vector, float]:
    """Return variance and density after a correction, what each window was moved by, and the part that is hidden.

    Args:
        points: the points, with their robust weights.
        normals: of the nodes, shape (n + 1, 2).
        moved: by the correction, shape (n + 1, 2) [D].
        covariance: of each node after it, shape (n + 1, 2, 2) [D^2].
        density: v of each node before, shape (n + 1,) [D^2].
    """
    segments = len(density) - 1
    gained, seen = np.zeros(segments + 1), np.zeros(segments, dtype=np.bool_)
    total, applied = np.zeros(WINDOWS), np.zeros(WINDOWS)
    left, across = np.zeros((2, segments + 1)), (normals * moved).sum(axis=1)
    for i in range(segments + 1):
        n, c = normals[i], covariance[i]
        left[0, i] = n[0] * n[0] * c[0, 0] + 2.0 * n[0] * n[1] * c[0, 1] + n[1] * n[1] * c[1, 1]
    for p in range(len(points.place)):
        low = min(int(points.place[p]), segments - 1)
        part = points.place[p] - low
        precision = points.weight[p] * points.share[p] / points.variance[p]
        gained[low] += precision * (1.0 - part)
        gained[low + 1] += precision * part
        w = min(int(points.place[p] * WINDOWS / segments), WINDOWS - 1)
        total[w] += precision
        applied[w] += precision * ((1.0 - part) * across[low] + part * across[low + 1])
        seen[low] = True
    left[1, 1:] = 1.0 / (1.0 / density[1:] + gained[1:])
    return left, np.where(total > 0.0, applied / np.maximum(total, 1e-300), 0.0), 1.0 - seen.sum() / segments
