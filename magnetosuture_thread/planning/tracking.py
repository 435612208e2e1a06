"""Path tracking: which tip velocity takes the needle's body along planned poses."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.planning.path import BodyPath, turning_points

Vector = NDArray[np.float64]

ALONG_GAIN = 6.0  # 1/s; on the error along the body
TURN_GAIN = 6.0  # 1/s; on the error of the direction
LOOKAHEAD = 8e-4  # m; how far ahead on the path the needle is directed
INTEGRAL_GAIN = 1.5  # 1/s; on the error across the path, for what makes the needle slip aside
MAX_INTEGRAL = 8e-4  # m; of it
ACCELERATION = 0.008  # m/s^2
MAX_LAG, MAX_ANGLE = 4e-4, 0.35  # m and rad; the setpoint waits for a needle that is farther behind, or off it
ARRIVED, ALIGNED = 1.5e-4, 0.1  # m and rad; an end of the path, or a change of direction on it, is reached this close
MAX_ALONG_RATIO, MAX_TURN_RATIO = 0.5, 2.0  # of the allowed speed, that corrections along and across may take
MIN_SLOWDOWN = 0.3  # for which the gain on the direction is raised, so that the bridge's factor does not lower it
MAX_AXIS_ANGLE = 0.15  # rad; that is kept off them at the most
MIN_SPEED_SHARE = 0.45  # to which the speed falls where the drift is more than they compensate
ALWAYS_OFF = 0.05  # rad; off an axis at which a needle counts that is on it, as tracked directions tremble
PULL_DECAY = 1.0  # s; in which the peak of a pull falls to 1 / e
TACK_SHARE, MAX_TACK_ERROR = 0.7, 6e-4  # of the leeway, and m; off the path, from which on the needle tacks
AXIS_LOOKAHEAD = 2e-3  # m; of the path, in which the needle is slowed for an axis
# s; after the course has changed to the other side of an axis, in which the needle is turned faster
CROSSING_TIME = 0.3
CROSSING_STEP = 0.05  # s; in which it is turned by all of the angle at the earliest, also by poses that come in bursts
LEAD_LOOKAHEAD = 4e-3  # m; of the path before a crossing, in which the needle is kept to the side it is thrown from
THROWN_FOR = 0.1  # s; for which the pull is not compensated in a crossing
LEAD_SHARE = 0.4  # of the smallest leeway up to a crossing, that the needle is kept aside before it at the most
MIN_TACK_TIME = 1.0  # s; after a crossing, in which the needle does not tack
AXIS_CROSSED = 0.02  # rad; of the planned direction beyond an axis, from which on the needle lies on that side of it
MIN_HOLD_SPEED = 1e-6  # m/s
REST_TIME = 1.0  # s; a needle that is commanded and has not moved for this long rests
REST_WAY = 5e-5  # m; of the tip, which a needle that moves covers in that time
STALL_TIME = 4.0  # s; for which the setpoint may wait for a needle that moves
MAX_INTERVAL = 0.3  # s; the longest `command_timeout` of shipped setups: after a longer gap the setpoint has waited


@dataclass(frozen=True)
class TrackingCommand:
    """What moves the needle along its path.

    Attributes:
        velocity: of the tip, shape (2,) [m/s].
        travel: way of the tip along the path, up to the setpoint [m].
        error: of the needle's middle from its setpoint [m].
        done: whether the path's end is reached.
    """

    velocity: Vector
    travel: float
    error: float
    done: bool


class PathTracker:
    """Tracks a path of poses by the middle of the needle's chord, ahead and back.

    With the planned pose (p, theta_p) at the setpoint, its speeds u_p along the chord and omega_p, the error (x, y) of
    the middle along the needle and across the path, to their left, and the share s of the way that is driven, not
    turned on the spot,

        theta = theta_p + s sign(u_p) atan((y + z) / L),    z' = k_z y
        u = u_p + k_x x,    omega = omega_p + k_t (theta - theta_needle)

    and the tip's velocity is u along the chord and omega l / 2 across it. The setpoint's speed has a trapezoidal
    profile between the places where the needle changes between ahead and back. It waits while the needle is farther
    behind it than `MAX_LAG`, or `MAX_ANGLE` off its direction.

    Along the axes of the coils no currents give a force across the needle. Where something pulls it across its chord at
    the velocity d, by its peak of the last second or so (`PULL_DECAY`), theta stays off an axis by
    min(|d| / a, `MAX_AXIS_ANGLE`), with the velocity a that the coils hold for each radian, on the side of theta_p, and
    jumps to the other side when theta_p crosses, or while the needle is far off its path to the wrong side, as a ship
    tacks, but not within `MIN_TACK_TIME` of a crossing. In a crossing the needle is turned faster, as nothing
    compensates the pull meanwhile: it is thrown aside by about `THROWN_FOR` times the present d. Before one, the path
    is followed as far to the other side, without the integral. All of theta - theta_p stays within what half of the
    path's leeway allows. Where d is more than the coils compensate at the needle's direction, or at one of the path's
    within `AXIS_LOOKAHEAD`, and the rest, before the needle is steered back over `LOOKAHEAD`, displaces it by more than
    `LEAD_SHARE` of the leeway there, the setpoint is slower, down to `MIN_SPEED_SHARE`: a thread in a liquid pulls less
    when it is pulled slowly. Corrections of the direction are raised by as much as the bridge slows them, within the
    same limits.

    Source: integral line-of-sight guidance of ships in a current, Borhaug, Pavlov and Pettersen 2008. Deviation: the
    integral is bounded, not saturated by its error; a turn on the spot does not correct the error across the path.

    Args:
        path: to track.
        axes: directions in which the coils give no force across the needle [rad], each with the velocity across it
            that they hold for each radian off it [m/s], see `CoilAllocation.axes`.
    """

    def __init__(self, path: BodyPath, axes: Sequence[tuple[float, float]] = ()) -> None:
        self.path, self._axes = path, tuple(axes)
        self.travel = 0.0
        turning = turning_points(path.middles, path.angles, path.lever)
        self._stops = [(float(path.travel[index]), sense) for index, sense in turning]
        self._stamp: float | None = None
        self._speed = 0.0
        self._turns: deque[tuple[float, float]] = deque()  # of commands: in force from [s], rate of turning [rad/s]
        self._integral = 0.0
        self._pull = 0.0  # across the needle, as a velocity: its peak, which is forgotten slowly [m/s]
        self._tack = 0.0  # error across the path for which the needle lies on the other side [m]; 0 if it does not
        self._crossed = -math.inf  # stamp at which the course has changed to the other side of an axis [s]
        self._side = 0.0  # of the nearest axis, on which the needle lies; 0 before the first pose

    @property
    def leeway(self) -> float:
        """Leeway of the path where the setpoint is [m]."""
        return self.path.leeway_at(self.travel)

    def compute_command(
        self,
        stamp: float,
        middle: Vector,
        angle: float,
        speed: float,
        slowdown: float = 1.0,
        drift: float = 0.0,
        age: float = 0.0,
        *,
        hold: bool = False,
    ) -> TrackingCommand:
        """Compute the command for a pose.

        Args:
            stamp: of the pose [s].
            middle: of the chord, shape (2,) [m].
            angle: of the chord [rad].
            speed: of the tip that is allowed now [m/s].
            slowdown: factor on every velocity that the bridge applies.
            drift: velocity across the chord, to the left, that the bridge measures and compensates [m/s].
            age: of the pose when the command is sent [s]; until then the commands before turn the needle.
            hold: the setpoint stands still, and is never done. The command is at least `MIN_HOLD_SPEED`: at a zero
                command the coils are off, and compensate nothing.
        """
        interval = 0.0 if self._stamp is None else stamp - self._stamp
        if not 0.0 < interval <= MAX_INTERVAL:
            interval, self._speed = 0.0, 0.0
            self._turns.clear()
        self._stamp = stamp
        angle += self._turned(stamp, stamp + age)
        e = np.array([math.cos(angle), math.sin(angle)])
        stop, sense = self._stops[0]
        wanted, direction = self.path.at(self.travel)
        off, turn = wanted - middle, math.remainder(direction - angle, 2.0 * math.pi)
        along, across = float(off @ e), math.cos(direction) * off[1] - math.sin(direction) * off[0]
        size = math.hypot(*off)
        drive, rate = self._rates(stop)
        driven = abs(drive) / max(abs(drive) + self.path.lever * abs(rate), 1e-12)
        allowed = 0.5 * self.leeway / max(self.path.lever, 1e-9)  # a turn by it takes half of the leeway
        # No more than what is allowed to act, or a slip to the other side would have to outlast it.
        bound = min(MAX_INTEGRAL, LOOKAHEAD * math.tan(min(allowed, 1.0)))
        self._integral = min(bound, max(-bound, self._integral))
        lead = self._lead(direction, drift)
        course = driven * sense * math.atan((across - lead + self._integral) / LOOKAHEAD)
        course = min(allowed, max(-allowed, course))
        # Close to an axis less of the pull is measured, so its peak is remembered for a while.
        self._pull = max(abs(drift), self._pull * math.exp(-interval / PULL_DECAY))
        off_axis = min(allowed, max(-allowed, self._off_axes(stamp, direction, course, across - lead)))
        turning = rate if off_axis == course else 0.0  # kept off an axis, the needle does not turn with the path
        course = off_axis
        waits = hold or sense * along > MAX_LAG or abs(turn + course) > MAX_ANGLE
        braked = math.sqrt(2.0 * ACCELERATION * max(stop - self.travel, 0.0))
        slower = speed * max(MIN_SPEED_SHARE, self._compensated_share(angle, slowdown * speed))
        self._speed = 0.0 if waits else min(self._speed + ACCELERATION * interval, slower, braked)
        self.travel = min(stop, self.travel + slowdown * self._speed * interval)
        if not hold and stop - self.travel < 1e-6 and abs(along) < ARRIVED and abs(turn) < ALIGNED + abs(course):
            self._speed = 0.0
            if len(self._stops) == 1:
                return TrackingCommand(np.zeros(2), self.path.length, size, True)
            self._stops.pop(0)
            self._integral = -self._integral  # the same slip asks for the other direction when driven back
        if not waits and not lead:  # which the integral would add to
            self._integral += INTEGRAL_GAIN * interval * driven * across
        turn += course
        raised = 1.0 / max(slowdown, MIN_SLOWDOWN)
        limit = MAX_ALONG_RATIO * speed
        u = self._speed * drive + min(limit, max(-limit, ALONG_GAIN * along))
        v = self.path.lever * self._speed * turning
        crosses = 0.0 <= stamp - self._crossed < CROSSING_TIME
        if crosses and interval:  # all at once: by the next pose, at the earliest within `CROSSING_STEP`
            v += self.path.lever * min(MAX_ANGLE, max(-MAX_ANGLE, turn)) / max(interval, CROSSING_STEP)
        else:
            limit = MAX_TURN_RATIO * speed
            v += min(limit, max(-limit, raised * TURN_GAIN * self.path.lever * turn))
        self._turns.append((stamp + age, slowdown * v / max(self.path.lever, 1e-9)))
        if hold and math.hypot(u, v) < MIN_HOLD_SPEED:
            u, v = MIN_HOLD_SPEED, 0.0
        return TrackingCommand(u * e + v * np.array([-e[1], e[0]]), self.travel, size, False)

    def _off_axes(self, stamp: float, direction: float, course: float, across: float) -> float:
        """Return the course with which the needle stays off the coils' axes, on the side of the planned direction.

        A needle that is far off its path on one side tacks: it stays on the other side of the axis until it is back.
        """
        if not self._axes:
            return course
        planned, held = self._nearest(direction)
        kept = min(MAX_AXIS_ANGLE, self._pull / held)
        if abs(planned) >= kept or across * self._tack <= 0.0:
            self._tack = 0.0
        is_off = abs(across) > min(MAX_TACK_ERROR, TACK_SHARE * self.leeway)
        side, may_tack = self._side, not 0.0 <= stamp - self._crossed <= MIN_TACK_TIME
        if is_off and may_tack and not self._tack and abs(planned) < kept and course * side < 0.0:
            self._side, self._tack = -side, across
        if not self._tack and (not side or planned * side <= -AXIS_CROSSED):
            self._side = math.copysign(1.0, planned)
        if side and self._side != side and abs(planned) < kept:
            self._crossed = stamp
        return max(course, kept - planned) if self._side > 0.0 else min(course, -kept - planned)

    def _lead(self, direction: float, drift: float) -> float:
        """Return the displacement to the left that is expected in the next crossing of an axis [m]; 0 far from one."""
        if not self._axes or abs(drift) <= ALWAYS_OFF * self._nearest(direction)[1]:
            return 0.0
        leeway = self.leeway
        for way in np.linspace(self.travel, min(self.path.length, self.travel + LEAD_LOOKAHEAD), 8)[1:]:
            leeway = min(leeway, self.path.leeway_at(way))
            ahead = self.path.at(way)[1]
            for axis, _ in self._axes:
                first, then = math.remainder(direction - axis, math.pi), math.remainder(ahead - axis, math.pi)
                if first * then < 0.0 and abs(first - then) < 1.0:
                    return math.copysign(min(abs(drift) * THROWN_FOR, LEAD_SHARE * leeway), drift)
        return 0.0

    def _compensated_share(self, angle: float, speed: float) -> float:
        """Return the share of the pull that coils compensate with ease, at a direction and those of the path ahead.

        It is 1 where the path is wide enough for what they do not compensate.
        """
        if not self._axes or self._pull <= ALWAYS_OFF * self._nearest(angle)[1]:
            return 1.0
        here, held = self._nearest(angle)
        ways = [min(self.path.length, self.travel + way) for way in np.linspace(0.0, AXIS_LOOKAHEAD, 5)]
        ahead = min(abs(self._nearest(self.path.at(way)[1])[0]) for way in ways)
        compensated = held * min(max(abs(here), ALWAYS_OFF), max(ahead, MAX_AXIS_ANGLE))
        aside = (self._pull - compensated) * LOOKAHEAD / max(speed, 1e-9)
        if aside <= LEAD_SHARE * min(map(self.path.leeway_at, ways)):
            return 1.0
        return min(1.0, compensated / self._pull)

    def _turned(self, begin: float, end: float) -> float:
        """Return by how much the commands before turn the needle from one time to another [rad]."""
        while len(self._turns) > 1 and self._turns[1][0] <= begin:
            self._turns.popleft()
        ends = [*(since for since, _ in self._turns), math.inf][1:]
        return sum(
            rate * max(0.0, min(until, end) - max(since, begin))
            for (since, rate), until in zip(self._turns, ends, strict=True)
        )

    def _nearest(self, direction: float) -> tuple[float, float]:
        """Return the angle from the nearest axis [rad], and the velocity that is held for each radian [m/s]."""
        each = ((math.remainder(direction - axis, math.pi), held) for axis, held in self._axes)
        return min(each, key=lambda one: abs(one[0]))

    def _rates(self, stop: float) -> tuple[float, float]:
        """Return how far the needle is driven along its chord, and turned [rad], for each metre of the tip's way."""
        before, after = max(0.0, self.travel - 5e-5), min(stop, self.travel + 5e-5)
        if after <= before:
            return 0.0, 0.0
        (start, first), (end, last) = self.path.at(before), self.path.at(after)
        mean = 0.5 * (first + last)
        moved = (math.cos(mean) * (end[0] - start[0]) + math.sin(mean) * (end[1] - start[1])) / (after - before)
        return float(moved), (last - first) / (after - before)


