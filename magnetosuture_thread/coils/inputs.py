"""Checks and timeouts of the bridge's inputs: stamps, publishers, commands, margins, needle poses.

Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.settings.errors import InvalidInputError, shortened

Vector = NDArray[np.float64]

CLOCK_TOLERANCE = 0.05  # s; clocks of two machines may differ by this much
SILENCE_TIMEOUT = 0.5  # s; a publisher without a message for this long is gone
AGE_WINDOW = 5.0  # s
SCENE_GRACE_PERIOD = 0.5  # s for which model and bridge may be on different versions of the scene during a change
BodyVelocity = tuple[float, float, float]
"""Velocity of the tip along the chord and across it, and as much of that as is of the whole needle [m/s]."""
ZERO_VELOCITY: BodyVelocity = (0.0, 0.0, 0.0)
TOPIC = "needle/measured_cp"
CONSISTENT_POSES = 5  # consecutive consistent poses until poses are accepted again after a rejected one


class StampAges:
    """Keeps how old messages were when they arrived, by topic.

    The minimum age of the last seconds is the network's shortest delay plus how far the sender's clock is behind; a
    negative one says that it is ahead, by that much at least.
    """

    def __init__(self) -> None:
        self._ages: dict[str, deque[tuple[float, float]]] = {}

    def add(self, topic: str, age: float, arrival: float) -> None:
        """Register a message, accepted or not.

        Args:
            topic: of the message.
            age: time of its arrival minus its stamp, by the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        entries = self._ages.setdefault(topic, deque())
        while entries and entries[-1][1] >= age:  # later and less: those before will not be the minimum again
            entries.pop()
        entries.append((arrival, age))

    def minimum(self, arrival: float) -> dict[str, float]:
        """Return the minimum age of each topic with a message in the last `AGE_WINDOW` before a monotonic time [s]."""
        for entries in self._ages.values():
            while entries and arrival - entries[0][0] > AGE_WINDOW:
                entries.popleft()
        return {topic: entries[0][1] for topic, entries in self._ages.items() if entries}


class PublisherCounter:
    """Counts the publishers that are active on a topic, by the sequence numbers of their messages.

    Two publishers that command one needle would work against each other. Messages do not name their sender, but
    each publisher numbers its own from 1 on. A message continues the publisher whose last number is just before
    its own; without such a publisher it comes from a new one.
    """

    def __init__(self) -> None:
        self._publishers: list[tuple[int, float]] = []  # last number, and its arrival

    def update(self, number: int, arrival: float) -> int:
        """Register a message and return the number of active publishers.

        Args:
            number: of the message, counted by its publisher.
            arrival: a monotonic time [s].
        """
        self._drop_silent(arrival)
        # Up to 99 messages in a row may get lost.
        before = [publisher for publisher in self._publishers if 0 < number - publisher[0] <= 100]
        if before:
            self._publishers.remove(max(before))
        self._publishers.append((number, arrival))
        return len(self._publishers)

    def count(self, arrival: float) -> int:
        """Return the number of active publishers at a monotonic time [s]."""
        self._drop_silent(arrival)
        return len(self._publishers)

    def _drop_silent(self, arrival: float) -> None:
        self._publishers = [entry for entry in self._publishers if arrival - entry[1] <= SILENCE_TIMEOUT]


