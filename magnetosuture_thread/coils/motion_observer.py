"""The measured motion of the needle: what its currents do not explain, and whether it follows them."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.needle_motion import NeedleKinematics, limit_pair

Vector = NDArray[np.float64]

GAIN = 12.0  # 1/s; of the velocities, below the rate of a camera's poses
MAX_INTERVAL = 0.2  # s; two poses farther apart say nothing of the motion between them
MAX_GAP = 1.0  # s; of poses, over which what was measured before is kept: a thread goes on pulling
VISIBLE = 6e-5  # m; four times the noise of a displacement between two poses
MIN_WINDOW = 0.15  # s; two time constants of the motion observer, in which it compensates a pull that has changed
MAX_WINDOW = 3.0  # s; a slower motion than one minimum distance in that time is not judged
MIN_DISTANCE = 2e-4  # m; ten times the noise of a measured pose
SHAPE_FACTOR = 4.0  # on that, for a needle at wall or shape: 2 mm with the default pose_uncertainty
MIN_SHARE = 0.1  # of the expected motion, in its direction, that a needle which follows makes at least
STILL_SHARE = 0.7  # of the expected motion; a needle that is held, and pulled by its thread, moves less
MAX_TURN = 1.0  # rad; the field's torque keeps a needle nearer to its direction, against any thread
PROBE_TURN, PROBE_RATE = 0.2, 4.0  # rad, forty times the noise of a heading, and rad/s
PROBE_SHARE = 0.2  # of a turn of the field, which the needle makes at least
PROBE_TIMEOUT = 0.4  # s; a needle that could not be turned by then does not follow
MAX_ERROR, MAX_ERROR_SHARE = 2.0, 0.8  # of d and of the expected displacement, while a pull is learnt that has changed
TRUST_TIME = 1.0  # s after a probe that the needle has followed


class MotionDisturbance(NamedTuple):
    """Motion of the needle that its currents do not explain.

    Attributes:
        along: velocity of the whole needle along its chord [m/s].
        drift: velocity of the whole needle across its chord, to the left [m/s].
    """

    along: float = 0.0
    drift: float = 0.0

    def velocity(self, e: Vector) -> Vector:
        """Return the velocity of the whole needle for the unit vector from tail to tip, shapes (2,) [m/s]."""
        return np.array([self.along * e[0] - self.drift * e[1], self.along * e[1] + self.drift * e[0]])


class MotionObserver:
    """Estimates the needle's motion that its currents, by the bridge's model of coils and needle, do not explain.

    A thread that trails at an angle pulls the needle aside, and a longer one slows it. With the velocity m of the
    needle's middle along and across its chord, measured by two poses, and the mean c of the velocity by the currents
    between the times of these poses, the estimate d follows by

        d' = g (m - c - d),    |d| <= max_speed

    It learns only from motion that can be seen: poses are compared once the middle has moved by `VISIBLE`, or while no
    currents are on, or while the needle is trusted to be tracked. Poses that stand still thus wind up nothing.

    The coils compensate d: with a commanded velocity u, c = u - d. Of a needle that moves at k c, d converges at any
    lateness of the poses where |k - 1| < 1, and at k = 2 at up to 0.2 s.

    Source: disturbance observers of first order, Ohnishi, Shibata and Murakami 1996. Deviation: of velocities, not of
    forces, as inertia has no part. Pure: times come in, in seconds.

    Args:
        needle: its kinematics.
        min_hold: the coils hold their currents for at least this long; for how much longer is not known [s].
        max_speed: of the disturbance that is compensated [m/s].
    """

    def __init__(self, needle: NeedleKinematics, min_hold: float = math.inf, max_speed: float = math.inf) -> None:
        self._needle, self._min_hold, self._max_speed = needle, min_hold, max_speed
        limit_pair(0.0, 0.0, max_speed)  # loaded now, and not within the loop
        self._velocity = np.zeros(2)
        self._last: tuple[float, Vector, Vector] | None = None  # stamp, middle and chord's direction of the last pose
        self._seen: tuple[float, Vector] | None = None  # the last pose that the needle has visibly moved to
        self._applied: deque[tuple[float, Vector]] = deque()  # what the currents were set for, each with its start

    @property
    def velocity(self) -> Vector:
        """The disturbance in the dish's frame, shape (2,) [m/s]."""
        return self._velocity

    def update(self, tail: Vector, heading: Vector, stamp: float, trusted: bool = False) -> MotionStep | None:
        """Take a measured pose; return the motion since the last one, None where it cannot be compared.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            stamp: when it was measured [s].
            trusted: whether to learn also from a needle that stands still.
        """
        e = self._needle.chord_direction(heading)
        middle = tail + 0.5 * self._needle.chord * e
        last, self._last = self._last, (stamp, middle, e)
        seen = self._seen
        if seen is None or not 0.0 < stamp - seen[0] <= MAX_INTERVAL:
            if last is None or not 0.0 < stamp - last[0] <= MAX_GAP:
                self._velocity = np.zeros(2)
            seen = self._seen = stamp, middle
        elif (applied := self._mean_applied(seen[0], stamp)) is not None:
            interval = stamp - seen[0]
            if trusted or not applied[:2].any() or math.hypot(*(middle - seen[1])) > VISIBLE:
                unexplained = (middle - seen[1]) / interval - applied[:2]
                learnt = self._velocity + min(1.0, GAIN * interval) * (unexplained - self._velocity)
                self._velocity = np.array(limit_pair(float(learnt[0]), float(learnt[1]), self._max_speed))
                self._seen = stamp, middle
        if last is None or not 0.0 < stamp - last[0] <= MAX_INTERVAL:
            return None
        applied = self._mean_applied(last[0], stamp)
        if applied is None:
            return None
        interval, before = stamp - last[0], last[2]
        turn = math.atan2(before[0] * e[1] - before[1] * e[0], float(before @ e))
        swing = 0.5 * self._needle.chord * (e - before)
        return MotionStep(
            stamp, interval, interval * applied[2:4], interval * applied[4], middle - last[1], turn, swing
        )

    def apply(self, now: float, applied: Vector, intended: Vector, turn_rate: float) -> None:
        """Register what currents are set for from a time on.

        Args:
            now: time of the stamps' clock [s].
            applied: velocity of the needle's middle that the currents give by the bridge's model, shape (2,) [m/s].
            intended: velocity of the middle that was intended, with the disturbance compensated, shape (2,) [m/s].
            turn_rate: at which the field turns the needle [rad/s].
        """
        self._register(now, np.array([*applied, *intended, turn_rate]))

    def rest(self, now: float) -> None:
        """Register that the currents are zero from a time of the stamps' clock on [s]."""
        self._register(now, np.zeros(5))

    def _register(self, now: float, velocity: Vector) -> None:
        if self._applied and now < self._applied[-1][0]:
            self._applied.clear()  # time was set back
            self._last = self._seen = None
        self._applied.append((now, velocity))
        while len(self._applied) > 1 and self._applied[1][0] < now - MAX_GAP:
            self._applied.popleft()

    def _mean_applied(self, start: float, end: float) -> Vector | None:
        """Return the mean velocity by the currents between two times [m/s]; None where they are not known.

        Before the first currents the needle rests.
        """
        total, until = np.zeros(5), end
        for since, velocity in reversed(self._applied):
            if since < until:
                if velocity[:2].any() and until - since > self._min_hold * (1.0 + 1e-9):
                    return None  # nobody has set the currents for so long that the coils may have switched off
                total += (until - max(since, start)) * velocity
                until = since
            if since <= start:
                break
        return total / (end - start)

    def disturbance(self, heading: Vector) -> MotionDisturbance:
        """Return what to compensate.

        Args:
            heading: unit vector at the tail, shape (2,).
        """
        e = self._needle.chord_direction(heading)
        x, y = self._velocity
        return MotionDisturbance(float(e[0] * x + e[1] * y), float(e[0] * y - e[1] * x))


