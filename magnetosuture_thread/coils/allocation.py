"""From the velocity that is asked of the needle's tip to coil currents."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from magnetosuture_thread.coils.field import CoilModel
from magnetosuture_thread.safety import NeedleKinematics

Vector = NDArray[np.float64]

# Weights of what the currents are for. A drift cannot be kept away everywhere.
DRIVE_WEIGHT = 1.0
TURN_WEIGHT = 1.0
ALIGN_WEIGHT = 0.1
DRIFT_WEIGHT = 1.0
CURRENT_WEIGHT = 1e-3

STEEPEST = 0.8  # sine of the greatest angle between field and needle: beyond, more turns it no faster
SATURATION = 0.05  # a velocity missed by more than this share, at a current limit, counts as saturated


@dataclass(frozen=True)
class NeedleMechanics:
    """What the bridge must know of the needle.

    Attributes:
        length: along the body [m].
        curvature: of its arc, positive to the left of the heading [1/m].
        moment: magnetic moment of the straight needle, from tail to tip [A m^2].
        drag: force along the body for one m/s, with what the thread adds to it [N s/m].
        drag_across: the same across the body [N s/m].
        turning_drag: torque for one rad/s [N m s].
    """

    length: float
    curvature: float
    moment: float
    drag: float
    drag_across: float
    turning_drag: float

    @cached_property
    def kinematics(self) -> NeedleKinematics:
        """How a velocity of the tip moves it."""
        return NeedleKinematics(self.length, self.curvature)

    @property
    def chord(self) -> float:
        """Distance from tail to tip [m]."""
        return self.kinematics.chord

    @property
    def pole(self) -> float:
        """Strength q of the poles at tail and tip [A m]."""
        return self.moment / self.length

    def chord_direction(self, heading: Vector) -> Vector:
        """Return the unit vector from tail to tip for the heading at the tail, shapes (2,)."""
        return self.kinematics.chord_direction(heading)


@dataclass(frozen=True)
class Allocation:
    """Currents and what they reach.

    Attributes:
        currents: of each coil, shape (m,) [A].
        velocity: of the tip, that these currents give by the bridge's model, shape (2,) [m/s].
        saturated: whether a current limit keeps the needle from the velocity asked for.
    """

    currents: Vector
    velocity: Vector
    saturated: bool

    def scaled(self, share: float) -> Allocation:
        """Return a share of the currents; the velocity is linear in them."""
        return self if share == 1.0 else Allocation(share * self.currents, share * self.velocity, self.saturated)


class CoilAllocation:
    """Turns a velocity of the needle's tip into currents.

    A slender magnet in a viscous liquid turns into the field within hundredths of a second, and is pulled
    along where the field grows. With the unit vector e from tail to tip, n across, the chord l, the
    poles -q, +q at tail and tip and q = m / length, the currents give the tip the velocity

        v . e = F . e / drag                                  F = q (B_tip - B_tail)
        v . n = F . n / drag_across + omega l / 2             omega = q l B . n / turning_drag

    with the mean field B of both ends. They are the bounded least-squares solution of: both velocities;
    a field B_0 along the needle, which holds its direction; little force across, which is there in most
    places since the field grows towards the coils, and makes the needle drift; and little current. The
    needle turns against a drift that is left until it crabs along its way. A zero velocity takes zero
    currents.

    Source: none.

    Args:
        coils: their field.
        needle: its mechanics.
        aligning_field: B_0 [T].
        max_current: in either direction [A].
    """

    def __init__(self, coils: CoilModel, needle: NeedleMechanics, aligning_field: float, max_current: float) -> None:
        self.names = coils.names
        self._coils = coils
        self._needle = needle
        self._field = aligning_field
        self._max_current = max_current

    def zero(self) -> Allocation:
        """Return no current in any coil."""
        return Allocation(np.zeros(len(self.names)), np.zeros(2), False)

    def allocate(
        self,
        velocity: Vector,
        tail: Vector,
        heading: Vector,
        before: Vector | None = None,
        largest_change: float = math.inf,
    ) -> Allocation:
        """Return the currents for a tip velocity.

        Args:
            velocity: of the tip, shape (2,) [m/s].
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).
            before: the currents until now, from which each may differ by `largest_change` [A], shape (m,);
                from any if None.
            largest_change: see there; not held where the velocity is zero.
        """
        if not np.any(velocity):
            return self.zero()
        needle = self._needle
        e = needle.chord_direction(heading)
        n = np.array([-e[1], e[0]])
        lever = 0.5 * needle.chord
        at_tail, at_tip = self._coils.per_current(tail), self._coils.per_current(tail + needle.chord * e)
        mean = 0.5 * (at_tail + at_tip)
        pull = needle.pole * (at_tip - at_tail)
        along = e @ pull / needle.drag
        drift = n @ pull / needle.drag_across
        turning = lever * needle.pole * needle.chord / needle.turning_drag * (n @ mean)
        # A tip speed of `fastest` takes a field at the steepest angle that still turns the needle faster.
        fastest = STEEPEST * lever * needle.pole * needle.chord / needle.turning_drag * self._field
        sideways = min(fastest, max(-fastest, float(velocity @ n)))
        usual = needle.pole * self._field / needle.drag  # a speed: what the field at one pole would give
        system = np.vstack(
            [
                DRIVE_WEIGHT / usual * along,
                TURN_WEIGHT * STEEPEST / fastest * (turning + drift),
                ALIGN_WEIGHT / self._field * (e @ mean),
                DRIFT_WEIGHT / usual * drift,
                CURRENT_WEIGHT / self._max_current * np.eye(len(self.names)),
            ]
        )
        target = np.zeros(len(system))
        target[0] = DRIVE_WEIGHT / usual * float(velocity @ e)
        target[1] = TURN_WEIGHT * STEEPEST / fastest * sideways
        target[2] = ALIGN_WEIGHT
        limit = np.full(len(self.names), self._max_current)
        lower, upper = -limit, limit
        if before is not None:
            lower = np.clip(before - largest_change, -limit, limit)
            upper = np.clip(before + largest_change, -limit, limit)
        # Most solutions are well inside of the limits, and then plain least squares is one of them.
        currents = np.asarray(np.linalg.lstsq(system, target, rcond=None)[0], dtype=np.float64)
        if np.any((currents < lower) | (currents > upper)):
            # Bounds that meet are refused by the solver; so little apart they do no harm.
            found = lsq_linear(system, target, bounds=(lower, np.maximum(upper, lower + 1e-9)), method="bvls")
            currents = np.clip(found.x, lower, upper)
        reached = float(along @ currents) * e + float((turning + drift) @ currents) * n
        missed = float(np.linalg.norm(reached - velocity)) > SATURATION * float(np.linalg.norm(velocity))
        return Allocation(currents, reached, missed and bool(np.any(np.abs(currents) >= 0.999 * limit)))
