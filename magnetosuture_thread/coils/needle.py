"""Where the needle is now: the last measured pose, carried forward by what the coils have asked of it since."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import NeedleMechanics
from magnetosuture_thread.coils.sources import SourceWatch
from magnetosuture_thread.coils.stamps import check_stamp
from magnetosuture_thread.errors import InvalidInputError

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """Tail, shape (2,) [m], and unit heading at the tail, shape (2,)."""

    tail: Vector
    heading: Vector


class NeedleWatch:
    """Keeps the needle's last measured pose for as long as it is good.

    A camera's pose is some hundredths of a second old, in which the needle turns by some degrees and comes
    closer to the wall; the field must be laid along the needle as it lies now. So the pose is carried
    forward by the tip velocities that the coils have been given since its stamp: along the chord they move
    the needle, across it they turn it about its middle.

    Args:
        needle: its mechanics.
        timeout: a pose is good for this long after its arrival [s].
        reach: both ends must be nearer to the dish's centre than this; the coils are beyond it [m].
    """

    def __init__(self, needle: NeedleMechanics, timeout: float, reach: float) -> None:
        self._needle = needle
        self._timeout = timeout
        self._reach = reach
        self._sources = SourceWatch()
        self._stamp = -math.inf
        self._arrival = -math.inf
        self._carried: Pose | None = None
        self._until = -math.inf  # the time to which it has been carried
        self._velocity = np.zeros(2)
        self._past: deque[tuple[float, Vector]] = deque()  # velocities, and since when

    def see(self, tail: Vector, heading: Vector, stamp: float, number: int, now: float, arrival: float) -> None:
        """Take a measured pose.

        Args:
            tail: shape (2,) [m].
            heading: unit vector, shape (2,).
            stamp: when it was measured [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].

        Raises:
            InvalidInputError: it is not finite, not among the coils, too old, from the future, older than
                the last one, or somebody else says where the needle is too.
        """
        speaking = self._sources.hear(number, arrival)
        if not (np.all(np.isfinite(tail)) and np.all(np.isfinite(heading))):
            raise InvalidInputError("needle/measured_cp.pose", [*tail.tolist(), *heading.tolist()], "finite numbers")
        tip = tail + self._needle.chord * self._needle.chord_direction(heading)
        if max(math.hypot(*tail), math.hypot(*tip)) > self._reach:
            ends = f"{tail.tolist()} to {tip.tolist()}"
            raise InvalidInputError("needle/measured_cp.pose", ends, f"within {self._reach:g} m of the dish's centre")
        check_stamp("needle/measured_cp", stamp, now, self._stamp, self._timeout)
        if speaking > 1:
            raise InvalidInputError("needle/measured_cp", f"{speaking} publishers at once", "one")
        self._stamp, self._arrival = stamp, arrival
        self._carried, self._until = Pose(tail, heading), stamp
        times = [since for since, _ in self._past][1:]
        for (_, velocity), end in zip(self._past, times, strict=False):
            self._carry(velocity, end)

    def lost(self, now: float, arrival: float) -> str:
        """Say why the pose is not to be used at a time of the stamps' clock and a monotonic time [s]; empty if it is.

        It ends by its stamp as by its arrival, whichever comes first.
        """
        if self._sources.count(arrival) > 1:
            return "several publishers of needle/measured_cp at once"
        if self._carried is None:
            return "no needle pose yet"
        good = max(arrival - self._arrival, now - self._stamp) <= self._timeout
        return "" if good else f"no needle pose for {self._timeout:g} s"

    def move(self, velocity: Vector, now: float) -> None:
        """Say which tip velocity the coils give from a time on.

        Args:
            velocity: shape (2,) [m/s].
            now: time of the stamps' clock [s].
        """
        if self._past and now < self._past[-1][0]:
            self._past.clear()  # time was set back
        self._carry(self._velocity, now)
        self._velocity = velocity
        self._past.append((now, velocity))
        while len(self._past) > 1 and self._past[1][0] < now - self._timeout:
            self._past.popleft()

    def pose(self, now: float, arrival: float) -> Pose | None:
        """Return the pose as it is at a time of the stamps' clock and a monotonic time [s]; None if too old."""
        if self._carried is None or self.lost(now, arrival):
            return None
        self._carry(self._velocity, now)
        return self._carried

    def _carry(self, velocity: Vector, now: float) -> None:
        """Carry the pose on to a time, by a tip velocity of shape (2,) [m/s]."""
        ahead = now - self._until
        if self._carried is None or ahead <= 0.0:
            return
        self._until = now
        if not velocity.any():
            return
        tail, heading = self._carried.tail, self._carried.heading
        e = self._needle.chord_direction(heading)
        n = np.array([-e[1], e[0]])
        lever = 0.5 * self._needle.chord
        angle = float(velocity @ n) / lever * ahead
        c, s = math.cos(angle), math.sin(angle)
        turned = np.array([[c, -s], [s, c]])
        middle = tail + lever * e + float(velocity @ e) * ahead * e
        self._carried = Pose(middle - turned @ (lever * e), turned @ heading)
