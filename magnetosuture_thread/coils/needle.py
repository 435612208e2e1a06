"""Where the needle is now: the last believed pose, carried forward by what the coils have asked of it since."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.sources import SourceWatch
from magnetosuture_thread.coils.stamps import check_stamp
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.safety import NeedleKinematics

Vector = NDArray[np.float64]
Motion = tuple[float, float]
"""Velocity of the tip along the chord and across it [m/s]."""

REST: Motion = (0.0, 0.0)
TOPIC = "needle/measured_cp"
CONSISTENT = 5  # poses in a row that agree with each other, until poses are believed again
SIGMAS = 3.0
MAX_SPREAD = 2e-3  # m; more uncertainty than this, of a tracker's own covariance, excuses nothing


@dataclass(frozen=True)
class Pose:
    """Tail, shape (2,) [m], and unit heading at the tail, shape (2,)."""

    tail: Vector
    heading: Vector


@dataclass(frozen=True)
class _Measured:
    """Where the ends were measured [m], when by the stamp [s], and how uncertain that is [m]."""

    tail: Vector
    tip: Vector
    stamp: float
    spread: float


class NeedleWatch:
    """Keeps the needle's last measured pose for as long as it is good and believed.

    A camera's pose is some hundredths of a second old, in which the needle turns by some degrees and comes
    closer to the wall; the field must be laid along the needle as it lies now. So the pose is carried
    forward by the tip velocities that the coils have been given since its stamp, see `NeedleKinematics`.

    When nobody gave the coils anything for longer than they certainly hold their currents, nobody knows when exactly
    they stopped: poses from before the time at which they have stopped for certain are not used any more.

    A pose with an end outside of the dish, or one that is farther from the last than the needle can go, is not
    believed, and from then on none is until `CONSISTENT` poses in a row are in the dish and agree with each other.

    Args:
        needle: how it moves.
        timeout: a pose is good for this long after its arrival [s].
        reach: both ends must be nearer to the dish's centre than this; the coils are beyond it [m].
        max_speed: of both ends [m/s].
        uncertainty: by how much measured ends may be off, besides what a pose's own covariance says [m].
        holds: the coils certainly hold what they are given for this long [s].
        stops: and certainly have stopped after this long [s].

    Attributes:
        radius: of the dish; infinite where none is known [m].
    """

    def __init__(
        self,
        needle: NeedleKinematics,
        timeout: float,
        reach: float,
        *,
        max_speed: float = math.inf,
        uncertainty: float = 0.0,
        holds: float = math.inf,
        stops: float = math.inf,
    ) -> None:
        self.radius = math.inf
        self._needle, self._timeout, self._reach = needle, timeout, reach
        self._max_speed, self._uncertainty = max_speed, uncertainty
        self._holds, self._stops = holds, stops
        self._sources = SourceWatch()
        self._newest = -math.inf  # stamp of the last pose, believed or not
        self._arrival = -math.inf  # of the last believed one
        self._believed: _Measured | None = None
        self._doubt = ""
        self._candidate: _Measured | None = None
        self._agree = 0  # poses in a row that agree with each other
        self._unknown = -math.inf  # poses stamped before this time are of no use
        self._carried: Pose | None = None
        self._until = -math.inf  # the time to which it has been carried
        self._motion = REST
        self._given = -math.inf  # monotonic time at which it was given to the coils
        self._past: deque[tuple[float, Motion]] = deque()  # motions, and since when

    def see(
        self,
        tail: Vector,
        heading: Vector,
        stamp: float,
        number: int,
        now: float,
        arrival: float,
        covariance: Vector | None = None,
    ) -> None:
        """Take a measured pose.

        Args:
            tail: shape (2,) [m].
            heading: unit vector, shape (2,).
            stamp: when it was measured [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].
            covariance: of x, y and the heading's angle, shape (3, 3) [m, m, rad]; None where it is not known.

        Raises:
            InvalidInputError: it is not finite, too old, from the future, older than the last one, somebody else
                says where the needle is too, or it is not believed.
        """
        speaking = self._sources.hear(number, arrival)
        if not (np.all(np.isfinite(tail)) and np.all(np.isfinite(heading))):
            raise InvalidInputError(f"{TOPIC}.pose", [*tail.tolist(), *heading.tolist()], "finite numbers")
        check_stamp(TOPIC, stamp, now, self._newest, self._timeout)
        if speaking > 1:
            raise InvalidInputError(TOPIC, f"{speaking} publishers at once", "one")
        if stamp < self._newest:  # time was set back
            self._believed = self._candidate = None
            self._unknown = -math.inf
        self._newest = stamp
        measured = _Measured(tail, self._needle.tip(tail, heading), stamp, self._spread(covariance))
        self._judge(measured)
        self._note_gap(arrival)
        if stamp < self._unknown:
            raise InvalidInputError(TOPIC, "a pose from a stall of the loop", "one after the coils have stopped")
        self._believed, self._arrival = measured, arrival
        # From the future, as clocks differ by a little, it is one of now.
        self._carried, self._until = Pose(tail, heading), min(stamp, now)
        if self._past:  # before the first that is remembered the needle was at rest
            self._until = max(self._until, min(self._past[0][0], now))
        times = [since for since, _ in self._past][1:]
        for (_, motion), end in zip(self._past, times, strict=False):
            self._carry(motion, end)

    def lost(self, now: float, arrival: float) -> str:
        """Say why the pose is not to be used at a time of the stamps' clock and a monotonic time [s]; empty if it is.

        It ends by its stamp as by its arrival, whichever comes first.
        """
        if self._sources.count(arrival) > 1:
            return f"several publishers of {TOPIC} at once"
        if self._doubt:
            return self._doubt
        if self._believed is None:
            return "no needle pose yet"
        if max(arrival - self._arrival, now - self._believed.stamp) > self._timeout:
            return f"no needle pose for {self._timeout:g} s"
        return "no needle pose since the loop stalled" if self._carried is None else ""

    def move(self, velocity: Vector, now: float, arrival: float) -> None:
        """Say which tip velocity the coils give from a time on, to a needle that is where it is believed to be.

        The needle keeps it as seen from itself until the next is given: what pulls and turns it goes with it.

        Args:
            velocity: shape (2,) [m/s].
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        self._note_gap(arrival)
        if self._past and now < self._past[-1][0]:
            self._past.clear()  # time was set back
        self._carry(self._motion, now)
        self._motion, self._given = REST, arrival
        if velocity.any() and self._carried is not None:
            self._motion = self._needle.body_velocity(self._carried.heading, velocity)
        self._past.append((now, self._motion))
        while len(self._past) > 1 and self._past[1][0] < now - self._timeout:
            self._past.popleft()

    def pose(self, now: float, arrival: float) -> Pose | None:
        """Return the pose as it is at a time of the stamps' clock and a monotonic time [s]; None if there is none."""
        self._note_gap(arrival)
        if self._carried is None or self.lost(now, arrival):
            return None
        self._carry(self._motion, now)
        return self._carried

    def _judge(self, measured: _Measured) -> None:
        """Refuse a pose that is not believed; see the class."""
        problem = self._outside(measured)
        if not self._doubt:
            problem = problem or self._jump(self._believed, measured)
            if not problem:
                return
            self._doubt = f"needle pose not believed: {problem[0]}, {problem[1]}"
            self._candidate, self._agree = None, 0
        if problem and problem[2]:
            self._candidate, self._agree = None, 0
        elif self._candidate is None or self._jump(self._candidate, measured):
            self._candidate, self._agree = measured, 1
        else:
            self._candidate, self._agree = measured, self._agree + 1
        if self._agree >= CONSISTENT:
            self._doubt, self._candidate, self._agree = "", None, 0
            return
        given, expected = (problem[0], problem[1]) if problem else ("a pose after one that was not believed", "")
        expected = expected or f"{CONSISTENT} in a row that agree"
        raise InvalidInputError(f"{TOPIC}.pose", given, expected)

    def _outside(self, measured: _Measured) -> tuple[str, str, bool] | None:
        """Say that an end is outside of the dish or beyond reach, and what was expected."""
        limit = min(self._reach, self.radius + self._uncertainty + measured.spread)
        for name, end in (("tail", measured.tail), ("tip", measured.tip)):
            away = math.hypot(*end)
            if away > limit:
                return f"its {name} is {away:g} m from the dish's centre", f"within {limit:g} m", True
        return None

    def _jump(self, last: _Measured | None, measured: _Measured) -> tuple[str, str, bool] | None:
        """Say that an end is farther from where it was than the needle can go, and what was expected."""
        if last is None:
            return None
        elapsed = measured.stamp - last.stamp
        far = self._max_speed * elapsed + self._uncertainty + measured.spread + last.spread
        for name, end, before in (("tail", measured.tail, last.tail), ("tip", measured.tip, last.tip)):
            way = math.hypot(*(end - before))
            if way > far:
                return f"its {name} jumped by {way:.2g} m in {elapsed:.2g} s", f"at most {far:.2g} m", False
        return None

    def _spread(self, covariance: Vector | None) -> float:
        """Return by how much both ends may be off by a pose's covariance [m]."""
        if covariance is None or not np.isfinite(covariance).all():
            return 0.0
        square = covariance[0, 0] + covariance[1, 1] + self._needle.chord**2 * covariance[2, 2]
        return min(MAX_SPREAD, SIGMAS * math.sqrt(max(0.0, square)))

    def _note_gap(self, arrival: float) -> None:
        """Forget the pose where the coils were given nothing for longer than they certainly hold their currents."""
        if self._motion == REST or arrival - self._given <= self._holds + 1e-6:
            return
        self._unknown = self._past[-1][0] + self._stops if self._past else -math.inf
        self._motion = REST
        self._past.clear()
        if self._believed is not None and self._believed.stamp < self._unknown:
            self._carried = None

    def _carry(self, motion: Motion, now: float) -> None:
        """Carry the pose on to a time, by velocities along the chord and across it [m/s]."""
        ahead = now - self._until
        if self._carried is None or ahead <= 0.0:
            return
        self._until = now
        if motion != REST:
            self._carried = Pose(*self._needle.moved(self._carried.tail, self._carried.heading, *motion, ahead))
