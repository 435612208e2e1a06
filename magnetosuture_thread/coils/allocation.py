"""Coil currents for a velocity of the needle: bounded least squares, certified by the safety filter."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.field import LoopCoils
from magnetosuture_thread.coils.filter import SPEED, NeedleSafetyFilter
from magnetosuture_thread.coils.inputs import Pose
from magnetosuture_thread.coils.needle_motion import NeedleKinematics, NeedleTwist

Vector = NDArray[np.float64]
Certificate = Callable[["Allocation"], tuple[float, str]]

# Weights of the least-squares objectives; that of velocity and drift, which cannot be avoided everywhere, is 1.
# The aligning field's own gradient pulls across the needle: at headings close to a coil's axis both cannot be had, and
# a needle that drifts cannot be steered. In a field against it the needle would turn round: the least field along it is
# a constraint, by its weight.
ALIGN_WEIGHT, TURN_WEIGHT = 0.01, 10.0
MIN_ALIGNING_SHARE, CONSTRAINT_WEIGHT = 0.4, 100.0
CURRENT_WEIGHT = 1e-3

HEADING_ERROR = 0.006  # rad; of a needle's measured pose
HEADING_STEP, PLACE_STEP = 0.01, 1e-4  # rad and m; for the derivatives by heading and place
COIL_ERROR = 0.015  # of a coil's field, with its gain estimated: in some seconds, by a needle that is driven
CORRECTION_TIME = 0.2  # s; within which poses show that the needle is turned from where the field was set for
FIELD_ROUNDS, FIELD_TOLERANCE = 6, 0.03  # solutions, until the field along the needle is known to this share
LEAST_FIELD = 1e-6  # T; in a weaker one the needle is turned by its torque alone
MAX_FIELD_ANGLE_SINE = 0.8  # between field and needle; a larger angle turns the needle no faster
SATURATION_TOLERANCE = 0.05  # relative velocity error at a current limit, above which the command is saturated
BISECTIONS = 7  # of the certified share: to 1 %, and never beyond it


@dataclass(frozen=True)
class NeedleMechanics:
    """Geometry, magnetic moment and drag of the needle.

    Attributes:
        length: along the body [m].
        curvature: of its arc, positive to the left of the heading [1/m].
        moment: magnetic moment of the straight needle, from tail to tip [A m^2].
        drag: force along the body for one m/s [N s/m].
        drag_across: the same across the body [N s/m].
        turning_drag: torque for one rad/s [N m s].
        slack_drag: drag along the body while the thread is slack and adds nothing [N s/m].
        max_pull: greatest force of the thread that is compensated [N].
    """

    length: float
    curvature: float
    moment: float
    drag: float
    drag_across: float
    turning_drag: float
    slack_drag: float
    max_pull: float = math.inf

    @cached_property
    def kinematics(self) -> NeedleKinematics:
        """Kinematics of the needle under a tip velocity."""
        return NeedleKinematics(self.length, self.curvature)

    @property
    def chord(self) -> float:
        """Distance from tail to tip [m]."""
        return self.kinematics.chord

    @property
    def max_pull_speed(self) -> float:
        """Greatest velocity that the thread's pull gives the needle [m/s]."""
        return self.max_pull / self.slack_drag

    @property
    def pole(self) -> float:
        """Strength q of the poles at tail and tip [A m]."""
        return self.moment / self.length

    def chord_direction(self, heading: Vector) -> Vector:
        """Return the unit vector from tail to tip for the heading at the tail, shapes (2,)."""
        return self.kinematics.chord_direction(heading)


@dataclass(frozen=True)
class Allocation:
    """Coil currents and the tip velocity that they give.

    Attributes:
        currents: of each coil, shape (m,) [A].
        velocity: of the tip with these currents by the bridge's model, shape (2,) [m/s].
        saturated: whether a current limit keeps the needle from the commanded velocity.
        drift: velocity of the needle's middle across the chord, to its left, by the currents' force [m/s].
    """

    currents: Vector
    velocity: Vector
    saturated: bool
    drift: float = 0.0


class PoseDeviation(NamedTuple):
    """Standard deviations of a needle's measured pose.

    Attributes:
        place: in each direction, until a next pose can be answered [m].
        stamp: of its time [s].
    """

    place: float = 0.0
    stamp: float = 0.0


EXACT = PoseDeviation()


