"""The measured motion of the needle: what pulls it beside its currents, and whether it follows them."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.heading_observer import TORQUE_ANGLE, TORQUE_TIME
from magnetosuture_thread.coils.needle_motion import NeedleKinematics, NeedleTwist, limit_pair

Vector = NDArray[np.float64]

PLACE_DEVIATION = 1.2e-5  # m; of a tracked middle
PULL_NOISE = 1e-4  # m^2/s^3; a pull changes by 10 mm/s, root mean square, in 1 s
SWING_SHARE = 0.5  # of the way of the middle in a turn about the tail: a thread holds the tail, or does not
SWING_TIME = 0.05  # s; of a turn by `MAX_BLIND_TURN` at 7 rad/s, as across a coil's axis, in which that share is one
VISIBLE = 6e-5  # m; four times the noise of a displacement between two poses
MAX_STILL = 0.3  # s; after which poses that have not visibly moved are the place that the next ones are compared with
MAX_GAP = 1.0  # s; of poses, over which what was measured before is kept: a thread goes on pulling
MIN_WINDOW = 0.15  # s; three poses of 20 a second, in which a pull that has changed is compensated
MAX_WINDOW = 3.0  # s; a slower motion than one minimum distance in that time is not judged
MIN_DISTANCE = 2e-4  # m; ten times the noise of a measured pose
SHAPE_FACTOR = 4.0  # on that, for a needle at wall or shape: 2 mm with the default pose_uncertainty
VISIBLE_TURN = 0.03  # rad; four times the noise of a turn between two poses
MAX_UNSEEN = 1.5e-3  # m; a thread that tightens holds a needle against less, in simulated procedures against 1 mm
MAX_UNSEEN_TURN = 0.5  # rad; more than the bridge turns a needle between two poses, also by stamps that are wrong
MIN_SHARE = 0.1  # of the expected motion, in its direction, that a needle which follows makes at least
STILL_SHARE = 0.7  # of the expected motion; a needle that is held, and pulled by its thread, moves less
MAX_INNOVATION = 9.0  # mean square of innovations over their variance: three deviations; in simulated runs up to 2.4
MIN_INNOVATIONS = 3  # poses over which that is taken
STAMP_DEVIATIONS = 2.0  # by which stamps may be off there: poses in a row by the same, which does not average out
MAX_TURN = 1.0  # rad; the field's torque keeps a needle nearer to its direction, against any thread
PROBE_TURN, PROBE_RATE = 0.1, 4.0  # rad, twenty times the noise of a heading, and rad/s
PROBE_SHARE = 0.5  # of a turn of the field, which the needle makes at least
PROBE_TIMEOUT = 0.4  # s; a needle that could not be turned by then does not follow
TRUST_TIME = 1.0  # s after a probe that the needle has followed
MAX_ERROR, MAX_ERROR_SHARE = 2.0, 0.8  # of d and of the expected displacement, while a pull is learnt that has changed

NO_MOTION: Vector = np.zeros(2)
NO_MOTION.flags.writeable = False  # shared by all steps without one


class MotionObserver:
    """Estimates the velocity that the thread's pull gives the needle, beside what its currents give it by the model.

    A Kalman filter of the place p of the chord's middle and of that velocity d, in the dish's frame. Between two poses,
    T apart, with the mean c of the velocity by the currents,

        p' = p + T (c + d),    d' = d + noise,    var = PULL_NOISE T

    p is measured with the variance PLACE_DEVIATION^2 + x^2, where x is half of the difference of T c between the
    intervals one deviation of the stamps earlier and later. A needle that a field turns, with the unit vector e along
    its chord l by de, moves p by a share of l de / 2, from none about its middle to all about a tail that a thread
    holds. So (`SWING_SHARE` l |de| / 2)^2, times `SWING_TIME` / T where that is greater than 1, adds to the variance
    of p', with the part of de that the field was set to make: a turn is no pull. Compensated by poses 0.1 s old, it
    would throw the needle back and forth.
    d is at most `max_speed`, by the force that a thread can have. The coils compensate d: for the motion u they are set
    to c = u - d. Where the needle moves at k c, d converges with poses up to 0.4 s late for k from 0.5 to 1.5, so the
    drag of the model is the needle's own: that of the thread is a part of the pull.

    What makes |d| smaller counts at once. What makes it greater counts only if it can be seen: once the middle has
    moved by `VISIBLE` since the last pose that counted, or while no currents are on, or while the needle is trusted to
    be tracked. Poses that stand still thus wind up nothing.

    Source: the Kalman filter of a constant disturbance. Deviation: d is bounded. Pure: times come in, in seconds.

    Args:
        needle: its kinematics.
        min_hold: the coils hold their currents for at least this long; for how much longer is not known [s].
        max_speed: of the pull that is compensated [m/s].
    """

    def __init__(self, needle: NeedleKinematics, min_hold: float = math.inf, max_speed: float = math.inf) -> None:
        self._needle, self._min_hold, self._max_speed = needle, min_hold, max_speed
        limit_pair(0.0, 0.0, max_speed)  # loaded now, and not within the loop
        self._place, self._velocity, self._covariance = np.zeros(2), np.zeros(2), np.zeros((2, 2))
        self._last: tuple[float, Vector, Vector] | None = None  # stamp, middle and chord's direction of the last pose
        self._seen: tuple[float, Vector, Vector] | None = None  # the last pose that counted, as `_last`
        self._interval = 0.0  # between poses [s]
        self._innovation = math.nan  # of the last pose, squared over its variance
        self._applied: deque[tuple[float, Vector]] = deque()  # what the currents were set for, each with its start

    @property
    def velocity(self) -> Vector:
        """The velocity d in the dish's frame, shape (2,) [m/s]."""
        return self._velocity

    def pull(self, heading: Vector, velocity: Vector | None = None) -> NeedleTwist:
        """Return d, or a velocity of shape (2,) [m/s] in its place, as the motion of a needle with a unit heading."""
        (ex, ey), (x, y) = self._needle.chord_direction(heading), self._velocity if velocity is None else velocity
        return NeedleTwist(float(ex * x + ey * y), float(ex * y - ey * x), 0.0)

    def place_deviation(self, now: float) -> float:
        """Return the standard deviation of the place, in each direction, until a next pose can be answered [m].

        That is the time a = age + T from the last pose, with the interval T of poses. Carried on by its mean velocity
        between the last two, a middle whose velocity changes as a pull does is off by

            s^2 = `PULL_NOISE` a^2 (a + T) / 3 + `PLACE_DEVIATION`^2 ((1 + a / T)^2 + (a / T)^2)

        0 before there are two poses, as no pull is known then.
        """
        interval = self._interval
        if self._last is None or not interval:
            return 0.0
        after = min(MAX_GAP, max(0.0, now - self._last[0]) + interval)
        drift, share = PULL_NOISE * after**2 * (after + interval) / 3.0, after / interval
        return math.sqrt(drift + PLACE_DEVIATION**2 * ((1.0 + share) ** 2 + share**2))

    def update(
        self, tail: Vector, heading: Vector, stamp: float, trusted: bool = False, stamp_deviation: float = 0.0
    ) -> MotionStep | None:
        """Update with a measured pose; return the motion since the last one, None where it cannot be compared.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            stamp: when it was measured [s].
            trusted: whether to learn also from a needle that stands still.
            stamp_deviation: standard deviation of that time [s].
        """
        e = self._needle.chord_direction(heading)
        middle = tail + 0.5 * self._needle.chord * e
        last, self._last = self._last, (stamp, middle, e)
        if last is None or not 0.0 < stamp - last[0] <= MAX_GAP:
            self._velocity, self._seen = np.zeros(2), None
        self._learn(self._last, trusted, stamp_deviation)
        interval = 0.0 if last is None else stamp - last[0]
        self._interval = interval if 0.0 < interval <= MAX_GAP else self._interval
        applied = self._mean_applied(stamp - interval, stamp) if 0.0 < interval <= MAX_GAP else None
        if last is None or applied is None:
            return None
        turn, swing = self._turned(last[2], e)
        expected, turned = interval * applied[2:4], interval * applied[4]
        driven, measured = interval * applied[:2], middle - last[1]
        seen = driven, self._velocity, self._innovation
        return MotionStep(stamp, interval, expected, turned, measured, turn, swing, *seen)

    def _learn(self, pose: tuple[float, Vector, Vector], trusted: bool, deviation: float) -> None:
        """Update the filter with a measured pose, see `_last`, if that counts."""
        (stamp, middle, direction), seen, self._innovation = pose, self._seen, math.nan
        interval = math.inf if seen is None else stamp - seen[0]
        applied = self._mean_applied(stamp - interval, stamp) if interval <= MAX_STILL else None
        if seen is None or applied is None:
            self._seen = pose
            self._place, self._covariance = middle, np.diag([PLACE_DEVIATION**2, PULL_NOISE * MAX_GAP])
            return
        place, covariance = self._predicted(interval, applied[:2])
        turn, swing = self._turned(seen[2], direction)
        swing = _share_of_field(interval * applied[4], turn) * swing
        covariance[0, 0] += SWING_SHARE**2 * float(swing @ swing) * max(1.0, SWING_TIME / interval)
        early, late = (self._mean_applied(stamp - interval + by, stamp + by) for by in (-deviation, deviation))
        change = np.zeros(5) if early is None or late is None else 0.5 * interval * (late - early)
        noise, doubt = covariance[0, 0] + PLACE_DEVIATION**2, float(change[:2] @ change[:2])
        off = middle - place
        self._innovation = float(off @ off) / (2.0 * (noise + STAMP_DEVIATIONS**2 * doubt))
        gain = covariance[0] / (noise + doubt)
        learnt = self._velocity + gain[1] * (middle - place)
        velocity = np.array(limit_pair(float(learnt[0]), float(learnt[1]), self._max_speed))
        is_seen = trusted or not applied[:2].any() or math.hypot(*(middle - seen[1])) > VISIBLE
        if is_seen or math.hypot(*velocity) < math.hypot(*self._velocity):
            self._seen, self._velocity = pose, velocity
            self._place, self._covariance = (
                place + gain[0] * (middle - place),
                covariance - np.outer(gain, covariance[0]),
            )

    def _turned(self, before: Vector, after: Vector) -> tuple[float, Vector]:
        """Return the turn between two directions of the chord [rad], and the way of the middle about the tail [m]."""
        turn = math.atan2(before[0] * after[1] - before[1] * after[0], float(before @ after))
        return turn, 0.5 * self._needle.chord * (after - before)

    def _predicted(self, interval: float, applied: Vector) -> tuple[Vector, Vector]:
        """Return place [m] and covariance after an interval [s] with a velocity by the currents, shape (2,) [m/s]."""
        step = np.array([[1.0, interval], [0.0, 1.0]])
        noise = PULL_NOISE * np.array([[interval**3 / 3.0, interval**2 / 2.0], [interval**2 / 2.0, interval]])
        return self._place + interval * (applied + self._velocity), step @ self._covariance @ step.T + noise

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
            self._velocity = np.zeros(2)
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
        driven: displacement of the middle that the currents alone would give, shape (2,) [m].
        pull: velocity that the thread's pull gives it, as it is known at the second pose, shape (2,) [m/s].
        innovation: nu . nu / (2 S) of the second pose, with the innovation nu of the observer's filter and its variance
            S in each direction, with stamps that are off by `STAMP_DEVIATIONS`; not a number where the pose cannot be
            compared.
    """

    stamp: float
    interval: float
    expected: Vector
    expected_turn: float
    measured: Vector
    measured_turn: float
    swing: Vector
    driven: Vector = NO_MOTION
    pull: Vector = NO_MOTION
    innovation: float = math.nan


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
    commanded in that window shows it as well.

    A turn proves no place, and a moving place no heading. So the displacement by currents and pull is kept since the
    middle was last seen to move, with the pull that was known then, and the turn of the field since the heading was
    last seen to turn, less what a thread's torque may take of it: that is how far a needle has gone whose poses are not
    its own. Beyond `MAX_UNSEEN`, or `MAX_UNSEEN_TURN` of a needle that nothing but its thread touches, they are taken
    for that.

    Nor are poses the needle's that change their motion faster than a pull does: the mean of nu . nu / (2 S) of the
    observer's filter over `MIN_WINDOW`, and at least `MIN_INNOVATIONS` poses, is at most `MAX_INNOVATION`.

    Pure: times come in, in seconds of the stamps' clock.

    Source: none.

    Args:
        min_distance: shorter displacements are not judged [m].
        slack_ratio: how many times as fast as expected the needle moves when the thread is slack.
        max_interval: between two poses, up to which their motion is compared with the expected one [s]: in a longer one
            the coils were off, and a thread has moved the needle.
    """

    def __init__(self, min_distance: float, slack_ratio: float = 1.0, max_interval: float = math.inf) -> None:
        self._min_distance, self._slack_ratio = max(min_distance, MIN_DISTANCE), slack_ratio
        self._max_interval = max_interval
        self._steps: deque[MotionStep] = deque()
        # Since the middle was last seen to move: its displacement, as measured and as driven; the pull that was known.
        self._still, self._unseen, self._proven = NO_MOTION, NO_MOTION, NO_MOTION
        self._still_turn = self._unseen_turn = 0.0  # since the heading was last seen to turn, the same [rad]
        self._innovations: deque[tuple[float, float]] = deque()  # stamp and innovation
        self._probed: float | None = None  # stamp of the pose that began the probe
        self._followed = -math.inf  # stamp of the pose up to which a turn has shown that the needle follows
        self._turned = 0.0  # by which the field was turned since the probe began
        self._direction = 1.0
        self._trusted_until = -math.inf
        self._suspicion = ""

    def clear(self) -> None:
        """Forget all motion, as of a needle that is armed anew."""
        self._still, self._unseen, self._proven = NO_MOTION, NO_MOTION, NO_MOTION
        self._still_turn = self._unseen_turn = 0.0
        self._innovations.clear()
        self._steps.clear()
        self._probed, self._followed = None, -math.inf

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

    def unproven_pull(self, pull: Vector) -> Vector:
        """Return with what part of a pull the needle is let go, shape (2,) [m/s].

        A needle that is held against a pull that grows may stand so still that its place proves nothing. From half of
        `MAX_UNSEEN` on, and wholly from three quarters, it is to move with what that pull is more than when the needle
        last moved: then it is seen to.
        """
        share = min(1.0, max(0.0, 4.0 * math.hypot(*self._unseen) / MAX_UNSEEN - 2.0))
        known = self._proven if float(self._proven @ pull) > 0.0 else NO_MOTION
        return np.asarray(share * (pull - known))

    def is_trusted(self, stamp: float) -> bool:
        """Return whether a probe has lately shown that the poses are the needle's."""
        return stamp <= self._trusted_until

    def update(self, step: MotionStep, at_shape: bool = False) -> str:
        """Take the motion between two poses; return why the needle does not follow, or an empty text.

        Args:
            step: the motion.
            at_shape: whether the needle lies at wall or shape, which may hold it for a while.
        """
        self._count_unseen(step)
        if (unseen := math.hypot(*self._unseen)) > MAX_UNSEEN:
            return f"needle does not follow: it is not seen to move, where it is driven by {1e3 * unseen:.2g} mm"
        if abs(self._unseen_turn) > MAX_UNSEEN_TURN and not at_shape:
            return (
                f"needle does not follow: it is not seen to turn, where the field turns by {self._unseen_turn:.2g} rad"
            )
        if (innovation := self._mean_innovation(step)) > MAX_INNOVATION and not at_shape:
            text = f"its motion changes by {math.sqrt(innovation):.2g} standard deviations of what a pull does"
            return f"needle does not follow: {text}"
        if step.interval > self._max_interval:
            return ""
        min_distance = self._min_distance * (SHAPE_FACTOR if at_shape else 1.0)
        self._steps.append(step)
        while step.stamp - self._steps[0].stamp > MAX_WINDOW:
            self._steps.popleft()
        expected, measured, swing, about_tail = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
        field_turn = turn = error = span = 0.0
        for entry in reversed(self._steps):
            expected, measured = expected + entry.expected, measured + entry.measured
            if span < MIN_WINDOW:
                field_turn, turn = field_turn + entry.expected_turn, turn + entry.measured_turn
                swing = swing + entry.swing
                about_tail = _share_of_field(field_turn, turn) * swing
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
        if self._probed is not None:
            return self._judge_probe(step.stamp, self._probed)
        is_new = step.stamp - span > self._followed - 1e-9
        enough = span >= MIN_WINDOW and distance >= min_distance and bool(step.expected.any())
        if not (enough and is_new) or measured @ expected >= MIN_SHARE * distance**2:
            return ""
        if is_straight and span <= 2.0 * MIN_WINDOW and moved > STILL_SHARE * distance + math.hypot(*about_tail):
            return f"{text}, elsewhere"
        self._suspicion, self._probed, self._turned = text, step.stamp, 0.0
        self._direction = math.copysign(1.0, field_turn)
        self._judge_turn(step.stamp, field_turn - step.expected_turn, turn)  # a needle that lags is probed
        return ""

    def _count_unseen(self, step: MotionStep) -> None:
        """Count by how much the needle should have moved and turned since it was last seen to."""
        self._still = self._still + step.measured
        if math.hypot(*self._still) > VISIBLE:
            self._still, self._unseen, self._proven = NO_MOTION, NO_MOTION, step.pull
        elif step.driven.any():
            self._unseen = self._unseen + step.driven + step.interval * self._proven
        self._proven = min(self._proven, step.pull, key=lambda pull: math.hypot(*pull))
        self._still_turn, unseen = self._still_turn + step.measured_turn, self._unseen_turn + step.expected_turn
        # A torque that lasts keeps the needle off its field by as much, whatever the model says of its turning.
        held = step.interval * TORQUE_ANGLE / TORQUE_TIME if step.expected_turn else 0.0
        self._unseen_turn = math.copysign(max(0.0, abs(unseen) - held), unseen)
        if abs(self._still_turn) > VISIBLE_TURN:
            self._still_turn = self._unseen_turn = 0.0

    def _mean_innovation(self, step: MotionStep) -> float:
        """Return the mean innovation of the last poses; 0 where there are too few."""
        if math.isnan(step.innovation):
            self._innovations.clear()
            return 0.0
        self._innovations.append((step.stamp, step.innovation))
        while len(self._innovations) > MIN_INNOVATIONS and step.stamp - self._innovations[0][0] > MIN_WINDOW:
            self._innovations.popleft()
        enough = len(self._innovations) >= MIN_INNOVATIONS
        return sum(value for _, value in self._innovations) / len(self._innovations) if enough else 0.0

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
        problem = self._judge_turn(stamp, sum(entry.expected_turn for entry in steps[:-1]), turn)
        is_over = self._probed is not None and stamp - since > PROBE_TIMEOUT
        return self._suspicion if is_over else problem

    def _judge_turn(self, stamp: float, expected: float, measured: float) -> str:
        """End the probe once the field has turned far enough; return why the needle does not follow, or nothing.

        Args:
            stamp: of the last pose [s].
            expected: turn of the field up to the pose before, as the needle takes its time to turn to it [rad].
            measured: turn of the needle up to the last pose [rad].
        """
        if abs(expected) < 0.8 * PROBE_TURN:
            return ""
        if measured * math.copysign(1.0, expected) < PROBE_SHARE * abs(expected):
            return self._suspicion
        self._probed, self._followed, self._trusted_until = None, stamp, stamp + TRUST_TIME
        return ""


def _share_of_field(field_turn: float, turn: float) -> float:
    """Return which share of a measured turn the field was set to make, 0 to 1."""
    return min(1.0, max(0.0, field_turn / turn)) if turn else 0.0


def _distance(point: Vector, side: Vector) -> float:
    """Return how far a point, shape (2,), is from the line from 0 to another one [m]."""
    share = min(1.0, max(0.0, float(point @ side) / max(float(side @ side), 1e-24)))
    return math.hypot(*(point - share * side))
