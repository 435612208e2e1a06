"""The thread's pull on the needle, fed forward to the coils."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import NeedleMechanics
from magnetosuture_thread.errors import InvalidInputError

Vector = NDArray[np.float64]

TOPIC = "thread/predicted.needle_force"
MAX_FORCE = 1.0  # N; no thread that a coil could move the needle with pulls more
MAX_SHARE = 0.5  # of the commanded speed, that is given to the needle by the thread at most


class ThreadFeedforward:
    """Computes the velocity that the thread's pull gives the needle's tip, for the coils to add the opposite.

    The drag coefficient along the needle holds what a straight thread trailing behind adds. A thread that is held,
    bent around a post or slack pulls otherwise. With the predicted force F upon the needle, the unit vector e from tail
    to tip, n across, and the commanded velocity v, the needle moves, besides by its currents, with

        w . e = (F . e + thread_drag v . e) / drag,    w . n = F . n / drag_across

    Where |w| is more than half of |v| it is reduced to that: the prediction is no measurement. Pure: times come in, in
    seconds. Source: none. Deviation: the torque of the pull about the needle's middle is left out.

    Args:
        needle: its mechanics.
        thread_drag: part of the needle's drag coefficient that the straight thread adds [N s/m].
        timeout: a force is valid for this long after its stamp and its arrival [s].
    """

    def __init__(self, needle: NeedleMechanics, thread_drag: float, timeout: float) -> None:
        self._needle = needle
        self._drag = thread_drag
        self._timeout = timeout
        self._force = np.zeros(2)
        self._stamp = self._arrival = -math.inf

    def update(self, force: Vector, stamp: float, arrival: float) -> None:
        """Register the predicted force upon the needle.

        Args:
            force: shape (2,) [N]; NaN where none is known, which ends the validity of the last.
            stamp: of the prediction [s].
            arrival: a monotonic clock now [s].

        Raises:
            InvalidInputError: the force is infinite or more than 1 N, or the stamp no time; the last one stays.
        """
        if not math.isfinite(stamp):
            raise InvalidInputError("thread/predicted.header.stamp", stamp, "a time [s]")
        if np.isnan(force).any():
            self._arrival = -math.inf
            return
        if not math.hypot(*force) <= MAX_FORCE:
            raise InvalidInputError(TOPIC, force.tolist(), f"at most {MAX_FORCE:g} N")
        self._force, self._stamp, self._arrival = np.array(force, dtype=np.float64), stamp, arrival

    def velocity(self, commanded: Vector, heading: Vector, now: float, arrival: float) -> Vector:
        """Return w, zero without a valid force, shape (2,) [m/s].

        Args:
            commanded: velocity v of the tip, shape (2,) [m/s].
            heading: unit vector along the needle at its tail, shape (2,).
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        if max(arrival - self._arrival, now - self._stamp) > self._timeout:
            return np.zeros(2)
        e = self._needle.chord_direction(heading)
        n = np.array([-e[1], e[0]])
        along = (float(self._force @ e) + self._drag * float(commanded @ e)) / self._needle.drag
        across = float(self._force @ n) / self._needle.drag_across
        speed, limit = math.hypot(along, across), MAX_SHARE * math.hypot(*commanded)
        share = min(1.0, limit / speed) if speed > 0.0 else 0.0
        return np.asarray(share * (along * e + across * n))