class CoilAllocation:
    """Allocates coil currents for a velocity of the needle's tip.

    A slender magnet in a viscous liquid aligns with the field within hundredths of a second, and is pulled
    along the field's gradient. With the unit vector e from tail to tip, n across, the chord l, the
    poles -q, +q at tail and tip and q = m / length, the currents give the tip the velocity

        v . e = F . e / drag                                  F = q (B_tip - B_tail)
        v . n = F . n / drag_across + omega l / 2             omega = (1 - exp(-T / tau)) (B . n - b) / (B . e T)

    with the mean field B of both ends, which lasts for the period T, the field b that balances the torque of the
    thread, and tau = turning_drag / (q l B . e), in which the needle turns towards them. They are the bounded
    least-squares solution of: the velocities along and across by force, and the turn rate, as wanted; a field B_0 along
    the needle, which holds its direction; and little current. The field along the needle may fall to
    `MIN_ALIGNING_SHARE` B_0, not below.

    What errors of the coils (`COIL_ERROR`) and of the heading would do to drift and direction counts too. The deviation
    of the heading is

        |(`HEADING_ERROR`, omega s_t, s |dB/dn . n| / (B . e), `COIL_ERROR` |a| / (B . e))|

    with the turn rate omega, the deviations s_t of the time of its pose and s of its place, and the field a of each
    coil across it. A needle beside its place turns with the field there. Close to a coil's axis, where large fields
    cancel each other, one that is held against a pull is therefore in an unstable balance: the later its poses are, the
    less of the pull is held. These fields are those of the solution before, from that of the last currents on.

    Source: none.

    Args:
        coils: their field.
        needle: its mechanics.
        aligning_field: B_0 [T].
        max_current: in either direction [A].
        period: T, for which currents last [s].

    Attributes:
        response_time: T / (1 - exp(-T / tau)) with B . e = B_0, in which a needle turns by its angle to the field [s].
        names: of the coils, in the order of their currents.
        gains: by which factor each coil's field differs from its calibration, shape (m,); 1 until something is known.
    """

    def __init__(
        self, coils: LoopCoils, needle: NeedleMechanics, aligning_field: float, max_current: float, period: float = 0.0
    ) -> None:
        # Here, so that it delays no command, and nobody who reads settings alone.
        from scipy.optimize import lsq_linear

        self._solve_bounded = lsq_linear
        self.names = coils.names
        self._coils = coils
        self._needle = needle
        self._field = aligning_field
        self._max_current = max_current
        self.gains = np.ones(len(self.names))
        self._period = period
        self.response_time = self._response(aligning_field) / aligning_field

    def _response(self, field: float) -> float:
        """Return the field across the needle by which it turns, in a field along it [T], for 1 rad/s [T s]."""
        slow = self._needle.turning_drag / (self._needle.pole * self._needle.chord)
        return self._period * field / -math.expm1(-self._period * field / slow) if self._period else slow

    @staticmethod
    def _doubt(measured: float, bent: float, across: Vector, field: float) -> float:
        """Return the deviation of the heading [rad].

        Args:
            measured: of the measured heading, carried to now [rad].
            bent: deviation of the field across the needle by that of its place [T].
            across: field of each coil across the needle, shape (m,) [T], with an error of `COIL_ERROR`.
            field: along it [T].
        """
        return math.hypot(measured, bent / field, COIL_ERROR * float(np.linalg.norm(across)) / field)

    def slack_speed(self, allocation: Allocation, heading: Vector) -> float:
        """Return the speed that the force of allocated currents gives a needle that lies along it, with a slack thread.

            |F| / slack_drag

        That is the greatest, as the drag across the needle is higher.

        Args:
            allocation: the currents, and what they give by the model.
            heading: unit vector along the needle at its tail, shape (2,).
        """
        needle = self._needle
        along = needle.drag * float(needle.chord_direction(heading) @ allocation.velocity)
        return math.hypot(along, needle.drag_across * allocation.drift) / needle.slack_drag

    def zero(self) -> Allocation:
        """Return zero currents."""
        return Allocation(np.zeros(len(self.names)), np.zeros(2), False)

    def allocate(
        self,
        twist: NeedleTwist,
        tail: Vector,
        heading: Vector,
        previous: Vector | None = None,
        max_change: float = math.inf,
        deviation: PoseDeviation = EXACT,
        *,
        balance: float = 0.0,
        at_tip: bool = False,
    ) -> Allocation:
        """Return the currents for a motion of the needle; for none, those that hold its direction.

        Args:
            twist: that the currents are to give.
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).
            previous: currents of the last step, shape (m,) [A]; no limit on change if None.
            max_change: maximum change of each current [A].
            deviation: of the needle's pose.
            balance: b, to the needle's left [T].
            at_tip: whether the tip is to move as it would by that motion: then the needle turns against what the
                currents add across it, and errors do not count. Else it turns as commanded.
        """
        needle = self._needle
        e = needle.chord_direction(heading)
        n = np.array([-e[1], e[0]])
        lever = 0.5 * needle.chord
        middle = tail + lever * e
        along, across, across_field, along_field = self._rows(middle, e)
        # From the field at one pole alone: velocities count by the force that they take.
        along_speed, across_speed = (needle.pole * self._field / drag for drag in (needle.drag, needle.drag_across))
        # What a coil's error does to drift and direction, for one ampere. Close to the coils' axes a force across
        # the needle takes large currents whose fields cancel each other, and their errors do not.
        swung = lever / CORRECTION_TIME * across_field / (MIN_ALIGNING_SHARE * self._field)
        effort = np.hypot(CURRENT_WEIGHT / self._max_current, COIL_ERROR / across_speed * np.hypot(across, swung))
        # And what an error of the heading does to the drift: in a crossing it is on the other side of the axis.
        beside = math.cos(HEADING_STEP) * e + math.sin(HEADING_STEP) * n
        measured = math.hypot(HEADING_ERROR, twist.turn_rate * deviation.stamp)
        bend = deviation.place / PLACE_STEP * (self._rows(middle + PLACE_STEP * n, e)[2] - across_field)
        misaligned = (self._rows(middle, beside)[1] - across) / (HEADING_STEP * across_speed)
        if at_tip:  # a drift by such an error is corrected by the turn, as any other
            effort, misaligned = np.full(len(self.names), CURRENT_WEIGHT / self._max_current), np.zeros(len(self.names))
        system = np.vstack(
            [
                along / along_speed,
                np.zeros(len(self.names)),
                ALIGN_WEIGHT / self._field * along_field,
                across / across_speed,
                np.zeros(len(self.names)),
                np.diag(effort),
            ]
        )
        target = np.zeros(len(system))
        target[:4] = twist.along / along_speed, 0.0, ALIGN_WEIGHT, twist.across / across_speed
        limit = np.full(len(self.names), self._max_current)
        lower, upper = -limit, limit
        if previous is not None:
            lower, upper = (np.clip(previous + change, -limit, limit) for change in (-max_change, max_change))
        field, least = self._field, MIN_ALIGNING_SHARE * self._field
        doubt = measured
        if previous is not None and previous.any():  # from which what is looked for is not far
            field = max(float(along_field @ previous), least)
            doubt = self._doubt(measured, float(bend @ previous), across_field * previous, field)
        for _ in range(FIELD_ROUNDS):
            system[4] = doubt * misaligned
            response = self._response(field)
            turning, torque = lever / response * across_field, lever / response * balance
            # A tip speed of `max_turn_speed` needs a field at the largest angle that still turns the needle faster.
            max_turn_speed = MAX_FIELD_ANGLE_SINE * lever * field / response
            turned = min(max_turn_speed, max(-max_turn_speed, lever * twist.turn_rate + torque))
            turn_weight = TURN_WEIGHT * MAX_FIELD_ANGLE_SINE / max_turn_speed
            system[1] = turn_weight * (turning + across if at_tip else turning)
            target[1] = turn_weight * turned
            currents = self._bounded_least_squares(system, target, lower, upper)
            if along_field @ currents < least:
                # A constraint that the optimum violates is active in the constrained optimum.
                system[2] = CONSTRAINT_WEIGHT / self._field * along_field
                target[2] = CONSTRAINT_WEIGHT * MIN_ALIGNING_SHARE
                currents = self._bounded_least_squares(system, target, lower, upper)
            before, field = field, max(float(along_field @ currents), least)
            last, solved = doubt, self._doubt(measured, float(bend @ currents), across_field * currents, field)
            doubt = math.sqrt(last * solved)
            if max(abs(field - before) / before, abs(doubt - last) / last) <= FIELD_TOLERANCE:
                break
        found = self.motion(currents, tail, heading, balance)
        wanted = twist.along * e + (lever * twist.turn_rate + twist.across) * n
        inaccurate = math.hypot(*(found.velocity - wanted)) > SATURATION_TOLERANCE * math.hypot(*wanted)
        return replace(found, saturated=inaccurate and bool(np.any(np.abs(currents) >= 0.999 * limit)))

    def motion(self, currents: Vector, tail: Vector, heading: Vector, balance: float = 0.0) -> Allocation:
        """Return currents, shape (m,) [A], with the motion that they give the needle; see `allocate`."""
        e = self._needle.chord_direction(heading)
        lever, n = 0.5 * self._needle.chord, np.array([-e[1], e[0]])
        along, drift, across_field, field = (self._rows(tail + lever * e, e) @ currents).tolist()
        swing = lever * (across_field - balance) / self._response(max(field, LEAST_FIELD))
        return Allocation(currents, along * e + (swing + drift) * n, False, drift)

    def _rows(self, middle: Vector, e: Vector) -> Vector:
        """Return what one ampere in each coil gives a needle with its chord along e, shape (4, m).

        Rows: velocity along the chord and across it, to its left [m/s]; mean field across it and along it [T].
        """
        needle, n = self._needle, np.array([-e[1], e[0]])
        at_tail = self.gains * self._coils.per_current(middle - 0.5 * needle.chord * e)
        at_tip = self.gains * self._coils.per_current(middle + 0.5 * needle.chord * e)
        pull, mean = needle.pole * (at_tip - at_tail), 0.5 * (at_tail + at_tip)
        return np.vstack([e @ pull / needle.drag, n @ pull / needle.drag_across, n @ mean, e @ mean])

    def axes(self) -> tuple[tuple[float, float], ...]:
        """Return the directions, of half a turn, in which the coils hold no needle against a pull across it.

        By currents of norm one that neither drive nor turn it nor change the field along it, a needle in the dish's
        middle is given across it at the most the velocity

            A(theta) = |(1 - P) w|

        with the row w of that velocity, and P the projection onto the rows of the other three. An axis is where A falls
        to less than half of what it is elsewhere: four coils have two, six have none. The error `COIL_ERROR` of a
        current I turns the field, of strength B_0 and b for one ampere, and with it the needle. Currents that turn it
        by no more than `HEADING_ERROR` hold it against

            dA / dtheta I,    I = min(HEADING_ERROR B_0 / (COIL_ERROR b), max_current)

        for each radian off an axis.

        Returns:
            Each axis [rad] with that velocity [m/s].
        """

        def authority(angle: float) -> float:
            rows = self._rows(np.zeros(2), np.array([math.cos(angle), math.sin(angle)]))
            kept = np.linalg.qr(rows[[0, 2, 3]].T)[0]
            return float(np.linalg.norm(rows[1] - kept @ (kept.T @ rows[1])))

        field = float(np.linalg.norm(self._rows(np.zeros(2), np.array([1.0, 0.0]))[2:], axis=0).max())
        current = min(HEADING_ERROR * self._field / (COIL_ERROR * field), self._max_current)
        found, axes = np.array([authority(angle) for angle in np.radians(np.arange(180.0))]), []
        minima = (found < np.roll(found, 1)) & (found <= np.roll(found, -1)) & (found < 0.5 * found.max())
        for angle in np.radians(np.flatnonzero(minima)).tolist():
            before, after = authority(angle - HEADING_STEP), authority(angle + HEADING_STEP)
            axis = round(angle + HEADING_STEP * (before - after) / (before + after), 6)  # it grows alike beside
            axes.append((axis, 0.5 * (before + after) / HEADING_STEP * current))
        return tuple(axes)

    def _bounded_least_squares(self, system: Vector, target: Vector, lower: Vector, upper: Vector) -> Vector:
        """Return the x of least |system x - target| within bounds, shapes (k, m), (k,), (m,) and (m,)."""
        # Most solutions are inside the bounds, where the unconstrained one is optimal.
        found: Vector = np.linalg.lstsq(system, target, rcond=None)[0].astype(np.float64, copy=False)
        if ((found >= lower) & (found <= upper)).all():
            return found
        # The solver rejects equal bounds; the small gap has no effect.
        bounds = (lower, np.maximum(upper, lower + 1e-9))
        return np.clip(self._solve_bounded(system, target, bounds=bounds, method="bvls").x, lower, upper)


