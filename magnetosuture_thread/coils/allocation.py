"""Coil currents for a velocity of the needle: bounded least squares, certified by the safety filter."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.field import LoopCoils, fields_per_current
from magnetosuture_thread.coils.filter import SPEED, NeedleSafetyFilter
from magnetosuture_thread.coils.inputs import Pose
from magnetosuture_thread.coils.needle_motion import NeedleKinematics, NeedleTwist
from magnetosuture_thread.geometry.compiled import TypedKernel, compiled
from magnetosuture_thread.settings.errors import InvalidInputError

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
DRIVEN_SPEED = 6.25e-3  # m/s; along a needle against a thread's pull: by an error of its direction [rad] it drifts
FIELD_ROUNDS, FIELD_TOLERANCE = 6, 0.03  # solutions, until the field along the needle is known to this share
LEAST_FIELD = 1e-6  # T; in a weaker one the needle is turned by its torque alone
MAX_EXCHANGES = 50  # of currents at and off their limits, some for each coil; the last are within limits too
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


class AllocationData(NamedTuple):
    """What the kernels read of coils and needle.

    Attributes:
        axes: unit vectors to the coils, shape (2, m).
        numbers: distance, radius and field of each coil, see `fields_per_current`, shape (3, m).
        gains: factors on their fields, shape (m,).
        chord: l [m].
        along: velocity along the chord for a difference of one tesla between its ends, q / drag [m/s/T].
        across: the same across it, q / drag_across [m/s/T].
        slow: turning_drag / (q l) [T s].
        field: B_0 [T].
        max_current: [A].
        period: T [s].
    """

    axes: Vector
    numbers: Vector
    gains: Vector
    chord: float
    along: float
    across: float
    slow: float
    field: float
    max_current: float
    period: float


class Request(NamedTuple):
    """What is to be allocated; see `CoilAllocation.allocate`.

    Attributes:
        along: velocity along the chord [m/s].
        across: velocity across it [m/s].
        turn_rate: [rad/s].
        place: deviation of the needle's place [m].
        stamp: deviation of the time of its pose [s].
        balance: b [T].
        at_tip: whether the tip is to move so.
        previous: currents of before; zeros if there are none, shape (m,) [A].
        lower: least currents, shape (m,) [A].
        upper: greatest currents, shape (m,) [A].
    """

    along: float
    across: float
    turn_rate: float
    place: float
    stamp: float
    balance: float
    at_tip: bool
    previous: Vector
    lower: Vector
    upper: Vector


@compiled
def needle_rows(data: AllocationData, x: float, y: float, ex: float, ey: float) -> Vector:
    """Return what one ampere in each coil gives a needle, shape (4, m).

    Args:
        data: of coils and needle.
        x: of its chord's middle [m].
        y: of it [m].
        ex: unit vector along the chord.
        ey: the same.

    Returns:
        Velocity along the chord and across it, to its left [m/s]; mean field across it and along it [T].
    """
    h, rows = 0.5 * data.chord, np.empty((4, len(data.gains)))
    at_tail = fields_per_current(x - h * ex, y - h * ey, data.axes, data.numbers)
    at_tip = fields_per_current(x + h * ex, y + h * ey, data.axes, data.numbers)
    for k, gain in enumerate(data.gains):
        pull_x, pull_y = gain * (at_tip[0, k] - at_tail[0, k]), gain * (at_tip[1, k] - at_tail[1, k])
        mean_x, mean_y = 0.5 * gain * (at_tip[0, k] + at_tail[0, k]), 0.5 * gain * (at_tip[1, k] + at_tail[1, k])
        rows[0, k] = data.along * (ex * pull_x + ey * pull_y)
        rows[1, k] = data.across * (ex * pull_y - ey * pull_x)
        rows[2, k], rows[3, k] = ex * mean_y - ey * mean_x, ex * mean_x + ey * mean_y
    return rows


@compiled
def response(data: AllocationData, field: float) -> float:
    """Return the field across the needle by which it turns, in a field along it [T], for 1 rad/s [T s]."""
    if data.period == 0.0:
        return data.slow
    return data.period * field / -math.expm1(-data.period * field / data.slow)


@compiled
def dot(first: Vector, second: Vector, begin: int) -> float:
    """Return the product of two vectors from an element on."""
    total = 0.0
    for k in range(begin, len(first)):
        total += first[k] * second[k]
    return total


@compiled
def least_squares(system: Vector, target: Vector, free: NDArray[np.bool_], x: Vector) -> None:
    """Make |system x - target| least by those elements of x that are free.

    By Householder's reflections of their columns, which must be independent. Source: Golub and Van Loan, Matrix
    Computations, algorithm 5.3.2. Deviation: none.

    Args:
        system: shape (k, m).
        target: shape (k,).
        free: shape (m,).
        x: shape (m,), changed.
    """
    count, rows = 0, len(target)
    rest, columns, diagonal = target.copy(), np.empty((len(x), rows)), np.empty(len(x))
    for j in range(len(x)):
        for i in range(rows):
            columns[count, i] = system[i, j]
            if not free[j]:
                rest[i] -= system[i, j] * x[j]
        count += free[j]
    for j in range(count):
        v = columns[j]
        square = dot(v, v, j)
        diagonal[j] = -math.copysign(math.sqrt(square), v[j])
        scale = 1.0 / (square - diagonal[j] * v[j])
        v[j] -= diagonal[j]
        for k in range(j + 1, count + 1):
            reflected = columns[k] if k < count else rest
            part = scale * dot(v, reflected, j)
            for i in range(j, rows):
                reflected[i] -= part * v[i]
    for m in range(len(x) - 1, -1, -1):
        if free[m]:
            count -= 1
            x[m] = rest[count] / diagonal[count]
            for i in range(count):
                rest[i] -= columns[count, i] * x[m]


@compiled
def bounded_least_squares(system: Vector, target: Vector, lower: Vector, upper: Vector) -> Vector:
    """Return the x of least |system x - target| within bounds, shape (m,).

    Source: Stark and Parker, Bounded-variable least squares, Computational Statistics 10, 1995: unknowns are fixed at a
    bound that stops the way to the solution without them, and freed where the residual decreases off it. Deviation:
    begins at the unbounded solution, brought within bounds; most often that is the solution.

    Args:
        system: of full rank, shape (k, m).
        target: shape (k,).
        lower: bounds, shape (m,).
        upper: at least as great, shape (m,).
    """
    count, free = len(lower), np.ones(len(lower), np.bool_)
    x = np.zeros(count)
    least_squares(system, target, free, x)
    for k in range(count):
        free[k] = lower[k] < x[k] < upper[k]
        x[k] = min(max(x[k], lower[k]), upper[k])
    if free.all():
        return x
    for _ in range(MAX_EXCHANGES):
        aim, part, stop = x.copy(), 1.0, -1
        least_squares(system, target, free, aim)
        for k in range(count):
            step = aim[k] - x[k]
            room = (upper[k] if step > 0.0 else lower[k]) - x[k]
            if free[k] and abs(step) * part > abs(room):
                part, stop = room / step, k
        for k in range(count):
            x[k] += part * (aim[k] - x[k])
        if stop >= 0:
            free[stop] = False
            x[stop] = upper[stop] if aim[stop] > x[stop] else lower[stop]
            continue
        gain, worst, best = np.zeros(count), -1, 0.0
        for i in range(len(target)):
            residual = target[i] - dot(system[i], x, 0)
            for k in range(count):
                gain[k] += system[i, k] * residual
        for k in range(count):
            inward = gain[k] if x[k] == lower[k] else -gain[k]
            if not free[k] and lower[k] < upper[k] and inward > best:
                worst, best = k, inward
        if worst < 0:
            break
        free[worst] = True
    return x


@compiled
def allocate_currents(data: AllocationData, request: Request, x: float, y: float, ex: float, ey: float) -> Vector:
    """Return the currents for a motion of a needle, shape (m,) [A]; see `CoilAllocation` and `needle_rows`."""
    lever, least, count = 0.5 * data.chord, MIN_ALIGNING_SHARE * data.field, len(data.gains)
    rows = needle_rows(data, x, y, ex, ey)
    c, s = math.cos(HEADING_STEP), math.sin(HEADING_STEP)
    # What an error of the heading would do: in a crossing it is on the other side of the axis. And one of the place.
    turned = needle_rows(data, x, y, c * ex - s * ey, c * ey + s * ex)
    beside = needle_rows(data, x - PLACE_STEP * ey, y + PLACE_STEP * ex, ex, ey)
    # From the field at one pole alone: velocities count by the force that they take.
    along_speed, across_speed = data.along * data.field, data.across * data.field
    system, target = np.zeros((5 + count, count)), np.zeros(5 + count)
    misaligned, bend = np.zeros(count), np.empty(count)
    for k in range(count):
        bend[k] = request.place / PLACE_STEP * (beside[2, k] - rows[2, k])
        system[0, k], system[3, k] = rows[0, k] / along_speed, rows[1, k] / across_speed
        system[5 + k, k] = CURRENT_WEIGHT / data.max_current
        if not request.at_tip:  # else a drift by such an error is corrected by the turn, as any other
            # What a coil's error does to drift and direction, for one ampere. Close to the coils' axes a force across
            # the needle takes large currents whose fields cancel each other, and their errors do not.
            aside = DRIVEN_SPEED * rows[2, k] / least
            drift = COIL_ERROR / across_speed * math.hypot(rows[1, k], aside)
            system[5 + k, k] = math.hypot(system[5 + k, k], drift)
            misaligned[k] = (turned[1, k] - rows[1, k]) / (HEADING_STEP * across_speed)
    target[0], target[3] = request.along / along_speed, request.across / across_speed
    measured = HEADING_ERROR**2 + (request.turn_rate * request.stamp) ** 2
    currents, field, doubt = request.previous, data.field, math.sqrt(measured)
    for number in range(FIELD_ROUNDS + 1):
        before, last = field, doubt
        if number or currents.any():  # from which what is looked for is not far
            field, error = max(dot(rows[3], currents, 0), least), dot(bend, currents, 0) ** 2
            for k in range(count):
                error += (COIL_ERROR * rows[2, k] * currents[k]) ** 2
            doubt = math.sqrt(measured + error / field**2)
        if number:
            doubt = math.sqrt(last * doubt)
            is_known = abs(field - before) <= FIELD_TOLERANCE * before and abs(doubt - last) <= FIELD_TOLERANCE * last
            if is_known or number == FIELD_ROUNDS:
                break
        resistance = response(data, field)
        # A tip speed of `max_turn_speed` needs a field at the largest angle that still turns the needle faster.
        max_turn_speed = MAX_FIELD_ANGLE_SINE * lever * field / resistance
        speed = lever * request.turn_rate + lever / resistance * request.balance
        weight = TURN_WEIGHT * MAX_FIELD_ANGLE_SINE / max_turn_speed
        target[1] = weight * min(max_turn_speed, max(-max_turn_speed, speed))
        for k in range(count):
            system[1, k] = weight * (lever / resistance * rows[2, k] + (rows[1, k] if request.at_tip else 0.0))
            system[4, k] = doubt * misaligned[k]
        # A constraint that the optimum violates is active in the constrained optimum.
        for align, share in ((ALIGN_WEIGHT, 1.0), (CONSTRAINT_WEIGHT, MIN_ALIGNING_SHARE)):
            target[2] = align * share
            for k in range(count):
                system[2, k] = align / data.field * rows[3, k]
            currents = bounded_least_squares(system, target, request.lower, request.upper)
            if dot(rows[3], currents, 0) >= least:
                break
    return currents


class CoilAllocation:
    """Allocates coil currents for a velocity of the needle's tip.

    A slender magnet in a viscous liquid aligns with the field within hundredths of a second, or a tenth, and is pulled
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
    coil across it; the last, times `DRIVEN_SPEED`, is a drift too. A needle beside its place turns with the field
    there. Close to a coil's axis, where large fields cancel each other, one that is held against a pull is therefore in
    an unstable balance: the later its poses are, the less of the pull is held. These fields are those of the solution
    before, from that of the last currents on.

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
    """

    def __init__(
        self, coils: LoopCoils, needle: NeedleMechanics, aligning_field: float, max_current: float, period: float = 0.0
    ) -> None:
        self.names = coils.names
        self._needle = needle
        self._data = AllocationData(
            axes=coils.axes,
            numbers=coils.numbers,
            gains=np.ones(len(coils.names)),
            chord=float(needle.chord),
            along=float(needle.pole / needle.drag),
            across=float(needle.pole / needle.drag_across),
            slow=float(needle.turning_drag / (needle.pole * needle.chord)),
            field=float(aligning_field),
            max_current=float(max_current),
            period=float(period),
        )
        self._allocate, self._kernel_rows = TypedKernel(allocate_currents), TypedKernel(needle_rows)
        self.response_time = response(self._data, aligning_field) / aligning_field
        self.allocate(NeedleTwist(), np.zeros(2), np.array([1.0, 0.0]))  # so that no command waits for a compiler

    @property
    def gains(self) -> Vector:
        """By which factor each coil's field differs from its calibration, shape (m,); 1 until something is known."""
        return self._data.gains

    @gains.setter
    def gains(self, gains: Vector) -> None:
        self._data = self._data._replace(gains=np.array(gains, dtype=np.float64))

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

        Raises:
            InvalidInputError: something is not finite, or the needle lies on a coil's winding.
        """
        e, lever = self._needle.chord_direction(heading), 0.5 * self._needle.chord
        n, middle = np.array([-e[1], e[0]]), tail + lever * e
        limit = np.full(len(self.names), self._data.max_current)
        lower, upper, before = -limit, limit, np.zeros(len(self.names))
        if previous is not None:
            before = np.array(previous, dtype=np.float64)
            lower, upper = (np.clip(before + change, -limit, limit) for change in (-max_change, max_change))
        along, across, turn_rate, place, stamp, torque = map(float, (*twist, *deviation, balance))
        request = Request(along, across, turn_rate, place, stamp, torque, bool(at_tip), before, lower, upper)
        currents = self._allocate(self._data, request, *middle.tolist(), *e.tolist())
        if not np.isfinite(currents).all():
            what = (*twist, *tail, *heading)
            raise InvalidInputError("motion, tail and heading", what, "finite numbers, and a needle off the coils")
        found = self.motion(currents, tail, heading, balance)
        wanted = twist.along * e + (lever * twist.turn_rate + twist.across) * n
        inaccurate = math.hypot(*(found.velocity - wanted)) > SATURATION_TOLERANCE * math.hypot(*wanted)
        return replace(found, saturated=inaccurate and bool(np.any(np.abs(currents) >= 0.999 * limit)))

    def motion(self, currents: Vector, tail: Vector, heading: Vector, balance: float = 0.0) -> Allocation:
        """Return currents, shape (m,) [A], with the motion that they give the needle; see `allocate`."""
        e = self._needle.chord_direction(heading)
        lever, n = 0.5 * self._needle.chord, np.array([-e[1], e[0]])
        along, drift, across_field, field = (self._rows(tail + lever * e, e) @ currents).tolist()
        swing = lever * (across_field - balance) / response(self._data, max(field, LEAST_FIELD))
        return Allocation(currents, along * e + (swing + drift) * n, False, drift)

    def _rows(self, middle: Vector, e: Vector) -> Vector:
        """Return what one ampere in each coil gives a needle with its chord along e; see `needle_rows`."""
        return np.asarray(self._kernel_rows(self._data, *middle.tolist(), *e.tolist()))

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
        current = min(HEADING_ERROR * self._data.field / (COIL_ERROR * field), self._data.max_current)
        found, axes = np.array([authority(angle) for angle in np.radians(np.arange(180.0))]), []
        minima = (found < np.roll(found, 1)) & (found <= np.roll(found, -1)) & (found < 0.5 * found.max())
        for angle in np.radians(np.flatnonzero(minima)).tolist():
            before, after = authority(angle - HEADING_STEP), authority(angle + HEADING_STEP)
            axis = round(angle + HEADING_STEP * (before - after) / (before + after), 6)  # it grows alike beside
            axes.append((axis, 0.5 * (before + after) / HEADING_STEP * current))
        return tuple(axes)


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
        max_speed: float = math.inf,
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
            max_speed: a limit that holds now, besides that of all motions [m/s].
        """
        at = pose.tail, pose.heading

        def moved(currents: Vector, of: Allocation) -> Allocation:
            return replace(self._coils.motion(currents, *at, balance), saturated=of.saturated)

        def allocated(wanted: NeedleTwist) -> tuple[Allocation, str]:
            against = wanted if pull is None else wanted.less(pull)
            allocation = self._coils.allocate(
                against, *at, previous.currents, max_change, deviation, balance=balance, at_tip=pull is None
            )
            speed, limit = self._coils.slack_speed(allocation, pose.heading), min(self._max_speed, max_speed)
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