class MotionStep(NamedTuple):
    """Motion of the needle between two measured poses, beside what the coils were set for.

    Attributes:
        stamp: of the second pose [s].
        interval: between both [s].
        expected: displacement of the needle's middle that was intended, shape (2,) [m].
        expected_turn: angle by which the field was set to turn the needle [rad].
        measured: displacement of the middle, shape (2,) [m].
        measured_turn: change of the heading [rad].
        swing: displacement of the middle by that turn, where it is about the tail, shape (2,) [m].
    """

    stamp: float
    interval: float
    expected: Vector
    expected_turn: float
    measured: Vector
    measured_turn: float
    swing: Vector


class FollowMonitor:
    """Compares how the poses move with how the coils should have moved the needle.

    With the expected displacement E and the measured one M of the needle's middle, the poses are not the needle's where

        |M - s E - r B| > max(MAX_ERROR d, MAX_ERROR_SHARE |E|)    for every s from 0 (held) to the slack ratio,
                                                                   and every r from 0 to 1,

    with the minimum distance d, or where the heading turns `MAX_TURN` farther than the field; both within
    `MIN_WINDOW`. A needle that its thread holds turns about its tail: B is the displacement of its middle by the turn
    that field and heading share. The needle stands still where

        M . E < MIN_SHARE |E|^2

    in the shortest window of at least `MIN_WINDOW` with |E| >= d, and is not the needle where
    |M| > STILL_SHARE |E| + |B| within twice that time. A taut thread may hold it: the field then probes it
    by a small turn, which a held needle follows and a pose that is not the needle's does not. A turn of the field as
    commanded in that window serves as well. Pure: times come in, in seconds of the stamps' clock.

    Source: none.

    Args:
        min_distance: shorter displacements are not judged [m].
        slack_ratio: how many times as fast as expected the needle moves when the thread is slack.
    """

    def __init__(self, min_distance: float, slack_ratio: float = 1.0) -> None:
        self._min_distance, self._slack_ratio = max(min_distance, MIN_DISTANCE), slack_ratio
        self._steps: deque[MotionStep] = deque()
        self._probed: float | None = None  # stamp of the pose that began the probe
        self._turned = 0.0  # by which the field was turned since
        self._direction = 1.0
        self._trusted_until = -math.inf
        self._suspicion = ""

    def clear(self) -> None:
        """Forget all motion, as of a needle that is armed anew."""
        self._steps.clear()
        self._probed = None

    def end_probe(self) -> None:
        """End a probe without a verdict, as where the command ends."""
        self._probed = None

    @property
    def probe_rate(self) -> float:
        """Rate at which a probe turns the needle, in place of the command [rad/s]; 0 once it has turned far enough."""
        is_needed = self._probed is not None and abs(self._turned) < PROBE_TURN
        return self._direction * PROBE_RATE if is_needed else 0.0

    def register_turn(self, angle: float) -> None:
        """Register by which angle the field was set to turn the needle [rad]."""
        self._turned += angle

    def is_trusted(self, stamp: float) -> bool:
        """Return whether a probe has lately shown that the poses are the needle's."""
        return stamp <= self._trusted_until

    def update(self, step: MotionStep, at_shape: bool = False) -> str:
        """Take the motion between two poses; return why the needle does not follow, or an empty text.

        Args:
            step: the motion.
            at_shape: whether the needle lies at wall or shape, which may hold it for a while.
        """
        min_distance = self._min_distance * (SHAPE_FACTOR if at_shape else 1.0)
        self._steps.append(step)
        while step.stamp - self._steps[0].stamp > MAX_WINDOW:
            self._steps.popleft()
        if self._probed is not None:
            return self._judge_probe(step.stamp, self._probed)
        expected, measured, swing, about_tail = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
        field_turn = turn = error = span = 0.0
        for entry in reversed(self._steps):
            expected, measured = expected + entry.expected, measured + entry.measured
            if span < MIN_WINDOW:
                field_turn, turn = field_turn + entry.expected_turn, turn + entry.measured_turn
                swing = swing + entry.swing
                shared = min(1.0, max(0.0, field_turn / turn)) if turn else 0.0
                about_tail = shared * swing
                error = self._error(expected, measured, about_tail)
            span, distance = span + entry.interval, math.hypot(*expected)
            if span >= MIN_WINDOW and distance >= min_distance:
                break
        excess = max(turn - max(field_turn, 0.0), min(field_turn, 0.0) - turn)
        if excess > MAX_TURN:
            return f"needle does not follow: it turned {excess:.1f} rad away from the field in {MIN_WINDOW:g} s"
        moved = math.hypot(*measured)
        text = (
            f"needle does not follow: {1e3 * distance:.2g} mm expected, {1e3 * moved:.2g} mm measured in {span:.2g} s"
        )
        is_straight = abs(field_turn) < 0.5 * MAX_TURN  # else the direction of E depends on when the needle turned
        if is_straight and error > max(MAX_ERROR * self._min_distance, MAX_ERROR_SHARE * distance):
            return f"{text}, elsewhere"
        enough = span >= MIN_WINDOW and distance >= min_distance and bool(step.expected.any())
        if not enough or measured @ expected >= MIN_SHARE * distance**2:
            return ""
        if is_straight and span <= 2.0 * MIN_WINDOW and moved > STILL_SHARE * distance + math.hypot(*about_tail):
            return f"{text}, elsewhere"
        self._suspicion, self._probed, self._turned = text, step.stamp, 0.0
        self._direction = math.copysign(1.0, field_turn)
        return self._judge_turn(step.stamp, field_turn, turn)

    def _error(self, expected: Vector, measured: Vector, about_tail: Vector) -> float:
        """Return how far a displacement is from those of a needle that is held, slack, or turns about its tail [m].

        These are a parallelogram from 0, its sides the expected displacement with a slack thread, and that about the
        tail.
        """
        slack = self._slack_ratio * expected
        area = slack[0] * about_tail[1] - slack[1] * about_tail[0]
        along = measured[0] * about_tail[1] - measured[1] * about_tail[0]
        across = slack[0] * measured[1] - slack[1] * measured[0]
        if area and 0.0 < along / area < 1.0 and 0.0 < across / area < 1.0:
            return 0.0
        sides = ((np.zeros(2), slack), (np.zeros(2), about_tail), (slack, about_tail), (about_tail, slack))
        return min(_distance(measured - start, side) for start, side in sides)

    def _judge_probe(self, stamp: float, since: float) -> str:
        steps = [entry for entry in self._steps if entry.stamp > since]
        turn = sum(entry.measured_turn for entry in steps)
        problem = self._judge_turn(stamp, sum(entry.expected_turn for entry in steps), turn)
        is_over = self._probed is not None and stamp - since > PROBE_TIMEOUT
        return self._suspicion if is_over else problem

    def _judge_turn(self, stamp: float, expected: float, measured: float) -> str:
        """End the probe once the field has turned far enough; return why the needle does not follow, or nothing."""
        if abs(expected) < 0.8 * PROBE_TURN:
            return ""
        if measured * math.copysign(1.0, expected) < PROBE_SHARE * abs(expected):
            return self._suspicion
        self.clear()
        self._trusted_until = stamp + TRUST_TIME
        return ""


def _distance(point: Vector, side: Vector) -> float:
    """Return how far a point, shape (2,), is from the line from 0 to another one [m]."""
    share = min(1.0, max(0.0, float(point @ side) / max(float(side @ side), 1e-24)))
    return math.hypot(*(point - share * side))
