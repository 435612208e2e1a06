"""The heading of the needle between its poses, from the field that turns it, and the errors of that field."""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import HEADING_ERROR, NeedleMechanics
from magnetosuture_thread.coils.field import LoopCoils

Vector = NDArray[np.float64]

GAIN_DEVIATION = 0.05  # of a calibrated coil
MAX_CHANGE = 0.2  # of a gain
DRIFT_DEVIATION = 2e-3  # of a gain in a second, as coils warm up
TORQUE_ANGLE = 0.1  # rad; by which the torque of a stiff or taut thread, root mean square, turns it from the field
TORQUE_TIME = 1.0  # s; in which that torque changes, as a thread is led around a turn
STAMP_ERROR = 0.05  # s; deviation of a camera's stamps: one that stamps on arrival has buffered a frame or two
STAMP_DRIFT = 0.01  # s in a second, root mean square; of a buffer that fills or empties, and of two clocks
MAX_STAMP_ERROR = 0.2  # s; more is taken for something that holds the needle
FREE_TURN = 0.3  # rad; by which a needle without a field turns, root mean square, after its last pose
MAX_SLEW = 0.2  # s of the stamps' error in a second, so that corrected stamps stay in order
KEPT = 1.0  # s; of headings, for poses that come late
OUTLIER = 4.0  # standard deviations, beyond which the needle is held by something


