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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.estimator.correction import normals_of, robust_weights
from magnetosuture_thread.geometry.polyline import Mask, Points, Table, Vector

WINDOWS = 16
GRID = 10.0 ** np.arange(-17.0, -5.5)
"""Intensities q that a window may have, from 3 nm to 1 mm in a second's root [m^2/s]."""
QUIET = 1e-14  # before anything is measured [m^2/s]
NOISE_TIME = 1.0  # s; over which likelihoods of intensities are forgotten
MIN_SCALE, MAX_SCALE = 0.25, 16.0


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


class NoiseModel(NamedTuple):
    """What is learned of process noise and measurement noise over a run.

    Attributes:
        error: e of each filter, shape (w, g) [m].
        variance: of it, shape (w, g) [m^2].
        likelihood: of each intensity, rows sum to 1, shape (w, g).
        intensity: geometric mean of the intensities in each window, shape (w,) [m^2/s].
        raised: the same at the last measurement, with what must have come at once, shape (w,) [m^2/s].
        scale: of the points' variance over what the camera says.
        ratio: of squared innovations over what is expected.
        learned_for: since the first measurement [s].
        sums: of the windows of the last frame.
        last_mean: nu of the last frame, nan where nothing was measured, shape (w,) [m].
        last_variance: r of the last frame as the camera says, shape (w,) [m^2].
    """

    error: Points
    variance: Points
    likelihood: Points
    intensity: Vector
    raised: Vector
    scale: float
    ratio: float
    learned_for: float
    sums: WindowSums
    last_mean: Vector
    last_variance: Vector

    @classmethod
    def new(cls) -> NoiseModel:
        """Return the model before anything is measured."""
        prior = np.exp(-np.abs(np.log10(GRID / QUIET)))
        nothing, quiet, filters = np.full(WINDOWS, np.nan), np.full(WINDOWS, QUIET), np.zeros((WINDOWS, len(GRID)))
        likelihood, sums = np.tile(prior / prior.sum(), (WINDOWS, 1)), WindowSums(*[nothing] * 4)
        return cls(filters, filters, likelihood, quiet, quiet, 1.0, 1.0, 0.0, sums, nothing, nothing)


@np.errstate(divide="ignore", invalid="ignore")
def weigh(points: MeasuredPoints, variance: Vector) -> WindowSums:
    """Write the robust weights of the points against the prior; return the sums of the windows.

    Args:
        points: the points.
        variance: of the prior at each node across the thread, shape (n + 1,) [D^2].
    """
    prior = np.interp(points.place, np.arange(len(variance)), variance)
    robust_weights(points.innovation, points.variance + prior, points.weight)
    window = (points.place * WINDOWS / (len(variance) - 1)).astype(np.int64).clip(max=WINDOWS - 1)
    information = points.weight * points.share
    precision = information / points.variance
    of_points = (precision, precision * points.innovation, precision * prior, information)
    own, mean, known, independent = (np.asarray(np.bincount(window, each, WINDOWS), np.float64) for each in of_points)
    return WindowSums(mean / own, 1.0 / own, known / own, independent)


def at_nodes(values: Vector, nodes: int) -> Vector:
    """Return at each node the windows' values, interpolated in their logarithms between the windows' middles."""
    places = len(values) * np.arange(nodes) / (nodes - 1.0) - 0.5
    return np.asarray(np.exp(np.interp(places, np.arange(len(values)), np.log(values))))


def propagate_errors(positions: Points, before: Points, unit: float, added: Points, errors: Points) -> Points:
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
    nodes, (x, y), normals = np.arange(len(positions)), (positions - before).T, normals_of(before)
    slid = (x * normals[:, 1] - y * normals[:, 0]) / unit  # away from the needle
    return np.asarray(added + [np.interp(nodes + slid, nodes, each) for each in errors])


