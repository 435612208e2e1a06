"""Whether the needle follows: its measured motion against the motion that the coils were set to give it."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

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


class MotionStep(NamedTuple):
    """Motion of the needle between two measured poses, beside what the coils were set for.

    Attributes:
        stamp: of the second pose [s].
        interval: between both [s].
        expected: displacement of the needle's middle that was intended, shape (2,) [m].
        expected_turn: angle by which the field was set to turn the needle [rad].
        measured: displacement of the middle, shape (2,) [m].
        measured_turn: change of the heading [rad].
    """

    stamp: float
    interval: float
    expected: Vector
    expected_turn: float
    measured: Vector
    measured_turn: float


class FollowMonitor:
    """Compares how the poses move with how the coils should have moved the needle.

    With the expected displacement E and the measured one M of the needle's middle, the poses are not the needle's where

        |M - s E| > max(MAX_ERROR d, MAX_ERROR_SHARE |E|)    for every s from 0 (held) to the slack ratio,

    with the minimum distance d, or where the heading turns `MAX_TURN` farther than the field; both within
    `MIN_WINDOW`. The needle stands still where

        M . E < MIN_SHARE |E|^2

    in the shortest window of at least `MIN_WINDOW` with |E| >= d, and is not the needle where |M| > STILL_SHARE |E|
    within twice that time. A taut thread may hold it: the field then probes it
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
        expected, measured, error, span = np.zeros(2), np.zeros(2), 0.0, 0.0
        field_turn = turn = 0.0
        for entry in reversed(self._steps):
            expected, measured = expected + entry.expected, measured + entry.measured
            if span < MIN_WINDOW:
                field_turn, turn = field_turn + entry.expected_turn, turn + entry.measured_turn
                error = self._error(expected, measured)
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
        if is_straight and error > max(MAX_ERROR * min_distance, MAX_ERROR_SHARE * distance):
            return f"{text}, elsewhere"
        enough = span >= MIN_WINDOW and distance >= min_distance and bool(step.expected.any())
        if not enough or measured @ expected >= MIN_SHARE * distance**2:
            return ""
        if is_straight and span <= 2.0 * MIN_WINDOW and moved > STILL_SHARE * distance:
            return f"{text}, elsewhere"
        self._suspicion, self._probed, self._turned = text, step.stamp, 0.0
        self._direction = math.copysign(1.0, field_turn)
        return self._judge_turn(step.stamp, field_turn, turn)

    def _error(self, expected: Vector, measured: Vector) -> float:
        """Return how far a displacement is from those between none, and the expected one with a slack thread [m]."""
        size = max(math.hypot(*expected), 1e-12)
        share = min(self._slack_ratio, max(0.0, float(measured @ expected) / size**2))
        return math.hypot(*(measured - share * expected))

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
