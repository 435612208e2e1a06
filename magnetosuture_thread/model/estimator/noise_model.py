"""The noise of model and camera over a run: propagated with the thread, learned from each frame, grown into the prior.

Each function is one call into compiled code a frame, as a call costs more than what most of its parts compute.
"""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.estimator.correction import CorrectionBuffers, MeasuredPoints
from magnetosuture_thread.model.estimator.covariance import propagate
from magnetosuture_thread.model.estimator.innovations import Innovations, WindowSums, take_over, weigh
from magnetosuture_thread.model.estimator.noise import (
    GRID,
    MIN_INTERVAL,
    WINDOWS,
    NoiseBank,
    grow,
    intensity_with_excess,
    interpolate_to_nodes,
    learn,
    match_innovations,
    shift_errors,
)

Vector = NDArray[np.float64]


@compiled
def propagate_errors(
    positions: Points,
    before: Points,
    unit: float,
    intensity: Vector,
    interval: float,
    factor: float,
    variance: Vector,
    density: Vector,
) -> None:
    """Propagate the prior over a step: its errors go with the thread, and the process noise is added; see `propagate`.

    Args:
        positions: after the step, shape (n + 1, 2) [m].
        before: before it [m].
        unit: D [m].
        intensity: of the process noise in each window, shape (w,) [m^2/s].
        interval: of the step [s].
        factor: of the density over the variance.
        variance: of each node, written, shape (n + 1,) [D^2].
        density: of each node, written, shape (n + 1,) [D^2].
    """
    nodes = len(variance)
    added, work = np.empty(nodes), np.empty(nodes)
    interpolate_to_nodes(intensity, nodes, added)
    added *= interval / unit**2
    added[0] = 0.0
    here, there = positions / unit, before / unit
    propagate(here, there, added, variance, work)
    propagate(here, there, factor * added, density, work)


@compiled
def learn_noise(
    points: MeasuredPoints,
    weights: Vector,
    sums: WindowSums,
    bank: NoiseBank,
    grid: Vector,
    unit: float,
    time_constant: float,
    scale: float,
    ratio: float,
    elapsed: float,
    learned_for: float,
    last_mean: Vector,
    last_variance: Vector,
    factor: float,
    variance: Vector,
    density: Vector,
    noise: Vector,
) -> tuple[float, float, Vector, Vector, Vector, Vector]:
    """Learn the noise from a frame, and let the prior grow where it rose.

    Args:
        points: of the frame.
        weights: robust ones against the prior that has grown, written, shape (m,).
        sums: of the windows, written.
        bank: written, as by `learn`.
        grid: see `learn`, as is the time constant.
        unit: D [m].
        time_constant: [s]
        scale: see `match_innovations`, as are the following.
        ratio: c.
        elapsed: since the last measurement [s].
        learned_for: time of all measurements before [s].
        last_mean: of the frame before [m].
        last_variance: of it [m^2].
        factor: of the density over the variance.
        variance: of the prior at each node, written, shape (n + 1,) [D^2].
        density: of the prior at each node, written, shape (n + 1,) [D^2].
        noise: of each node, written, shape (n + 1,) [D^2/s].

    Returns:
        The new scale and ratio; mean innovation, its variance as the camera says, and the variance that was expected
        of it, of each window; and the intensity of the process noise in each.
    """
    windows = len(sums.mean)
    mean, own, expected, intensity = np.empty(windows), np.empty(windows), np.empty(windows), np.empty(windows)
    before = bank.intensity.copy()
    weigh(points, variance, weights, sums)
    scale, matched = match_innovations(
        sums, unit, scale, ratio, elapsed, learned_for, last_mean, last_variance, mean, own, expected
    )
    learn(bank, grid, mean, sums.own * unit**2, elapsed, time_constant)
    # Where the bank knows of an error that the last correction left, the noise was too low: as if it came at once.
    intensity_with_excess(bank, mean, max(elapsed, MIN_INTERVAL), learned_for >= time_constant, intensity)
    grow(before, intensity, max(elapsed, MIN_INTERVAL) / unit**2, factor, variance, density)
    interpolate_to_nodes(intensity, len(noise), noise)
    noise /= unit**2
    weigh(points, variance, weights, sums)
    if learned_for == 0.0:
        # Of the first step after a start no noise was known: it is tested with the noise that it shows.
        matched, expected[:] = ratio, ratio * (sums.own + sums.known) * unit**2
    return scale, matched, mean, own, expected, intensity


@compiled
def take_correction(
    points: MeasuredPoints,
    weights: Vector,
    work: CorrectionBuffers,
    unit: float,
    bank: NoiseBank,
    density: Vector,
    variance: Vector,
) -> float:
    """Take over a correction into density, variance and bank; see `take_over` and `shift_errors`."""
    applied = np.empty(len(bank.intensity))
    hidden = take_over(points, weights, work, density, variance, applied)
    shift_errors(bank, applied * unit)
    return float(hidden)


class NoiseModel:
    """What is learned of process noise and measurement noise.

    Args:
        time_constant: over which the process noise is learned [s].

    Attributes:
        bank: filters of the windows.
        scale: of the points' variance over what the camera says.
        ratio: of squared innovations over what is expected.
        intensity: of the process noise at the last measurement, shape (w,) [m^2/s].
    """

    def __init__(self, time_constant: float) -> None:
        self.bank = NoiseBank.of(WINDOWS)
        self.scale, self.ratio = 1.0, 1.0
        self.intensity = self.bank.intensity.copy()
        self._time_constant, self._learned_for = time_constant, 0.0
        self._last_mean, self._last_variance = np.full(WINDOWS, np.nan), np.full(WINDOWS, np.nan)

    def copied(self, time_constant: float | None = None) -> NoiseModel:
        """Return a copy, that learns over another time if one is given [s]."""
        other = copy.copy(self)
        other.bank, other.intensity = self.bank.copied(), self.intensity.copy()
        other._time_constant = self._time_constant if time_constant is None else time_constant
        return other

    def learn(
        self,
        points: MeasuredPoints,
        weights: Vector,
        sums: WindowSums,
        unit: float,
        elapsed: float,
        factor: float,
        variance: Vector,
        density: Vector,
    ) -> tuple[Innovations, Vector]:
        """Test the innovations of a frame, and learn from them; see `learn_noise`.

        Args:
            points: of the frame.
            weights: written, shape (m,).
            sums: of the windows, written.
            unit: D [m].
            elapsed: since the last measurement [s].
            factor: of the density over the variance.
            variance: of the prior at each node, written [D^2].
            density: of the prior at each node, written [D^2].

        Returns:
            The innovations, and the process noise of each node, shape (n + 1,) [D^2/s].
        """
        noise = np.empty(len(variance))
        self.scale, self.ratio, self._last_mean, self._last_variance, expected, self.intensity = learn_noise(
            points,
            weights,
            sums,
            self.bank,
            GRID,
            unit,
            self._time_constant,
            self.scale,
            self.ratio,
            elapsed,
            self._learned_for,
            self._last_mean,
            self._last_variance,
            factor,
            variance,
            density,
            noise,
        )
        self._learned_for += elapsed
        return Innovations(self._last_mean, expected), noise