class InputCheck:
    """Checks the messages of one input: finite, stamped in time and in order, and of one publisher.

    Args:
        topic: of the input, for errors and reasons.
        max_age: maximum age of a stamp [s].

    Attributes:
        stamp: of the last valid message, -inf before the first [s].
    """

    def __init__(self, topic: str, max_age: float) -> None:
        self.stamp = -math.inf
        self._topic, self._max_age, self._publishers = topic, max_age, PublisherCounter()

    def update(
        self, values: Vector, field: str, expected: str, stamp: float, number: int, now: float, arrival: float
    ) -> None:
        """Accept a message or reject it.

        Args:
            values: of the message.
            field: of the values, for the error.
            expected: the same.
            stamp: when it was made [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].

        Raises:
            InvalidInputError: a value is not finite; the stamp is not set, too old, from the future, or older than the
                last one, unless that is from the future, as after time was set back; or there are several publishers.
        """
        publishers = self._publishers.update(number, arrival)
        if not np.all(np.isfinite(values)):
            raise InvalidInputError(f"{self._topic}.{field}", values.tolist(), expected)
        name, last = f"{self._topic}.header.stamp", self.stamp
        if stamp <= 0.0 or now <= 0.0:
            found = f"{stamp:g} s at the time {now:g} s"
            raise InvalidInputError(name, found, "a time: 0 is none in ROS, as before /clock")
        if now - stamp > self._max_age:
            raise InvalidInputError(name, f"{now - stamp:.3f} s old", f"at most {self._max_age:g} s")
        if stamp - now > CLOCK_TOLERANCE:
            raise InvalidInputError(name, f"{stamp - now:.3f} s ahead", f"at most {CLOCK_TOLERANCE:g} s")
        if stamp < last <= now + CLOCK_TOLERANCE:
            raise InvalidInputError(name, f"{stamp:.6f} s", f"no earlier than the last one's {last:.6f} s")
        if publishers > 1:
            raise InvalidInputError(self._topic, f"{publishers} publishers at once", "one")
        self.stamp = stamp

    def conflict(self, arrival: float) -> str:
        """Return a text if several publishers are active at a monotonic time [s]; empty if not."""
        return f"several publishers of {self._topic} at once" if self._publishers.count(arrival) > 1 else ""