class CertifiedAllocation:
    """Allocates currents for a motion of the needle against a pull, as far as that is certified for the hold time.

    With the currents I of the motion that is wanted, and I_hold of those that keep the needle in its place,

        I_hold + s (I - I_hold)    with the greatest s, 0 to 1, whose motion is certified together with the pull

    Where even I_hold is not, as no currents keep the needle there, I - I_hold is certified by itself, and so are then
    all currents: else the needle could not be turned to where there are. Without a pull I_hold is zero.

    Their force gives a needle with a slack thread at most `max_speed`, and against a pull at most the speed that is
    wanted and `max_pull_speed` more, whatever that pull is said to be.

    Args:
        coils: allocate the currents.
        max_speed: of the needle by the force of the currents, with a slack thread [m/s].
        max_pull_speed: see `NeedleMechanics` [m/s].
    """

    def __init__(self, coils: CoilAllocation, max_speed: float, max_pull_speed: float = math.inf) -> None:
        self._coils, self._max_speed, self._max_pull_speed = coils, max_speed, max_pull_speed

    def allocate(
        self,
        twist: NeedleTwist,
        pose: Pose,
        safety: NeedleSafetyFilter,
        previous: Allocation,
        max_change: float,
        pull: NeedleTwist | None,
        balance: float = 0.0,
        deviation: PoseDeviation = EXACT,
    ) -> tuple[Allocation, str]:
        """Return the currents, and what limits them; empty if nothing does.

        Args:
            twist: that the needle is to have.
            pose: of the needle now.
            safety: certifies motions.
            previous: of the last step.
            max_change: maximum change of each current [A].
            pull: motion that something else gives the needle; None where that is not measured.
            balance: of the torque that something else gives it, see `CoilAllocation` [T].
            deviation: of its pose.
        """
        at = pose.tail, pose.heading

        def moved(currents: Vector, of: Allocation) -> Allocation:
            return replace(self._coils.motion(currents, *at, balance), saturated=of.saturated)

        def allocated(wanted: NeedleTwist) -> tuple[Allocation, str]:
            against = wanted if pull is None else wanted.less(pull)
            allocation = self._coils.allocate(
                against, *at, previous.currents, max_change, deviation, balance=balance, at_tip=pull is None
            )
            speed, limit = self._coils.slack_speed(allocation, pose.heading), self._max_speed
            if pull is not None:
                limit = min(limit, math.hypot(wanted.along, wanted.across) + self._max_pull_speed)
            if speed <= limit:
                return allocation, ""
            return moved(limit / speed * allocation.currents, allocation), SPEED

        def certified(allocation: Allocation) -> tuple[float, str]:
            if pull is None:
                return safety.safe_share(allocation.velocity, *at)  # its drift counts as a part of the turn
            velocity = allocation.velocity + safety.kinematics.tip_velocity(pose.heading, pull)
            return safety.safe_share(velocity, *at, allocation.drift + pull.across)

        def part(currents_of: Callable[[float], Vector], first: float, torque: float, by: Certificate) -> Allocation:
            """Return the currents of the greatest share, up to a first one, whose motion is certified.

            Without any such share they are those of none: zero, or the hold, which is certified.
            """

            def tried(share: float) -> Allocation:
                return replace(self._coils.motion(currents_of(share), *at, torque), saturated=drive.saturated)

            found = tried(first)
            if by(found)[0] >= 1.0:
                return found
            low, high, found = 0.0, first, tried(0.0)
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                if by(one := tried(middle))[0] >= 1.0:
                    low, found = middle, one
                else:
                    high = middle
            return found

        def by_itself(allocation: Allocation) -> tuple[float, str]:
            return safety.safe_share(allocation.velocity, *at, allocation.drift if pull is not None else 0.0)

        drive, bound = allocated(twist)
        share, name = certified(drive)
        if share >= 1.0:
            return drive, bound
        if pull is None:
            return part(lambda of: of * drive.currents, share, 0.0, by_itself), name
        hold, _ = allocated(NeedleTwist())
        added = drive.currents - hold.currents
        if certified(hold)[0] >= 1.0:
            return part(lambda of: hold.currents + of * added, 1.0, balance, certified), name
        # The pull and its torque apart, these currents may not bring the needle too close, nor may their change.
        changed = hold.currents + part(lambda of: of * added, 1.0, 0.0, by_itself).currents
        kept = part(lambda of: of * changed, 1.0, 0.0, by_itself)
        return moved(kept.currents, drive), name
