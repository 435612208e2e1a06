"""Process noise, learned from innovations: how fast the model goes wrong, in each window of arc length.

Each window has a bank of scalar Kalman filters of the estimate's mean error e in it, one for each intensity q of the
noise that could be at work:

    e' = e + w,  var w = q dt,        nu = e + v,  var v = r

with nu the mean innovation of the window's points. The weights of the bank are the likelihoods of the q, forgotten
over time; the process noise is their geometric mean. So it falls to nothing where the model is right, and rises
within a frame or two where something happens that the model does not know.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.model.estimator.innovations import WindowSums

Vector = NDArray[np.float64]

WINDOWS = 16
GRID = 10.0 ** np.arange(-17.0, -5.5)
"""Intensities q that a window may have, from 3 nm to 1 mm in a second's root [m^2/s]."""
QUIET = 1e-14  # before anything is measured [m^2/s]
SCALE_TIME = 5.0  # s; over which the scale of the points' variance is learned
RATIO_TIME = 0.15  # s; over which the covariance of innovations is matched to them; a few frames of 16 windows
MAX_SQUARE = 4.0  # normalised, of a frame's windows in the mean, that counts in that
LEARNING_PRIOR = 0.2  # s of measurements, that what is assumed to begin with is worth
MIN_SCALE, MAX_SCALE = 0.25, 16.0
SURE = 3.0  # standard deviations
SURE_OF_ALL = 2.0  # mean square of all windows' errors over their variances: 99 % of right ones are less
MIN_INTERVAL = 1e-3  # s; between measurements, in which noise can be at work
SWITCHING = 1e-4  # share of the weights that every intensity gets anew each second: the noise may change at once


class NoiseBank(NamedTuple):
    """The filters of all windows.

    Attributes:
        error: e of each, shape (w, g) [m].
        variance: of it, shape (w, g) [m^2].
        weight: likelihood of each intensity, rows sum to 1, shape (w, g).
        intensity: q of each window, shape (w,) [m^2/s].
    """

    error: NDArray[np.float64]
    variance: NDArray[np.float64]
    weight: NDArray[np.float64]
    intensity: Vector

    @classmethod
    def of(cls, windows: int) -> NoiseBank:
        """Return a bank that knows nothing but that the model is usually right."""
        prior = -np.abs(np.log10(GRID / QUIET))
        weight = np.exp(prior) / np.exp(prior).sum()
        shape = (windows, len(GRID))
        return cls(np.zeros(shape), np.zeros(shape), np.tile(weight, (windows, 1)), np.full(windows, QUIET))

    def copied(self) -> NoiseBank:
        """Return a copy."""
        return NoiseBank(*(array.copy() for array in self))


@compiled
def learn(
    bank: NoiseBank, grid: Vector, innovation: Vector, variance: Vector, interval: float, time_constant: float
) -> None:
    """Take the windows' mean innovations.

    Args:
        bank: written.
        grid: q of each filter, shape (g,) [m^2/s].
        innovation: nu of each window, shape (w,) [m].
        variance: r of each, inf where nothing is measured, shape (w,) [m^2].
        interval: since the last measurement [s].
        time_constant: over which likelihoods are forgotten [s].
    """
    keep, share = np.exp(-interval / time_constant), min(1.0, SWITCHING * interval) / len(grid)
    logs, log_grid = np.empty(len(grid)), np.log(grid)
    for w in range(len(innovation)):
        if not np.isfinite(variance[w]):
            for g in range(len(grid)):
                bank.variance[w, g] += grid[g] * interval
            continue
        best = -np.inf
        for g in range(len(grid)):
            prior = bank.variance[w, g] + grid[g] * interval
            expected = prior + variance[w]
            off = innovation[w] - bank.error[w, g]
            logs[g] = keep * np.log(bank.weight[w, g]) - 0.5 * (np.log(expected) + off * off / expected)
            best = max(best, logs[g])
            bank.error[w, g] += prior / expected * off
            bank.variance[w, g] = prior * variance[w] / expected
        total = 0.0
        for g in range(len(grid)):
            bank.weight[w, g] = np.exp(logs[g] - best)
            total += bank.weight[w, g]
        mean = 0.0
        for g in range(len(grid)):
            bank.weight[w, g] = max(bank.weight[w, g] / total * (1.0 - share * len(grid)) + share, 1e-30)
            mean += bank.weight[w, g] * log_grid[g]
        bank.intensity[w] = np.exp(mean)


@compiled
def share_of(elapsed: float, learned_for: float, time_constant: float) -> float:
    """Return the share of a new value in a mean: of all values at first, later of those of some time."""
    return float(min(elapsed / (min(learned_for, time_constant) + LEARNING_PRIOR), 1.0))