class HeadingObserver:
    """Estimates the heading of the needle now, and by which factor each coil's field differs from its calibration.

    The needle turns towards the field B = sum_i g_i b_i I_i, against the liquid and the thread. With the unit vector n
    across its chord l, the poles -q, +q at its ends, m = q l, the turning drag c, the turn rate omega, the thread's
    force F across it at the tail, by the velocity that its pull is measured to give the needle, and its torque T beside
    that,

        m n . B = c omega + F l / 2 + T

    Between two steps the currents are constant, and the angle x from where the needle comes to rest falls by

        tan(x / 2) ~ exp(-t / tau),    tau = c / (m |B|)

    so that the heading is known from the currents alone, but for the gains g and T / m. These and the error s of the
    stamps are the state of a Kalman filter: a pose is compared with the heading at its stamp less s. A needle that
    turns is thus aimed by its field and shows s, and one that does not is aimed by the camera, however late poses are.
    T / m is forgotten in `TORQUE_TIME`; its deviation is `TORQUE_ANGLE` B_0. A factor on all gains does not show in the
    direction: their mean is kept at 1. Without a field the heading is the measured one; its error, `FREE_TURN`, falls
    as x does once there is one, and until then it adds to the variance of a measurement.

    Source: the extended Kalman filter, by central differences over one deviation of s. Deviation: the gains are scaled
    to their mean after each measurement, their covariance is not. Pure: times come in, in seconds of the stamps' clock.

    Args:
        coils: their calibrated field.
        needle: its mechanics.
        aligning_field: B_0, which is kept along the needle [T].
        stamp_error: s at first, as it was measured [s].
    """

    def __init__(
        self, coils: LoopCoils, needle: NeedleMechanics, aligning_field: float, stamp_error: float = 0.0
    ) -> None:
        self._coils, self._needle = coils, needle
        count = len(coils.names)
        self._torque_variance = (TORQUE_ANGLE * aligning_field) ** 2  # of T / m [T^2]
        # Gains, the field that balances the thread's torque [T], and the error of the stamps [s].
        self._state = np.append(np.ones(count), [0.0, stamp_error])
        self._covariance = np.diag([GAIN_DEVIATION**2] * count + [self._torque_variance, STAMP_ERROR**2])
        self._last = -math.inf  # stamp of the last pose
        # By how much stamps are later than the poses were measured, slewed to its estimate [s].
        self.stamp_error = stamp_error
        self._fields = np.zeros((2, count))  # of each coil with its current, as calibrated [T]
        self._angle: float | None = None  # of the chord [rad]
        self._gradient = np.zeros(count + 2)  # of that by the state
        self._pull = 0.0  # across the needle [m/s]
        self._free = 1.0  # share of the error of a heading without a field that is left
        self._now = -math.inf  # time of these [s]
        self._times: list[float] = []  # with what they were
        self._angles: list[float] = []
        self._others: list[tuple[Vector, float]] = []

    @property
    def gains(self) -> Vector:
        """The factors, shape (m,)."""
        return self._state[:-2]

    def balance(self, pull: float = 0.0) -> float:
        """Return the field to the needle's left that balances the thread's torque, (F l / 2 + T) / m [T].

        Args:
            pull: velocity across the needle, to its left, that the thread's force F gives it [m/s].
        """
        needle = self._needle
        return float(self._state[-2]) + 0.5 * needle.drag_across * pull / needle.pole

    @property
    def stamp_deviation(self) -> float:
        """Standard deviation of the stamps' error [s]."""
        return math.sqrt(self._covariance[-1, -1])

    def apply(self, now: float, tail: Vector, heading: Vector, currents: Vector, pull: float = 0.0) -> None:
        """Register the currents from a time on.

        Args:
            now: time of the stamps' clock [s].
            tail: of the needle then, shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            currents: shape (m,) [A].
            pull: see `balance` [m/s].
        """
        self._turn(now)
        self._pull = pull
        tip = self._needle.kinematics.tip(tail, heading)
        self._fields = 0.5 * (self._coils.per_current(tail) + self._coils.per_current(tip)) * currents

    def rest(self, now: float) -> None:
        """Register that the currents are zero from a time on: nothing holds the needle's direction."""
        self._turn(now)
        self._fields, self._gradient, self._free = np.zeros_like(self._fields), np.zeros_like(self._state), 1.0

    def update(self, heading: Vector, stamp: float) -> None:
        """Update with a measured pose.

        Args:
            heading: unit vector at the tail, shape (2,).
            stamp: when it was measured [s].
        """
        e = self._needle.chord_direction(heading)
        measured = math.atan2(e[1], e[0])
        last, self._last = self._last, max(self._last, stamp)
        if stamp > last > -math.inf:
            self._forget(stamp - last)
        if self._angle is None or not self._times or not self._fields.any():
            self._angle, self._gradient = measured, np.zeros_like(self._state)
            self._times, self._angles, self._others = [], [], []
            return
        if stamp <= last:
            return
        deviation, seen = self.stamp_deviation, stamp - float(self._state[-1])
        times = [seen - deviation, seen, seen + deviation]
        before, then, after = np.interp(times, self._times, self._angles).tolist()
        gradient, free = self._others[max(0, bisect_right(self._times, seen) - 1)]
        row = gradient.copy()
        row[-1] = 0.5 * (before - after) / deviation
        bend = 0.5 * (before + after) - then
        spread = self._covariance @ row
        noise = HEADING_ERROR**2 + bend**2 + (FREE_TURN * free) ** 2
        variance = float(row @ spread) + noise
        residual = math.remainder(measured - then, 2.0 * math.pi)
        if residual**2 > OUTLIER**2 * variance:
            if row[-2]:  # its torque is then unknown, and that of the next pose is believed
                self._covariance[-2, -2] += (residual / row[-2]) ** 2
            return
        state = self._state + spread * (residual / variance)
        state[:-2] = np.clip(state[:-2] / state[:-2].mean(), 1.0 - MAX_CHANGE, 1.0 + MAX_CHANGE)
        state[-1] = min(MAX_STAMP_ERROR, max(-MAX_STAMP_ERROR, state[-1]))
        change, self._state = state - self._state, state
        self._covariance -= np.outer(spread, spread) / variance
        self._angle += float(self._gradient @ change)
        slew = MAX_SLEW * min(1.0, stamp - last)
        self.stamp_error += min(slew, max(-slew, float(state[-1]) - self.stamp_error))
        self._angles = [angle + float(g @ change) for angle, (g, _) in zip(self._angles, self._others, strict=True)]

    def angle(self, now: float) -> float | None:
        """Return the chord's direction at a time [rad]; None before the first pose."""
        self._turn(now)
        return self._angle

    def _turn(self, now: float) -> None:
        """Turn the needle towards the field until a time."""
        since, self._now = self._now, now
        if now < since:  # time was set back
            self._angle, self._last = None, -math.inf
            self._times, self._angles, self._others = [], [], []
        if self._angle is None or not -math.inf < since < now:
            return
        if not self._times:
            self._record(since)
        field_x, field_y = (self._fields @ self.gains).tolist()
        size, balance = math.hypot(field_x, field_y), self.balance(self._pull)
        if size > 0.0:
            lead = math.asin(min(0.9, max(-0.9, balance / size)))
            ahead = math.remainder(math.atan2(field_y, field_x) - lead - self._angle, 2.0 * math.pi)
            left = math.exp(-(now - since) * self._needle.pole * self._needle.chord * size / self._needle.turning_drag)
            self._angle += ahead - 2.0 * math.atan(math.tan(0.5 * ahead) * left)
            across = (field_x * self._fields[1] - field_y * self._fields[0]) / size**2
            settled = np.append(across, [-1.0 / (size * math.cos(lead)), 0.0])
            self._gradient, self._free = settled + (self._gradient - settled) * left, self._free * left
        self._record(now)

    def _record(self, now: float) -> None:
        self._times.append(now)
        self._angles.append(self._angle or 0.0)
        self._others.append((self._gradient, self._free))
        while len(self._times) > 2 and self._times[1] < now - KEPT:
            del self._times[0], self._angles[0], self._others[0]

    def _forget(self, interval: float) -> None:
        """Let gains and stamps drift and the thread's torque be forgotten over an interval [s]."""
        kept = math.exp(-interval / TORQUE_TIME)
        self._state[-2] *= kept
        self._covariance[-2] *= kept
        self._covariance[:, -2] *= kept
        drift = np.full(len(self._state), DRIFT_DEVIATION**2 * min(1.0, interval))
        drift[-2:] = (1.0 - kept**2) * self._torque_variance, STAMP_DRIFT**2 * min(1.0, interval)
        self._covariance += np.diag(drift)
        if self.stamp_deviation > STAMP_ERROR:
            self._covariance[-1] *= STAMP_ERROR / self.stamp_deviation
            self._covariance[:, -1] = self._covariance[-1]
            self._covariance[-1, -1] = STAMP_ERROR**2
