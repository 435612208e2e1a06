"""Path tracking: which tip velocity takes the needle's body along planned poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.planning.path import BodyPath

Vector = NDArray[np.float64]

WINDOW = 1e-3  # m; of the tip's way, in which the nearest pose is looked for ahead
ARRIVED = 6e-5  # m; an end of a path, or a change of direction on it, is reached this close
GAIN = 4.0  # 1/s; on the error along the chord
TURN_GAIN = 6.0  # 1/s; on the error of the angle
LOOKAHEAD = 1.0  # in levers; within which an error across the chord is steered off
SLIP_GAIN, MAX_SLIP = 0.5, 0.5  # per the way driven, and rad; the needle slips aside in the coils' gradient
INTEGRAL_GAIN = 4.0  # 1/s^2; of turning against a steady torque of the thread
SLOW_SHARE, MIN_SLOW = 0.8, 1e-4  # of the room beside the path, and m; an error for which the needle waits
MIN_SPEED = 0.5  # of the speed wanted; it goes on by this much, or no error of its heading would become smaller
ACCELERATION = 0.008  # m/s^2
DRAG_TIME = 0.6  # s; over which it is learned how much slower than commanded the needle is
MIN_DRAG, MAX_DRAG = 0.5, 4.0  # times the speed wanted are commanded
MAX_INTERVAL = 0.2  # s; after a longer gap between poses nothing is learned from it


@dataclass(frozen=True)
class TrackingCommand:
    """What moves the needle along its path.

    Attributes:
        velocity: of the tip, shape (2,) [m/s].
        travel: way of the tip along the path, up to where the needle is [m].
        error: of the body's pose, |dx| + lever |dangle| [m].
        done: whether the path's end is reached.
    """

    velocity: Vector
    travel: float
    error: float
    done: bool


class PathTracker:
    """Tracks a path of poses by driving along the chord and turning about the pivot.

        u = f (v dx/ds . e + k e_x),    omega = v dangle/ds + k_t (atan(e_y / l) sign(u) + e_angle) + c
        v_tip = u e + (chord / 2) omega n

    with the pose at the nearest way s on the path, the speed v that falls near ends and where the error is large, and
    the factor f for what the thread's drag takes of the speed, learned on the way. The path is followed from one change
    of direction to the next.

    Source: Y. Kanayama et al., A stable tracking control method for an autonomous mobile robot, 1990. Deviation: the
    reference is the nearest pose of the path in place of one that moves with time, so that it waits for the needle.

    Args:
        path: to track.
        turning: what the bridge takes for the tip's lever when it turns the needle: half of the chord [m].
    """

    def __init__(self, path: BodyPath, turning: float) -> None:
        self.path, self._turning = path, turning
        self._travel = 0.0
        self._stops = _stops(path)
        self._stamp: float | None = None
        self._speed = 0.0
        self._drag, self._bias, self._slip = 1.0, 0.0, 0.0

    @property
    def travel(self) -> float:
        """Way of the tip along the path, up to where the needle is [m]."""
        return self._travel

    @property
    def room(self) -> float:
        """Room beside the path where the needle is [m]."""
        return self.path.room_at(self._travel)

    def compute_command(self, stamp: float, pivot: Vector, angle: float, speed: float) -> TrackingCommand:
        """Compute the command for a pose.

        Args:
            stamp: of the pose [s].
            pivot: of the needle, shape (2,) [m].
            angle: of the chord [rad].
            speed: of the tip that is allowed now [m/s].
        """
        path, lever = self.path, self.path.lever
        interval = 0.0 if self._stamp is None else stamp - self._stamp
        interval = interval if 0.0 < interval <= MAX_INTERVAL else 0.0
        self._stamp = stamp
        before = self._travel
        self._travel = self._nearest(pivot, angle)
        stop = self._next_stop(pivot, angle)
        target, wanted = path.at(self._travel)
        off = math.remainder(wanted - angle, 2.0 * math.pi)
        away = target - pivot
        error = math.hypot(*away) + lever * abs(off)
        if stop is None:
            return TrackingCommand(np.zeros(2), path.length, error, True)
        # Where the needle wants to be is a little ahead, as the coils' currents are some hundredths of a second old.
        ahead, ahead_angle = path.at(min(stop, self._travel + path.length * 1e-9 + 2e-5))
        way, turn = ahead - target, ahead_angle - wanted
        size = math.hypot(*way) + lever * abs(turn)
        way, turn = (way / size, turn / size) if size > 0.0 else (np.zeros(2), 0.0)
        e = np.array([math.cos(angle), math.sin(angle)])
        remaining = stop - self._travel
        braked = math.sqrt(2.0 * ACCELERATION * max(remaining, 0.0))
        self._speed = min(self._speed + ACCELERATION * interval, speed, braked)
        share = max(MIN_SPEED, 1.0 - error / max(MIN_SLOW, SLOW_SHARE * self.room))
        pace = self._speed * share
        reference = np.array([math.cos(wanted), math.sin(wanted)])
        drive = pace * float(way @ reference)
        if interval > 0.0 and size > 0.0:
            self._learn(drive, before, interval)
        along, across = float(away @ e), float(away[1] * e[0] - away[0] * e[1])
        straight = abs(drive) / pace if pace > 0.0 else 0.0
        self._slip = _limit(self._slip + SLIP_GAIN * interval * across * abs(drive) / lever**2, MAX_SLIP)
        steer = math.copysign(straight, drive) * (math.atan2(across, LOOKAHEAD * lever) + self._slip)
        self._bias = _limit(self._bias + INTEGRAL_GAIN * interval * (off + steer), 1.0)
        u = self._drag * (drive + GAIN * along)
        omega = pace * turn + TURN_GAIN * (off + steer) + self._bias
        limit = MAX_DRAG * speed
        u, omega = _limit(u, limit), _limit(omega, limit / lever)
        self.dbg=(round(1e3*along,3),round(1e3*across,3),round(off,3),round(1e3*pace,3),round(1e3*self._speed,3),round(1e3*drive,3),round(turn*1e-3,3),round(self._bias,3))
        velocity = u * e + self._turning * omega * np.array([-e[1], e[0]])
        return TrackingCommand(velocity, self._travel, error, False)

    def _learn(self, drive: float, before: float, interval: float) -> None:
        """Learn how much of the speed the thread's drag takes, and the turning that its torque asks for."""
        made = (self._travel - before) / interval
        pace = abs(drive)
        if pace > 0.2 * self._speed > 0.0:
            change = interval / DRAG_TIME * (pace - made) / max(pace, 1e-9)
            self._drag = min(MAX_DRAG, max(MIN_DRAG, self._drag * (1.0 + max(-0.2, min(0.2, change)))))

    def _nearest(self, pivot: Vector, angle: float) -> float:
        """Return the way of the nearest pose of the path, not before the last one, nor beyond the next stop."""
        path = self.path
        limit = next((stop for stop in self._stops if stop > self._travel - 1e-12), path.length)
        last = int(np.searchsorted(path.travel, min(limit, self._travel + WINDOW), side="right"))
        first = int(np.searchsorted(path.travel, self._travel, side="left"))
        first = max(0, first - 1)
        last = max(last, first + 2)
        best, found = math.inf, self._travel
        for k in range(first, min(last, len(path.travel) - 1)):
            low, high = path.travel[k], path.travel[k + 1]
            if not high > low:
                continue
            dx, dy = path.pivots[k + 1] - path.pivots[k]
            turn = path.lever * (path.angles[k + 1] - path.angles[k])
            rx, ry = pivot - path.pivots[k]
            rt = path.lever * math.remainder(angle - path.angles[k], 2.0 * math.pi)
            size = dx * dx + dy * dy + turn * turn
            share = min(1.0, max(0.0, (rx * dx + ry * dy + rt * turn) / size)) if size > 0.0 else 0.0
            away = (rx - share * dx) ** 2 + (ry - share * dy) ** 2 + (rt - share * turn) ** 2
            if away < best - 1e-18:
                best, found = away, low + share * (high - low)
        return float(min(max(found, self._travel), limit))

    def _next_stop(self, pivot: Vector, angle: float) -> float | None:
        """Return the next way at which the needle has to be at rest; None at the end."""
        while self._stops:
            stop = self._stops[0]
            place, wanted = self.path.at(stop)
            off = math.hypot(*(place - pivot)) + self.path.lever * abs(math.remainder(wanted - angle, 2.0 * math.pi))
            if stop - self._travel > ARRIVED or off > 3.0 * ARRIVED:
                return stop
            self._stops.pop(0)
            self._travel = max(self._travel, stop)
            self._speed = 0.0
        return None


def _stops(path: BodyPath) -> list[float]:
    """Return the ways at which the needle changes between ahead and back, and the path's end."""
    steps = np.diff(path.pivots, axis=0)
    middle = 0.5 * (path.angles[1:] + path.angles[:-1])
    drive = steps[:, 0] * np.cos(middle) + steps[:, 1] * np.sin(middle)
    stops, sign = [], 0.0
    for k, along in enumerate(drive.tolist()):
        if abs(along) < 0.2 * (path.travel[k + 1] - path.travel[k]) or abs(along) < 1e-9:
            continue  # a turn, of no direction
        if sign and math.copysign(1.0, along) != sign:
            stops.append(float(path.travel[k]))
        sign = math.copysign(1.0, along)
    return [*stops, path.length]


def _limit(value: float, largest: float) -> float:
    return max(-largest, min(largest, value))
