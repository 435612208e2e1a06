"""The needle's motion by its measured poses: a Kalman filter of pose and velocity."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.thread.prediction import NeedleMotion, NeedlePose

Vector = NDArray[np.float64]

ACCELERATION = 1.5e-3  # m/s per root of a second; random walk of the velocity, as tracked needles move in closed loop
TURNING = 0.2  # rad/s per root of a second; the same of the rate of turning
MAX_SPEED, MAX_TURNING = 0.01, 3.0  # m/s, rad/s; standard deviations of a velocity of which nothing is known
MANEUVER = 16.0  # normalized square of three innovations, of which a motion without a change of mind exceeds 0.1 %
MAX_INTERVAL = 0.2  # s; between poses farther apart nothing is known of the motion
SIZE = 6


class NeedleMotionFilter:
    """Estimates pose and velocity of a needle from poses with known deviations, in the plane.

    The state is tail, angle of the heading, velocity of the tail along the heading and across it, and rate of turning.
    Velocities are random walks in the needle's own frame, so that a needle on a circle has a constant one:

        x' = v_1 t + v_2 n,    theta' = omega,    v', omega' = white noise

    Differences of poses have too much noise: with 10 um at 60 Hz it is 0.8 mm/s. Where a pose is farther from the
    prediction than `MANEUVER`, the needle has changed its motion, and its velocity is taken anew from then on.

    Source: Bar-Shalom, Li and Kirubarajan 2001, extended Kalman filter with white-noise acceleration and maneuver
    detection. Deviation: the velocity is in the needle's frame.
    """

    def __init__(self) -> None:
        self._state, self._covariance = np.zeros(SIZE), np.zeros((SIZE, SIZE))
        self._stamp = -math.inf

    def reset(self) -> None:
        """Forget the motion."""
        self._stamp = -math.inf

    def update(self, pose: NeedlePose) -> NeedlePose:
        """Return a measured pose with what the poses before say of it, and its motion.

        One whose deviations are not known, that is the first for a while, or not later than the last, is returned as
        it is.

        Args:
            pose: finite, in the plane, with a unit heading.
        """
        interval, (place, angle) = pose.stamp - self._stamp, pose.deviation
        if interval <= 0.0:
            return pose
        if not (place > 0.0 and angle > 0.0 and math.isfinite(place) and math.isfinite(angle)):
            self.reset()
            return pose
        measured = np.array([*pose.tail, math.atan2(pose.heading[1], pose.heading[0])])
        self._stamp = pose.stamp
        if interval > MAX_INTERVAL:
            self._state[:], self._covariance[:] = 0.0, 0.0
            self._state[:3] = measured
            variances = [place**2, place**2, angle**2, MAX_SPEED**2, MAX_SPEED**2, MAX_TURNING**2]
            np.fill_diagonal(self._covariance, variances)
            return pose
        filter_pose(self._state, self._covariance, measured, interval, place**2, angle**2)
        c, s = math.cos(self._state[2]), math.sin(self._state[2])
        along, across, turning = self._state[3:].tolist()
        own = np.diagonal(self._covariance)
        return replace(
            pose,
            tail=self._state[:2].copy(),
            heading=np.array([c, s]),
            deviation=(math.sqrt(0.5 * (own[0] + own[1])), math.sqrt(own[2])),
            motion=NeedleMotion(np.array([along * c - across * s, along * s + across * c]), turning),
        )


def filter_pose(
    state: Vector, covariance: Vector, measured: Vector, interval: float, place: float, angle: float
) -> None:
    """Predict a state over an interval [s] and correct it by a measured tail and angle with these variances."""
    before = covariance.copy()
    middle = float(state[2] + 0.5 * interval * state[5])
    c, s = math.cos(middle), math.sin(middle)
    x, y = state[3] * c - state[4] * s, state[3] * s + state[4] * c
    state[:3] += interval * x, interval * y, interval * state[5]
    move, noise = _motion(x, y, c, s, interval)
    covariance[:] = move @ before @ move.T + noise
    innovation = measured - state[:3]
    innovation[2] = math.remainder(innovation[2], 2.0 * math.pi)
    variances = np.diag((place, place, angle))
    inverse = np.linalg.inv(covariance[:3, :3] + variances)
    if innovation @ inverse @ innovation > MANEUVER:
        before[3:, :], before[:, 3:] = 0.0, 0.0
        before[3, 3] = before[4, 4] = MAX_SPEED**2
        before[5, 5] = MAX_TURNING**2
        covariance[:] = move @ before @ move.T + noise
        inverse = np.linalg.inv(covariance[:3, :3] + variances)
    gain = covariance[:, :3] @ inverse
    state += gain @ innovation
    covariance -= gain @ covariance[:3, :]


def _motion(x: float, y: float, c: float, s: float, interval: float) -> tuple[Vector, Vector]:
    """Return how errors of a state move over an interval [s], and the covariance that noise in its middle adds.

    Args:
        x: velocity of the tail in the middle [m/s].
        y: the same.
        c: cosine of the heading's angle in the middle.
        s: its sine.
        interval: [s].
    """
    move = np.eye(SIZE)
    move[0, 2:] = -interval * y, interval * c, -interval * s, -0.5 * interval**2 * y
    move[1, 2:] = interval * x, interval * s, interval * c, 0.5 * interval**2 * x
    move[2, 5] = interval
    half = np.zeros((SIZE, 3))  # from the middle on, of the velocities
    half[:2] = 0.5 * interval * np.array([[c, -s, 0.0], [s, c, 0.0]])
    half[2, 2] = 0.5 * interval
    half[3:] = np.eye(3)
    rates = interval * np.array([ACCELERATION**2, ACCELERATION**2, TURNING**2])
    return move, (half * rates) @ half.T
