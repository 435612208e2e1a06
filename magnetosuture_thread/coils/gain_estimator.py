"""The gain of each coil against its calibration, estimated from the direction in which the needle lies."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.field import CoilModel
from magnetosuture_thread.safety import NeedleKinematics

Vector = NDArray[np.float64]

GAIN_DEVIATION = 0.05  # of a calibrated coil
MAX_CHANGE = 0.2  # of a gain
DRIFT_DEVIATION = 2e-3  # of a gain in a second, as coils warm up
DIRECTION_DEVIATION = 0.02  # rad; of a tracked needle, and by which a thread turns it from the field
GATE = 4.0  # standard deviations; a needle that is farther from the field is held by something


class CoilGainEstimator:
    """Estimates by which factor each coil's field differs from its calibration.

    A needle in a viscous liquid lies along the field within hundredths of a second, so that with the unit vector n
    across its chord, the currents I and the calibrated field b_i of one ampere in coil i,

        0 = n . sum_i g_i b_i I_i + noise,    of deviation DIRECTION_DEVIATION |B|

    which a Kalman filter with the gains g as its state, 1 with GAIN_DEVIATION at first, takes at each measured pose. A
    factor on all gains does not show in the direction: their mean stays 1.

    Source: the extended Kalman filter. Deviation: the gains are scaled to their mean after each measurement, their
    covariance is not. Pure: times come in, in seconds.

    Args:
        coils: their calibrated field.
        needle: its kinematics.
    """

    def __init__(self, coils: CoilModel, needle: NeedleKinematics) -> None:
        self._coils, self._needle = coils, needle
        count = len(coils.names)
        self.gains = np.ones(count)
        self._covariance = GAIN_DEVIATION**2 * np.eye(count)
        self._applied: deque[tuple[float, Vector]] = deque()
        self._last = -math.inf

    def apply(self, now: float, currents: Vector) -> None:
        """Register the currents from a time of the stamps' clock on, shape (m,) [A]."""
        if self._applied and now < self._applied[-1][0]:  # time was set back
            self._applied.clear()
            self._last = min(self._last, now)
        self._applied.append((now, currents))

    def stop(self) -> None:
        """Register that the currents are zero: nothing holds the needle's direction."""
        self._applied.clear()

    def update(self, tail: Vector, heading: Vector, stamp: float) -> None:
        """Take a measured pose.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            stamp: when it was measured [s].
        """
        while len(self._applied) > 1 and self._applied[1][0] <= stamp:
            self._applied.popleft()
        if not self._applied or self._applied[0][0] > stamp or not self._applied[0][1].any():
            return
        e = self._needle.chord_direction(heading)
        chord = self._needle.chord * e
        fields = 0.5 * (self._coils.per_current(tail) + self._coils.per_current(tail + chord)) * self._applied[0][1]
        across = fields[1] * e[0] - fields[0] * e[1]
        deviation = DIRECTION_DEVIATION * float(np.linalg.norm(fields @ self.gains))
        self._covariance += DRIFT_DEVIATION**2 * min(1.0, max(0.0, stamp - self._last)) * np.eye(len(across))
        self._last = stamp
        spread = self._covariance @ across
        variance = float(across @ spread) + deviation**2
        residual = -float(across @ self.gains)
        if residual**2 > GATE**2 * variance:
            return
        gains = self.gains + spread * (residual / variance)
        self.gains = np.clip(gains / gains.mean(), 1.0 - MAX_CHANGE, 1.0 + MAX_CHANGE)
        self._covariance -= np.outer(spread, spread) / variance
