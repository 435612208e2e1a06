"""Process noise, learned from innovations: how fast the model goes wrong, in each window of arc length.

Each window has a bank of scalar Kalman filters of the estimate's mean error e in it, one for each intensity q of the
noise that could be at work:

    e' = e + w,  var w = q dt,        nu = e + v,  var v = r

with nu the mean innovation of the window's points. The weights of the bank are the likelihoods of the q, forgotten
over a memory; the process noise is their geometric mean. So it falls to nothing where the model is right, and rises
within a frame or two where something happens that the model does not know.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled

Vector = NDArray[np.float64]

WINDOWS = 16
GRID = 10.0 ** np.arange(-17.0, -5.5)
"""Intensities q that a window may have, from 3 nm to 1 mm in a second's root [m^2/s]."""
QUIET = 1e-14  # before anything is measured [m^2/s]
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
def learn(bank: NoiseBank, grid: Vector, innovation: Vector, variance: Vector, interval: float, memory: float) -> None:
    """Take the windows' mean innovations.

    Args:
        bank: written.
        grid: q of each filter, shape (g,) [m^2/s].
        innovation: nu of each window, shape (w,) [m].
        variance: r of each, inf where nothing is measured, shape (w,) [m^2].
        interval: since the last measurement [s].
        memory: over which likelihoods are forgotten [s].
    """
    keep, share = np.exp(-interval / memory), min(1.0, SWITCHING * interval) / len(grid)
    for w in range(len(innovation)):
        if not np.isfinite(variance[w]):
            for g in range(len(grid)):
                bank.variance[w, g] += grid[g] * interval
            continue
        best = -np.inf
        logs = np.empty(len(grid))
        for g in range(len(grid)):
            prior = bank.variance[w, g] + grid[g] * interval
            spread = prior + variance[w]
            off = innovation[w] - bank.error[w, g]
            logs[g] = keep * np.log(bank.weight[w, g]) - 0.5 * (np.log(spread) + off * off / spread)
            best = max(best, logs[g])
            bank.error[w, g] += prior / spread * off
            bank.variance[w, g] = prior * variance[w] / spread
        total = 0.0
        for g in range(len(grid)):
            bank.weight[w, g] = np.exp(logs[g] - best)
            total += bank.weight[w, g]
        mean = 0.0
        for g in range(len(grid)):
            bank.weight[w, g] = max(bank.weight[w, g] / total * (1.0 - share * len(grid)) + share, 1e-30)
            mean += bank.weight[w, g] * np.log(grid[g])
        bank.intensity[w] = np.exp(mean)


def unexplained(bank: NoiseBank) -> tuple[Vector, Vector]:
    """Return the error that each window's filters expect of the estimate [m], and their variance of it [m^2]."""
    return (bank.weight * bank.error).sum(axis=1), (bank.weight * bank.variance).sum(axis=1)


@compiled
def shift_errors(bank: NoiseBank, correction: Vector) -> None:
    """Take what the estimate was moved by in each window, shape (w,) [m]: it is no error any more."""
    for w in range(len(correction)):
        for g in range(bank.error.shape[1]):
            bank.error[w, g] -= correction[w]


@compiled
def spread_to_nodes(values: Vector, nodes: int, spread: Vector) -> None:
    """Write at each node the windows' values, interpolated in their logarithms between the windows' middles."""
    windows = len(values)
    for i in range(nodes):
        at = windows * i / (nodes - 1.0) - 0.5
        low = int(min(max(np.floor(at), 0.0), windows - 2.0))
        part = min(max(at - low, 0.0), 1.0)
        spread[i] = np.exp((1.0 - part) * np.log(values[low]) + part * np.log(values[low + 1]))
