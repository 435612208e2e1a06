"""Coil currents whose motion of the needle the safety filter certifies."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import Allocation, CoilAllocation
from magnetosuture_thread.coils.motion_observer import MotionDisturbance
from magnetosuture_thread.coils.pose_extrapolator import Pose
from magnetosuture_thread.safety import NeedleSafetyFilter
from magnetosuture_thread.safety.filter import SPEED

Vector = NDArray[np.float64]

MAX_CORRECTIONS = 4  # of the drift that the coils add to a velocity towards the wall
MIN_SHARE = 0.98  # certified share of a velocity above which no further correction is made


class CertifiedAllocation:
    """Allocates currents for a velocity, and reduces them until their motion is certified for the hold time.

    The motion that is certified is that of the currents and of the measured disturbance. Where it is not, as much of
    the velocity is taken as is, while the currents against the disturbance stay, as far as they are certified without
    it. Where no currents hold the needle against the disturbance, as on a coil's axis, and that alone is not certified,
    the velocity is certified by itself: else none would be, not even one along the shape or off the axis. Where nothing
    is known of a disturbance, all currents are scaled by the certified share.

    A needle cannot turn away from what it lies along, as its other end would come closer. Where a disturbance is
    measured, the currents therefore take it off sideways by their force across it, see `NeedleSafetyFilter.sidestep`.

    Args:
        coils: allocate the currents.
        max_speed: of the needle by the force of the currents, with a slack thread [m/s].
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
        max_sidestep: float = 0.0,
    ) -> tuple[Allocation, str]:
        """Return the currents, and what limits them; empty if nothing does.

        Args:
            velocity: filtered, of the tip, shape (2,) [m/s].
            pose: of the needle now.
            safety: certifies motions.
            previous: of the last step.
            max_change: maximum change of each current [A].
            disturbance: measured, which the currents compensate; None where nothing is measured.
            max_sidestep: at which the needle may be taken off sideways; never where nothing is measured [m/s].
        """
        if disturbance is None:
            return self._allocate(velocity, pose, safety, previous, max_change, None, 0.0)
        sidestep = min(max_sidestep, max(-max_sidestep, safety.sidestep(pose.tail, pose.heading)))
        disturbed = disturbance.velocity(self._coils.chord_direction(pose.heading))
        best, max_share = (self._coils.zero(), ""), -1.0
        for step in (sidestep, 0.0) if sidestep else (0.0,):
            found = self._allocate(velocity, pose, safety, previous, max_change, disturbance, step)
            motion, drift = found[0].velocity + disturbed, found[0].drift + disturbance.drift
            share, _ = safety.safe_share(motion, pose.tail, pose.heading, drift)
            if share > max_share:
                best, max_share = found, share
            if share >= MIN_SHARE:
                break  # else it may be the step that brings the needle too close to something else
        return best

    def _allocate(
        self,
        velocity: Vector,
        pose: Pose,
        safety: NeedleSafetyFilter,
        previous: Allocation,
        max_change: float,
        disturbance: MotionDisturbance | None,
        sidestep: float,
    ) -> tuple[Allocation, str]:
        """Return currents for a velocity of the tip, and of the whole needle across its chord; see `allocate`."""
        disturbed = aside = np.zeros(2)
        to_compensate = disturbance
        if disturbance is not None:
            e = self._coils.chord_direction(pose.heading)
            disturbed, aside = disturbance.velocity(e), sidestep * np.array([-e[1], e[0]])
            to_compensate = disturbance._replace(drift=disturbance.drift - sidestep)
        velocity = velocity + aside - disturbed

        def certified(found: Allocation, added: Vector) -> tuple[float, str]:
            drift = 0.0 if disturbance is None else found.drift + disturbance.drift
            return safety.safe_share(found.velocity + added, pose.tail, pose.heading, drift)

        def allocated(target: Vector) -> tuple[Allocation, str]:
            found = self._coils.allocate(
                target, pose.tail, pose.heading, previous.currents, max_change, to_compensate, pose.age
            )
            speed = self._coils.slack_speed(found, pose.heading)
            return (found.scaled(self._max_speed / speed), SPEED) if speed > self._max_speed else (found, "")

        target, best, min_error, limiting = velocity, self._coils.zero(), math.inf, ""
        resting: Allocation | None = None  # against the disturbance alone
        for _ in range(1 + MAX_CORRECTIONS):
            found, bound = allocated(target)
            share, name = certified(found, disturbed)
            name = name or bound
            kept, turning = found.scaled(share), found.velocity + disturbed - aside
            if share < 1.0 and disturbance is not None:
                resting = resting or allocated(aside - disturbed)[0]
                if certified(resting, disturbed)[0] < 1.0:
                    turning, drift = found.velocity - resting.velocity, found.drift - resting.drift
                    share, name = safety.safe_share(turning, pose.tail, pose.heading, drift)
                kept = resting.towards(found, share)
                own, _ = safety.safe_share(kept.velocity, pose.tail, pose.heading, kept.drift)
                kept = kept.scaled(own)
            error = math.hypot(*(kept.velocity - velocity))
            if error < min_error:
                best, min_error, limiting = kept, error, name
            if share >= MIN_SHARE:
                break
            clear, _ = safety.nearest_clear(turning, pose.tail, pose.heading)
            target = target - (turning - clear)
        return best, limiting
