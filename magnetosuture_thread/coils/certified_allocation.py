"""Coil currents whose motion of the needle the safety filter certifies."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import Allocation, CoilAllocation
from magnetosuture_thread.coils.motion_observer import MotionDisturbance
from magnetosuture_thread.coils.pose_extrapolator import Pose
from magnetosuture_thread.safety import NeedleSafetyFilter

Vector = NDArray[np.float64]

MAX_CORRECTIONS = 4  # of the drift that the coils add to a velocity towards the wall
MIN_SHARE = 0.98  # certified share of a velocity above which no further correction is made


class CertifiedAllocation:
    """Allocates currents for a velocity, and reduces them until their motion is certified for the hold time.

    The motion that is certified is that of the currents and of the measured disturbance. Where it is not, as much of
    the velocity is taken as is, while the currents against the disturbance stay, as far as they are certified without
    it. Where nothing is known of a disturbance, all currents are scaled by the certified share.

    Args:
        coils: allocate the currents.
        max_speed: of the tip by the currents [m/s].
    """

    def __init__(self, coils: CoilAllocation, max_speed: float) -> None:
        self._coils = coils
        self._max_speed = max_speed

    @property
    def names(self) -> tuple[str, ...]:
        """The coils' names, in the order of their currents."""
        return self._coils.names

    def zero(self) -> Allocation:
        """Return zero currents."""
        return self._coils.zero()

    def set_gains(self, gains: Vector) -> None:
        """Set by which factor each coil's field differs from its calibration, shape (m,)."""
        self._coils.gains = gains

    def chord_direction(self, heading: Vector) -> Vector:
        """Return the unit vector from tail to tip for the heading at the tail, shapes (2,)."""
        return self._coils.chord_direction(heading)

    def allocate(
        self,
        velocity: Vector,
        pose: Pose,
        safety: NeedleSafetyFilter,
        previous: Allocation,
        max_change: float,
        disturbance: MotionDisturbance | None,
        pull: Vector,
    ) -> tuple[Allocation, str]:
        """Return the currents, and what limits them; empty if nothing does.

        Args:
            velocity: wanted of the tip, shape (2,) [m/s].
            pose: of the needle now.
            safety: certifies motions.
            previous: of the last step.
            max_change: maximum change of each current [A].
            disturbance: measured, which the currents compensate; None where nothing is measured.
            pull: predicted velocity of the tip by the thread's pull, which they compensate too, shape (2,) [m/s]; both
                motions are certified, with it and without.
        """
        beside = np.zeros(2)
        if disturbance is not None:
            beside = disturbance.velocity(self._coils.chord_direction(pose.heading))
        velocity = self._within_limit(velocity - pull) - beside

        def certified(found: Allocation, added: Vector) -> tuple[float, str]:
            drift = 0.0 if disturbance is None else found.drift + disturbance.drift
            return safety.safe_share(found.velocity + added, pose.tail, pose.heading, drift)

        def allocated(wanted: Vector) -> Allocation:
            return self._coils.allocate(wanted, pose.tail, pose.heading, previous.currents, max_change, disturbance)

        target, best, min_error, limiting = velocity, self._coils.zero(), math.inf, ""
        for _ in range(1 + MAX_CORRECTIONS):
            found = allocated(target)
            share, name = certified(found, beside)
            if pull.any():
                share, name = min((share, name), certified(found, beside + pull))
            kept = found.scaled(share)
            if share < 1.0 and disturbance is not None:
                kept = allocated(-beside).towards(found, share)
                own, _ = safety.safe_share(kept.velocity, pose.tail, pose.heading, kept.drift)
                kept = kept.scaled(own)
            error = math.hypot(*(kept.velocity - velocity))
            if error < min_error:
                best, min_error, limiting = kept, error, name
            if share >= MIN_SHARE:
                break
            clear, _ = safety.nearest_clear(found.velocity + beside, pose.tail, pose.heading)
            target = target - (found.velocity + beside - clear)
        return best, limiting

    def _within_limit(self, velocity: Vector) -> Vector:
        """Return a velocity reduced to the maximum speed of the tip."""
        speed = math.hypot(*velocity)
        return velocity if speed <= self._max_speed else velocity * (self._max_speed / speed)