class CommandWatchdog:
    """Keeps the last valid command of one input until it is stale.

    Args:
        timeout: a command is valid for this long after its arrival, and its stamp may be this old [s].
        topic: of the input, for errors and reasons.
    """

    def __init__(self, timeout: float, topic: str = "needle/servo_cv") -> None:
        self._timeout, self._check = timeout, InputCheck(topic, timeout)
        self._velocity = np.zeros(2)
        self._arrival = -math.inf

    def update(self, velocity: Vector, stamp: float, number: int, now: float, arrival: float) -> None:
        """Accept a command, or reject it and keep the last one until that is stale.

        Args:
            velocity: see `CoilBridge.command`.
            stamp: when it was made [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].

        Raises:
            InvalidInputError: the command is not finite, too old, from the future, older than the last one, or
                there are several publishers.
        """
        self._check.update(velocity, "twist", "finite numbers", stamp, number, now, arrival)
        self._velocity, self._arrival = np.array(velocity, dtype=np.float64), arrival

    def clear(self) -> None:
        """Drop the last command; only later ones are valid."""
        self._arrival = -math.inf

    @property
    def velocity(self) -> Vector:
        """The last valid command, see `CoilBridge.command`."""
        return self._velocity

    @property
    def stamp(self) -> float:
        """Stamp of the last valid command [s], -inf before the first."""
        return self._check.stamp

    def has_conflict(self, arrival: float) -> bool:
        """Return whether several publishers are active at a monotonic time [s]."""
        return bool(self._check.conflict(arrival))

    @property
    def is_empty(self) -> bool:
        """Whether there was no valid command since the last `clear`."""
        return self._arrival == -math.inf

    def stale_reason(self, now: float, arrival: float) -> str:
        """Return why there is no valid command at a time; empty if there is one.

        A command becomes stale by its stamp, which includes its transport, and by its arrival, as the stamps'
        clock may stand still.

        Args:
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        if conflict := self._check.conflict(arrival):
            return conflict
        if self.is_empty:
            return "no command yet"
        age = max(arrival - self._arrival, now - self.stamp)
        return "" if age <= self._timeout else f"no command for {self._timeout:g} s"


class PredictionMonitor:
    """Keeps the last valid margins of the thread model. Pure: times come in, in seconds.

    Args:
        timeout: margins are valid for this long after their stamp and their arrival [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._stamp = self._arrival = -math.inf  # of the last valid margins
        self._last_arrival = -math.inf  # of the last margins, valid or not
        self._slowdown = 1.0
        self._version: str | None = None
        self._agreed = math.inf  # when model and bridge last had one version; initially when both were known

    def update(self, stamp: float, valid: bool, slowdown: float, scene_version: str, arrival: float) -> None:
        """Register the model's margins; invalid ones leave the last valid ones until these are stale.

        Raises:
            InvalidInputError: slowdown or stamp is out of range.
        """
        if valid and not (0.0 <= slowdown <= 1.0):
            raise InvalidInputError("thread/margins.slowdown", slowdown, "a factor from 0 to 1")
        if not math.isfinite(stamp):
            raise InvalidInputError("thread/margins.header.stamp", stamp, "a time [s]")
        self._last_arrival, self._version = arrival, shortened(scene_version)
        if valid:
            self._stamp, self._arrival, self._slowdown = stamp, arrival, slowdown

    def stale_reason(self, now: float, arrival: float) -> str:
        """Return why there is no prediction at a time of the stamps' clock and a monotonic time; empty if there is."""
        if self._arrival == -math.inf:
            return "no thread prediction yet" if self._last_arrival == -math.inf else "no valid thread prediction yet"
        age = max(arrival - self._arrival, now - self._stamp)
        return "" if age <= self._timeout else f"no thread prediction for {self._timeout:g} s"

    @property
    def slowdown(self) -> float:
        """The last valid factor on the needle's speed."""
        return self._slowdown

    def scene_mismatch(self, scene_version: str, arrival: float) -> str:
        """Return a text if the model has had another scene for too long; empty if not, or if the model is silent.

        Args:
            scene_version: the bridge's.
            arrival: a monotonic time [s].
        """
        if self._version is None or arrival - self._last_arrival > max(self._timeout, SCENE_GRACE_PERIOD):
            return ""
        if self._version == scene_version or self._agreed == math.inf:
            self._agreed = arrival
        if arrival - self._agreed <= SCENE_GRACE_PERIOD:
            return ""
        return f"scene: thread_model has {self._version or 'none'}, coil_bridge has {scene_version or 'none'}"


@dataclass(frozen=True)
class Pose:
    """Needle pose: tail, shape (2,) [m], unit heading at the tail, shape (2,), and time since it was measured [s]."""

    tail: Vector
    heading: Vector
    age: float = 0.0


@dataclass(frozen=True)
class _Measured:
    """Measured ends of the needle [m], their stamp [s] and uncertainty [m]."""

    tail: Vector
    tip: Vector
    stamp: float
    uncertainty: float


class PoseExtrapolator:
    """Keeps the last plausible needle pose until it is stale, and extrapolates it to the present.

    A camera's pose is some hundredths of a second old. In that time the needle turns by some degrees and moves
    closer to the wall, and the field must be aligned with its present pose. The pose is therefore extrapolated by
    the tip velocities applied since its stamp, see `NeedleKinematics`.

    After a stall longer than `min_hold` it is unknown when the coils stopped. Poses from before `max_hold`, when
    they have certainly stopped, are then not used.

    A pose with an end outside the dish, or farther from the last one than the needle can move, is rejected. After
    that all poses are, until one agrees with the last accepted one again, or `CONSISTENT_POSES` consecutive ones are
    in the dish and consistent with each other. The latter is not enough while armed.

    Args:
        needle: its kinematics.
        timeout: a pose is valid for this long after its stamp and its arrival [s].
        reach: both ends must be nearer to the dish's centre than this; the coils are beyond it [m].
        max_speed: of both ends [m/s].
        uncertainty: error of measured ends, in addition to a pose's own covariance [m].
        min_hold: the coils hold their currents for at least this long without a step [s].
        max_hold: and for at most this long [s].

    Attributes:
        dish_radius: infinite without a scene [m].
        rejections: consecutive poses that were rejected.
        rejection: why the last pose was; empty if it was accepted.
        first_stamp: of the first pose; infinite before [s].
    """

    def __init__(
        self,
        needle: NeedleKinematics,
        timeout: float,
        reach: float,
        *,
        max_speed: float = math.inf,
        uncertainty: float = 0.0,
        min_hold: float = math.inf,
        max_hold: float = math.inf,
    ) -> None:
        self.dish_radius = self.first_stamp = math.inf
        self.rejections = 0
        self._needle, self._timeout, self._reach = needle, timeout, reach
        self._max_speed, self._uncertainty = max_speed, uncertainty
        self._min_hold, self._max_hold = min_hold, max_hold
        self._check = InputCheck(TOPIC, timeout)
        self._arrival = -math.inf  # of the last accepted one
        self._accepted: _Measured | None = None
        self._late = 0.0  # by how much it is older than its stamp [s]
        self.rejection = ""
        self._candidate: _Measured | None = None
        self._consistent = 0  # consecutive consistent poses
        self._rejected_since = math.inf  # stamp of the first of consecutive poses that were rejected
        self._unknown_until = -math.inf  # poses stamped before this time are not used
        self._extrapolated: Pose | None = None
        self._until = -math.inf  # time of the extrapolated pose
        self._velocity = ZERO_VELOCITY
        self._applied_at = -math.inf  # monotonic time at which it was applied
        self._history: deque[tuple[float, BodyVelocity]] = deque()  # velocities, each with its start

    def update(
        self,
        tail: Vector,
        heading: Vector,
        stamp: float,
        number: int,
        now: float,
        arrival: float,
        covariance: Vector | None = None,
        armed: bool = False,
        stamp_error: float = 0.0,
    ) -> None:
        """Register a measured pose.

        Args:
            tail: shape (2,) [m].
            heading: unit vector, shape (2,).
            stamp: when it was measured [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].
            covariance: of x, y and the heading's angle, shape (3, 3) [m, m, rad]; None where it is not known.
            armed: whether the needle may be moved.
            stamp_error: by how much the stamp is later than the pose was measured, as estimated [s]. The pose is
                extrapolated from then, and counts as old as the older of both; what is refused goes by the stamp.

        Raises:
            InvalidInputError: the pose is not finite, too old, from the future, older than the last one, not
                plausible, or there are several publishers.
        """
        newest = self._check.stamp
        self._check.update(np.append(tail, heading), "pose", "finite numbers", stamp, number, now, arrival)
        if stamp < newest:  # time was set back
            self._accepted = self._candidate = None
            self._rejected_since, self._unknown_until = math.inf, -math.inf
            self._history.clear()
        self.first_stamp = min(self.first_stamp, stamp)
        measured = _Measured(tail, self._needle.tip(tail, heading), stamp, self._pose_uncertainty(covariance))
        self._check_plausible(measured, armed)
        self._check_stall(arrival)
        if stamp < self._unknown_until:
            raise InvalidInputError(TOPIC, "a pose from a stall of the loop", "one after the coils have stopped")
        self._accepted, self._arrival = measured, arrival
        # A stamp slightly in the future, as clocks differ, counts as now.
        self._extrapolated, self._until = Pose(tail, heading), min(stamp - stamp_error, now)
        self._late = max(0.0, stamp_error)
        if self._history:  # before the first velocity kept the needle was at rest
            self._until = max(self._until, min(self._history[0][0], now))
        times = [since for since, _ in self._history][1:]
        for (_, velocity), end in zip(self._history, times, strict=False):
            self._extrapolate(velocity, end)

    def stale_reason(self, now: float, arrival: float) -> str:
        """Return why there is no valid pose at a time of the stamps' clock and a monotonic time [s]; empty if there is.

        A pose becomes stale by its stamp or by its arrival, whichever comes first.
        """
        if conflict := self._check.conflict(arrival):
            return conflict
        if self.rejection:
            return f"needle pose rejected: {self.rejection}"
        if self._accepted is None:
            return "no needle pose yet"
        if max(arrival - self._arrival, now - self._accepted.stamp + self._late) > self._timeout:
            return f"no needle pose for {self._timeout:g} s"
        return "no needle pose since the loop stalled" if self._extrapolated is None else ""

    def apply_velocity(self, velocity: Vector, now: float, arrival: float, drift: float = 0.0) -> None:
        """Register the tip velocity that the coils give from a time on.

        The velocity is constant in the needle's frame until the next call: force and torque move with the needle.

        Args:
            velocity: shape (2,) [m/s].
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
            drift: part of it across the chord that the whole needle has [m/s]; the rest turns the needle.
        """
        self._check_stall(arrival)
        if self._history and now < self._history[-1][0]:
            self._history.clear()  # time was set back
        self._extrapolate(self._velocity, now)
        self._velocity, self._applied_at = ZERO_VELOCITY, arrival
        if velocity.any() and self._extrapolated is not None:
            self._velocity = (*self._needle.body_velocity(self._extrapolated.heading, velocity), drift)
        self._history.append((now, self._velocity))
        while len(self._history) > 1 and self._history[1][0] < now - self._timeout:
            self._history.popleft()

    def pose(self, now: float, arrival: float) -> Pose | None:
        """Return the pose extrapolated to a time of the stamps' clock and a monotonic time [s]; None if it is stale."""
        self._check_stall(arrival)
        if self._extrapolated is None or self._accepted is None or self.stale_reason(now, arrival):
            return None
        self._extrapolate(self._velocity, now)
        # By the worse of both, as `stale_reason`: the stamps' clock may be ahead, or be set back.
        return replace(
            self._extrapolated, age=max(0.0, now - self._accepted.stamp + self._late, arrival - self._arrival)
        )

    def _check_plausible(self, measured: _Measured, armed: bool) -> None:
        """Reject an implausible pose; see the class."""
        outside = self._check_bounds(measured)
        problem = outside or self._check_jump(self._accepted, measured)
        if problem is not None:
            agrees = self._candidate is not None and not self._check_jump(self._candidate, measured)
            self._consistent = 0 if outside else self._consistent + 1 if agrees else 1
            self._candidate = None if outside else measured
            if armed or self._consistent < CONSISTENT_POSES:
                self.rejection = f"{problem[0]}, {problem[1]}"
                self._rejected_since = min(self._rejected_since, measured.stamp)
                self.rejections += 1
                raise InvalidInputError(f"{TOPIC}.pose", *problem)
        self.rejection, self._rejected_since, self.rejections = "", math.inf, 0
        self._candidate, self._consistent = None, 0

    def _check_bounds(self, measured: _Measured) -> tuple[str, str] | None:
        """Return what is wrong with an end outside the dish or beyond reach, and the expectation."""
        limit = min(self._reach, self.dish_radius + self._uncertainty + measured.uncertainty)
        for name, end in (("tail", measured.tail), ("tip", measured.tip)):
            distance = math.hypot(*end)
            if distance > limit:
                return f"its {name} is {distance:g} m from the dish's centre", f"within {limit:g} m"
        return None

    def _check_jump(self, last: _Measured | None, measured: _Measured) -> tuple[str, str] | None:
        """Return what is wrong with an end that moved farther than the needle can, and the expectation."""
        if last is None:
            return None
        # From a stop on, only the thread moves the needle; without poses the coils stop after timeout and hold.
        stopped = self._rejected_since if last is self._accepted else math.inf
        elapsed = min(measured.stamp, stopped, last.stamp + self._timeout + self._max_hold) - last.stamp
        max_distance = self._max_speed * elapsed + self._uncertainty + measured.uncertainty + last.uncertainty
        for name, end, before in (("tail", measured.tail, last.tail), ("tip", measured.tip, last.tip)):
            distance = math.hypot(*(end - before))
            if distance > max_distance:
                return f"its {name} jumped by {distance:.2g} m in {elapsed:.2g} s", f"at most {max_distance:.2g} m"
        return None

    def _pose_uncertainty(self, covariance: Vector | None) -> float:
        """Return the uncertainty of both ends by a pose's covariance [m]."""
        if covariance is None or not np.isfinite(covariance).all():
            return 0.0
        square = covariance[0, 0] + covariance[1, 1] + self._needle.chord**2 * covariance[2, 2]
        return min(2e-3, 3.0 * math.sqrt(max(0.0, square)))

    def _check_stall(self, arrival: float) -> None:
        """Drop the pose after a stall longer than the coils certainly hold their currents."""
        if self._velocity == ZERO_VELOCITY or arrival - self._applied_at <= self._min_hold + 1e-6:
            return
        self._unknown_until = self._history[-1][0] + self._max_hold if self._history else -math.inf
        self._velocity = ZERO_VELOCITY
        self._history.clear()
        if self._accepted is not None and self._accepted.stamp < self._unknown_until:
            self._extrapolated = None

    def _extrapolate(self, velocity: BodyVelocity, now: float) -> None:
        """Extrapolate the pose to a time, by a velocity in the needle's frame."""
        ahead = now - self._until
        if self._extrapolated is None or ahead <= 0.0:
            return
        self._until = now
        if velocity != ZERO_VELOCITY:
            along, across, drift = velocity
            pose = self._extrapolated
            self._extrapolated = Pose(*self._needle.moved(pose.tail, pose.heading, along, across, ahead, drift))