@dataclass
class RestDetector:
    """Notices a needle that is commanded and rests, by its last poses."""

    travel: float = 0.0  # up to which the setpoint had come, at the stamp `since` [m]
    since: float = math.inf  # [s]
    poses: deque[tuple[float, float, float, float]] = field(default_factory=deque)

    def update(self, stamp: float, middle: Vector, angle: float, lever: float, commanded: bool, travel: float) -> bool:
        """Return whether the needle does not get on: it has rested for `REST_TIME`, or trembles in one place.

        A needle that is held up by a wall, and as long as noise of its angle moves it to and fro, never rests.

        Args:
            stamp: of the pose [s].
            middle: of the chord, shape (2,) [m].
            angle: of the chord [rad].
            lever: half of the chord [m].
            commanded: whether it is to move.
            travel: of the setpoint, which waits for the needle [m].
        """
        if not commanded:
            self.poses.clear()
            self.since = math.inf
            return False
        if travel - self.travel >= REST_WAY or not self.since <= stamp:
            self.travel, self.since = travel, stamp
        elif stamp - self.since > STALL_TIME:
            return True
        if self.poses and stamp < self.poses[-1][0]:
            self.poses.clear()  # time was set back
        self.poses.append((stamp, float(middle[0]), float(middle[1]), lever * angle))
        while len(self.poses) > 2 and self.poses[1][0] <= stamp - REST_TIME:
            self.poses.popleft()
        first = self.poses[0]
        if stamp - first[0] < REST_TIME:
            return False
        return all(math.dist(first[1:], each[1:]) < REST_WAY for each in self.poses)