@compiled
def match_innovations(
    sums: WindowSums,
    unit: float,
    scale: float,
    ratio: float,
    elapsed: float,
    learned_for: float,
    last_mean: Vector,
    last_variance: Vector,
    mean: Vector,
    variance: Vector,
    expected: Vector,
) -> tuple[float, float]:
    """Match what is expected of innovations to those of a frame; return the new scale and ratio.

        E nu^2 = c (r + p)                  c, the ratio: log c <- log c + share (nu^2 / (c (r + p)) - 1)
        E (nu_k - nu_{k-1})^2 = 2 s r       s, the scale: errors of the model last, those of two frames are independent

    Args:
        sums: of the windows.
        unit: D [m].
        scale: s, by which the points' variance r of `sums` is larger than the camera says.
        ratio: c.
        elapsed: since the last measurement [s].
        learned_for: time of all measurements before [s].
        last_mean: of the frame before, nan where nothing was measured, shape (w,) [m].
        last_variance: r of it, as the camera says [m^2].
        mean: nu of each window, written, shape (w,) [m].
        variance: r of each as the camera says, written, shape (w,) [m^2].
        expected: c (r + p) of each, with the ratio before, written, shape (w,) [m^2].
    """
    squares, seen, changes, both = 0.0, 0, 0.0, 0
    for w in range(len(mean)):
        mean[w] = sums.mean[w] * unit
        variance[w] = sums.own[w] * unit**2 / scale
        total = (sums.own[w] + sums.known[w]) * unit**2
        expected[w] = ratio * total
        if not np.isfinite(mean[w]):
            continue
        squares += mean[w] ** 2 / total
        seen += 1
        if np.isfinite(last_mean[w]):
            change = (mean[w] - last_mean[w]) ** 2
            changes += min(change / (variance[w] + last_variance[w]), MAX_SCALE)
            both += 1
    if seen:
        off = min(squares / (seen * ratio), MAX_SQUARE) - 1.0
        ratio *= np.exp(min(elapsed / RATIO_TIME, 1.0) * off)
    if both:
        scale += share_of(elapsed, learned_for, SCALE_TIME) * (changes / both - scale)
        scale = min(max(scale, MIN_SCALE), MAX_SCALE)
    return scale, ratio


@compiled
def intensity_with_excess(bank: NoiseBank, mean: Vector, interval: float, settled: bool, intensity: Vector) -> None:
    """Write the process noise of each window, and what must have come in one interval of what it did not explain.

    Args:
        bank: the filters.
        mean: innovation of each window, nan where nothing is measured, shape (w,) [m].
        interval: since the last measurement [s].
        settled: whether the filters no longer show the error of the first shape.
        intensity: written, shape (w,) [m^2/s].
    """
    windows = len(mean)
    left, doubt = np.zeros(windows), np.zeros(windows)  # error that the filters expect, and their variance of it
    total, measured = 0.0, 0
    for w in range(windows):
        if not np.isfinite(mean[w]):
            continue
        for g in range(bank.error.shape[1]):
            left[w] += bank.weight[w, g] * bank.error[w, g]
            doubt[w] += bank.weight[w, g] * bank.variance[w, g]
        if doubt[w] > 0.0:
            total += left[w] ** 2 / doubt[w]
            measured += 1
    # What the thread is wrong by as a whole is little in each window, but not in all of them together: a thread that
    # is braced between needle and wall bends as a whole under forces that hardly differ, and a rigid prior holds it.
    common = 0.0
    if settled and total > SURE_OF_ALL * measured:
        for w in range(windows):
            common += max(left[w] ** 2 - doubt[w], 0.0) / measured
    for w in range(windows):
        intensity[w] = bank.intensity[w] + max(left[w] ** 2 - SURE**2 * doubt[w], 0.0) / interval
        intensity[w] = max(intensity[w], common / interval)


@compiled
def grow(before: Vector, after: Vector, amount: float, factor: float, variance: Vector, density: Vector) -> None:
    """Grow a prior by process noise that has turned out to be larger.

    Args:
        before: intensity of each window that the prior grew by, shape (w,) [m^2/s].
        after: what it should have been [m^2/s].
        amount: the interval, in the units of the variance.
        factor: of the density over the variance.
        variance: of each node, written, shape (n + 1,).
        density: of each node, written, shape (n + 1,).
    """
    nodes = len(variance)
    less, more = np.empty(nodes), np.empty(nodes)
    interpolate_to_nodes(before, nodes, less)
    interpolate_to_nodes(np.maximum(before, after), nodes, more)
    for i in range(1, nodes):
        extra = max(more[i] - less[i], 0.0) * amount
        variance[i] += extra
        density[i] += factor * extra


@compiled
def shift_errors(bank: NoiseBank, correction: Vector) -> None:
    """Take what the estimate was moved by in each window, shape (w,) [m]: it is no error any more."""
    for w in range(len(correction)):
        for g in range(bank.error.shape[1]):
            bank.error[w, g] -= correction[w]


@compiled
def interpolate_to_nodes(values: Vector, nodes: int, result: Vector) -> None:
    """Write at each node the windows' values, interpolated in their logarithms between the windows' middles."""
    windows, logs = len(values), np.log(values)
    for i in range(nodes):
        at = windows * i / (nodes - 1.0) - 0.5
        low = int(min(max(np.floor(at), 0.0), windows - 2.0))
        part = min(max(at - low, 0.0), 1.0)
        result[i] = np.exp((1.0 - part) * logs[low] + part * logs[low + 1])