def learn(
    noise: NoiseModel, points: MeasuredPoints, errors: Points, unit: float, elapsed: float, factor: float
) -> tuple[NoiseModel, Innovations, Points]:
    """Test the innovations of a frame, learn from them, and let the prior grow where the noise rose.

    With the mean innovation nu of a window, its variance r by the points' own and p by the prior,

        E nu^2 = c (r + p)                  c, the ratio: log c <- log c + share (nu^2 / (c (r + p)) - 1)
        E (nu_k - nu_{k-1})^2 = 2 s r       s, the scale: errors of the model last, those of two frames do not

    Args:
        noise: learned before.
        points: of the frame; the robust weights against the prior that has grown are written.
        errors: variance and density of the prior, shape (2, n + 1) [D^2].
        unit: D [m].
        elapsed: since the last measurement [s].
        factor: of the density over the variance.

    Returns:
        What is learned now; the innovations; and the errors that have grown.
    """
    sums = weigh(points, errors[0])
    mean, own, known = sums.mean * unit, sums.own * unit**2, sums.known * unit**2
    seen, camera, expected = np.isfinite(mean), own / noise.scale, noise.ratio * (own + known)
    ratio, scale, both = noise.ratio, noise.scale, seen & np.isfinite(noise.last_mean)
    if seen.any():
        square = float((mean[seen] ** 2 / expected[seen]).mean())
        # Over 0.15 s, a few frames of 16 windows; a frame's normalised square counts up to 4 in the ratio.
        ratio *= float(np.exp(min(elapsed / 0.15, 1.0) * (min(square, 4.0) - 1.0)))
    if both.any():
        apart = (mean - noise.last_mean)[both] ** 2 / (camera + noise.last_variance)[both]
        # The scale is learned over 5 s; what it begins with is worth measurements of 0.2 s.
        share = min(elapsed / (min(noise.learned_for, 5.0) + 0.2), 1.0)
        scale += share * (float(np.minimum(apart, MAX_SCALE).mean()) - scale)
        scale = min(max(scale, MIN_SCALE), MAX_SCALE)
    error, variance, likelihood, intensity = learn_intensity(noise, mean, own, elapsed)
    # Noise is at work for 1 ms at the least.
    interval, settled = max(elapsed, 1e-3), noise.learned_for >= NOISE_TIME
    raised = raised_intensity(error, variance, likelihood, intensity, seen, interval, settled)
    nodes = errors.shape[1]
    extra = at_nodes(np.maximum(noise.intensity, raised), nodes) - at_nodes(noise.intensity, nodes)
    extra[0] = 0.0
    grown = errors + np.outer((1.0, factor), extra) * (interval / unit**2)
    sums = weigh(points, grown[0])
    if noise.learned_for == 0.0:
        # Of the first step after a start no noise was known: it is tested with the noise that it shows.
        ratio, expected = noise.ratio, noise.ratio * (sums.own + sums.known) * unit**2
    learned_for = noise.learned_for + elapsed
    model = NoiseModel(error, variance, likelihood, intensity, raised, scale, ratio, learned_for, sums, mean, camera)
    return model, Innovations(mean, expected), grown


@np.errstate(invalid="ignore")
def learn_intensity(
    noise: NoiseModel, mean: Vector, own: Vector, elapsed: float
) -> tuple[Points, Points, Points, Vector]:
    """Return error, variance and likelihood of the filters, and the intensities, after a frame.

    Args:
        noise: before it.
        mean: nu of each window, nan where nothing is measured, shape (w,) [m].
        own: r of each, inf where nothing is measured, shape (w,) [m^2].
        elapsed: since the last measurement [s].
    """
    # Every intensity gets a share of the weights anew each second: the noise may change at once.
    keep, switched = np.exp(-elapsed / NOISE_TIME), min(1.0, 1e-4 * elapsed)
    prior, own, off = noise.variance + GRID * elapsed, own[:, None], mean[:, None] - noise.error
    expected = prior + own
    logs = keep * np.log(noise.likelihood) - 0.5 * (np.log(expected) + off * off / expected)
    weight = np.exp(logs - logs.max(axis=1, keepdims=True))
    weight = (1.0 - switched) * weight / weight.sum(axis=1, keepdims=True) + switched / len(GRID)
    seen = np.isfinite(own)
    error = np.where(seen, noise.error + prior / expected * off, noise.error)
    variance = np.where(seen, prior * own / expected, prior)
    likelihood = np.where(seen, np.maximum(weight, 1e-30), noise.likelihood)
    intensity = np.where(seen[:, 0], np.exp(likelihood @ np.log(GRID)), noise.intensity)
    return error, variance, likelihood, intensity


def raised_intensity(
    error: Points, variance: Points, likelihood: Points, intensity: Vector, seen: Mask, interval: float, settled: bool
) -> Vector:
    """Return the process noise of each window, with what must have come at once where it did not explain an error.

    Args:
        error: see `NoiseModel`, as are the following.
        variance: see there.
        likelihood: see there.
        intensity: see there.
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
    # Of 99 % of right models it is less.
    if settled and (left[tested] / doubt[tested]).sum() > 2.0 * count:
        common = np.maximum(left - doubt, 0.0).sum() / count
    # An error of up to three standard deviations is explained.
    return np.maximum(intensity + np.maximum(left - 9.0 * doubt, 0.0) / interval, common / interval)


def take_correction(
    points: MeasuredPoints, normals: Points, moved: Points, covariance: Table, density: Vector
) -> tuple[Points, Vector]:
    """Return variance and density after a correction, and what each window was moved by.

    Args:
        points: the points, with their robust weights.
        normals: of the nodes, shape (n + 1, 2).
        moved: by the correction, shape (n + 1, 2) [D].
        covariance: of each node after it, shape (n + 1, 2, 2) [D^2].
        density: v of each node before, shape (n + 1,) [D^2].
    """
    segments = len(density) - 1
    window = (points.place * WINDOWS / segments).astype(np.int64).clip(max=WINDOWS - 1)
    low = np.minimum(points.place.astype(np.int64), segments - 1)
    part, precision = points.place - low, points.weight * points.share / points.variance
    gained = np.bincount(low, precision * (1.0 - part), segments + 1)
    gained += np.bincount(low + 1, precision * part, segments + 1)
    across = np.einsum("ia,ia->i", normals, moved)
    weighted = precision * ((1.0 - part) * across[low] + part * across[low + 1])
    applied = np.bincount(window, weighted, WINDOWS) / np.maximum(np.bincount(window, precision, WINDOWS), 1e-300)
    left = np.zeros((2, segments + 1))
    left[0] = np.einsum("ia,iab,ib->i", normals, covariance, normals)
    left[1, 1:] = 1.0 / (1.0 / density[1:] + gained[1:])
    return left, applied
