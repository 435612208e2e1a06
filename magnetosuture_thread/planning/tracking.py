"""Path tracking: which motion takes the needle's body along planned poses."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.planning.follower import delayed_gain
from magnetosuture_thread.planning.path import BodyPath, turning_points

Vector = NDArray[np.float64]

NO_PULL: Vector = np.zeros(2)
NO_PULL.flags.writeable = False

MAX_PLACE_GAIN = 8.0  # 1/s; at which 10 um of noise of a pose are a velocity of 0.1 mm/s
MAX_ACROSS = 4e-3  # m/s; of the correction across the needle, which a pull that changes has to outlast
TURN_GAIN = 6.0  # 1/s; on the error of the direction
LOOKAHEAD = 0.64  # half chords; how far ahead on the path a needle is directed that no force brings back
MIN_STEERED = 0.2  # share of the place that is corrected by the direction, where force can do all of it
FORCE_RESERVE = 4.0  # by which force across the needle has to exceed what it is needed for, to do all of it
ACCELERATION = 0.008  # m/s^2
MAX_LAG, MAX_ANGLE = 4e-4, 0.35  # m and rad; the setpoint waits for a needle that is farther behind, or off it
ARRIVED, ALIGNED = 1.5e-4, 0.1  # m and rad; an end of the path, or a change of direction on it, is reached this close
MAX_ALONG_RATIO, MAX_TURN_RATIO = 0.5, 2.0  # of the allowed speed, that corrections along and of the direction may take
MIN_SLOWDOWN = 0.3  # for which the gain on the direction is raised, so that the bridge's factor does not lower it
MAX_AXIS_ANGLE = 0.15  # rad; kept off an axis at the most for a pull along it, which a small turn makes one across
# s; after the course has changed to the other side of an axis, in which the needle is turned faster
CROSSING_TIME = 0.3
CROSSING_STEP = 0.05  # s; in which it is turned by all of the angle at the earliest, also by poses that come in bursts
AXIS_CROSSED = 0.02  # rad; of the planned direction beyond an axis, from which on the needle lies on that side of it
# A turn displaces the middle by a share of the chord's half times its angle, as the thread holds the tail: a slack one,
# one that pulls backwards, by how much more for each m/s, and the most. In ground truth of simulated runs it is 0.22 of
# a pull below 2 mm/s, and 0.73 above 10 mm/s.
SLACK_PIVOT, PIVOT_SLOPE, TAUT_PIVOT = 0.2, 50.0, 0.75
CROSSING_LOOKAHEAD = 1.5e-3  # m; of the path before a crossing, in which the needle is kept to the side it comes from
MAX_ASIDE = 0.4  # of the least leeway up to a crossing, that it is kept aside at the most
MIN_HOLD_SPEED = 1e-6  # m/s
REST_TIME = 1.0  # s; a needle that is commanded and has not moved for this long rests
REST_WAY = 5e-5  # m; of the tip, which a needle that moves covers in that time
STALL_TIME = 4.0  # s; for which the setpoint may wait for a needle that moves
MAX_INTERVAL = 0.3  # s; the longest `command_timeout` of shipped setups: after a longer gap the setpoint has waited


@dataclass(frozen=True)
class TrackingCommand:
    """What moves the needle along its path.

    Attributes:
        twist: of the needle, see `NeedleTwist`, shape (3,) [m/s, m/s, rad/s].
        travel: way of the tip along the path, up to the setpoint [m].
        error: of the needle's middle from its setpoint [m].
        done: whether the path's end is reached.
    """

    twist: Vector
    travel: float
    error: float
    done: bool


class PathTracker:
    """Tracks a path of poses by the middle of the needle's chord, ahead and back.

    With the planned pose (p_r, theta_r) at the setpoint, its velocity u_r along the chord and its turn rate omega_r,
    the motion that is commanded is

        v = u_r (cos, sin)(theta_r + delta) + k (p_r + b - p),    omega = omega_r + k_theta (theta_r + delta - theta)

    The place is corrected by force, along and across the needle, with k = min(`delayed_gain`, `MAX_PLACE_GAIN`).
    The setpoint's speed has a trapezoidal profile between the places where the needle changes between ahead and back.
    It waits while the needle is farther behind it than `MAX_LAG`, or `MAX_ANGLE` off its direction.

    The direction corrects the place where force cannot: delta = s sign(u_r) atan(y / L), with the error y across the
    path, the length L of `LOOKAHEAD`, the share s of the way that is driven, not turned on the spot, and a weight that
    falls to `MIN_STEERED` where force has plenty in reserve. Along the axes of the coils no currents give a force
    across the needle. Where a pull d is measured, with the part d_a across an axis, theta stays off that by

        max(min(|d_a| / a, `MAX_ANGLE`), min(|d| / a, `MAX_AXIS_ANGLE`))

    with the velocity a that the coils hold for each radian, on the side of theta_r, and jumps to the other side when
    theta_r crosses. Where no pull is measured, and so none compensated, u_r is along the needle. A thread that holds
    the tail displaces the middle in that turn: before it the place is b, half of that to the side that the needle comes
    from. All of theta - theta_r stays within what half of the path's leeway allows. Corrections of the direction are
    raised by as much as the bridge slows them, within the same limits.

    Source: line-of-sight guidance of ships, Fossen 2011, section 10.3; for the place, proportional control of a
    fully actuated one. Deviation: the weight of the two, by what force is left.

    Args:
        path: to track.
        axes: directions in which the coils give no force across the needle [rad], each with the velocity across it
            that they hold for each radian off it [m/s], see `CoilAllocation.axes`.
        delay: from a command to the motion that poses show [s].
    """

    def __init__(self, path: BodyPath, axes: Sequence[tuple[float, float]] = (), delay: float = 0.0) -> None:
        self.path, self._axes, self._delay = path, tuple(axes), delay
        self.travel = 0.0
        turning = turning_points(path.middles, path.angles, path.lever)
        self._stops = [(float(path.travel[index]), sense) for index, sense in turning]
        self._stamp: float | None = None
        self._speed = 0.0
        self._turns: deque[tuple[float, float]] = deque()  # of commands: in force from [s], rate of turning [rad/s]
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
        pull: Vector = NO_PULL,
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
            pull: velocity of the needle that the bridge measures and compensates, shape (2,) [m/s].
            age: of the pose when the command is sent [s]; until it acts the commands before turn the needle.
            hold: the setpoint stands still, and is never done. The command is at least `MIN_HOLD_SPEED`: at a zero
                command the coils are off, and compensate nothing.
        """
        interval = 0.0 if self._stamp is None else stamp - self._stamp
        if not 0.0 < interval <= MAX_INTERVAL:
            interval, self._speed = 0.0, 0.0
            self._turns.clear()
        self._stamp = stamp
        age += self._delay  # when the command acts
        angle += self._turned(stamp, stamp + age)
        e, n = _axes_of(angle)
        stop, sense = self._stops[0]
        place, direction = self.path.at(self.travel)
        turn, normal = math.remainder(direction - angle, 2.0 * math.pi), _axes_of(direction)[1]
        drive, rate = self._rates(stop)
        driven = abs(drive) / max(abs(drive) + self.path.lever * abs(rate), 1e-12)
        allowed = 0.5 * self.leeway / max(self.path.lever, 1e-9)  # a turn by it takes half of the leeway
        error = math.hypot(*(place - middle))
        off = place + self._before_crossing(direction, pull) * normal - middle
        along, across = float(off @ e), float(off @ normal)
        gain = min(MAX_PLACE_GAIN, delayed_gain(age, interval))
        lookahead = LOOKAHEAD * max(self.path.lever, 1e-9)
        steered = self._steered(angle, abs(float(pull @ n)) + gain * abs(across))
        course = min(allowed, max(-allowed, steered * driven * sense * math.atan(across / lookahead)))
        # Of the way, to the left of the needle [rad]; along itself where nobody is known to move it across.
        aside = turn + course if pull.any() else 0.0
        off_axis = min(allowed, max(-allowed, self._off_axes(stamp, direction, course, pull)))
        turning = rate if off_axis == course else 0.0  # kept off an axis, the needle does not turn with the path
        course = off_axis
        waits = hold or sense * along > MAX_LAG or abs(turn + course) > MAX_ANGLE
        braked = math.sqrt(2.0 * ACCELERATION * max(stop - self.travel, 0.0))
        self._speed = 0.0 if waits else min(self._speed + ACCELERATION * interval, speed, braked)
        self.travel = min(stop, self.travel + slowdown * self._speed * interval)
        if not hold and stop - self.travel < 1e-6 and abs(along) < ARRIVED and abs(turn) < ALIGNED + abs(course):
            self._speed = 0.0
            if len(self._stops) == 1:
                return TrackingCommand(np.zeros(3), self.path.length, error, True)
            self._stops.pop(0)
        turn += course
        limit = MAX_ALONG_RATIO * speed
        u = self._speed * drive * math.cos(aside) + min(limit, max(-limit, gain * along))
        w = self._speed * drive * math.sin(aside) + min(MAX_ACROSS, max(-MAX_ACROSS, gain * float(off @ n)))
        omega = self._speed * turning
        if 0.0 <= stamp - self._crossed < CROSSING_TIME and interval:
            # All at once: by the next pose, at the earliest within `CROSSING_STEP`.
            omega += min(MAX_ANGLE, max(-MAX_ANGLE, turn)) / max(interval, CROSSING_STEP)
        else:
            limit = MAX_TURN_RATIO * speed / max(self.path.lever, 1e-9)
            omega += min(limit, max(-limit, TURN_GAIN / max(slowdown, MIN_SLOWDOWN) * turn))
        self._turns.append((stamp + age, slowdown * omega))
        if hold and math.hypot(u, w) < MIN_HOLD_SPEED:
            u = MIN_HOLD_SPEED
        return TrackingCommand(np.array([u, w, omega]), self.travel, error, False)

    def _steered(self, angle: float, needed: float) -> float:
        """Return the share of the place that the direction corrects, as force across the needle cannot.

        Args:
            angle: of the chord [rad].
            needed: velocity across it that force has to give [m/s].
        """
        if not self._axes:
            return 1.0
        near, held = self._nearest(angle)
        return min(1.0, max(MIN_STEERED, needed / max(FORCE_RESERVE * held * abs(near), 1e-9)))

    def _off_axes(self, stamp: float, direction: float, course: float, pull: Vector) -> float:
        """Return the course with which the needle stays off the coils' axes, on the side of the planned direction."""
        if not self._axes:
            return course
        planned, held = self._nearest(direction)
        kept = self._kept(direction - planned, held, pull)
        side = self._side
        if not side or planned * side <= -AXIS_CROSSED:
            self._side = math.copysign(1.0, planned)
        if side and self._side != side and abs(planned) < kept:
            self._crossed = stamp
        return max(course, kept - planned) if self._side > 0.0 else min(course, -kept - planned)

    def _before_crossing(self, direction: float, pull: Vector) -> float:
        """Return where to be, to the left, before the next axis is crossed: half of what that displaces [m]."""
        if not self._axes or not self._side:
            return 0.0
        planned, held = self._nearest(direction)
        kept, backwards = self._kept(direction - planned, held, pull), -float(pull @ _axes_of(direction)[0])
        leeway = self.leeway
        for way in np.linspace(self.travel, min(self.path.length, self.travel + CROSSING_LOOKAHEAD), 6)[1:]:
            leeway, ahead = min(leeway, self.path.leeway_at(way)), self.path.at(way)[1]
            then = planned + math.remainder(ahead - direction, 2.0 * math.pi)
            if then * self._side < -AXIS_CROSSED and abs(then) < 1.0:
                pivot = min(TAUT_PIVOT, max(SLACK_PIVOT, SLACK_PIVOT + PIVOT_SLOPE * backwards))
                aside = pivot * self.path.lever * kept
                return self._side * min(aside, MAX_ASIDE * leeway)
        return 0.0

    @staticmethod
    def _kept(axis: float, held: float, pull: Vector) -> float:
        """Return how far off an axis [rad] the coils hold a pull, shape (2,) [m/s]; see `_nearest` for `held`."""
        across = abs(float(pull @ _axes_of(axis)[1]))
        return max(min(MAX_ANGLE, across / held), min(MAX_AXIS_ANGLE, math.hypot(*pull) / held))

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


def _axes_of(angle: float) -> tuple[Vector, Vector]:
    """Return the unit vectors along a direction [rad] and to its left."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c, s]), np.array([-s, c])


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
        if not 0.0 <= travel - self.travel < REST_WAY or not self.since <= stamp:  # a new path begins anew
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
