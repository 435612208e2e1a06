"""The barriers that a user adds to the needle's safety filter: their rows, and the checks over a hold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import Barrier, check_barriers
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.safety.barriers import AddedRows
from magnetosuture_thread.safety.certificate import FilterData, PosedNeedle
from magnetosuture_thread.safety.kinematics import NeedleKinematics

Vector = NDArray[np.float64]

CHECKS = 8  # instants of a hold at which an added barrier is checked
BISECTIONS = 10  # of the share that an added barrier leaves of a velocity
ROUNDING = 1e-12  # by which an added barrier may decrease


class AddedNeedleBarriers:
    """The barriers that a user adds to a safety filter, see there.

    Args:
        barriers: in their order.
        kinematics: of the needle.
        data: of the filter.
        first: index of the first barrier among the names of constraints.

    Attributes:
        barriers: in their order.
        time: now, by the clock of the poses' stamps; None before it is known [s].
        first_time: of the needle's first pose by that clock [s].
    """

    def __init__(self, barriers: Sequence[Barrier], kinematics: NeedleKinematics, data: FilterData, first: int) -> None:
        self.barriers = tuple(barriers)
        check_barriers(self.barriers)
        self.time: float | None = 0.0
        self.first_time = 0.0
        self._kinematics, self._data, self._first = kinematics, data, first

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self.barriers)

    def rows(self, needle: PosedNeedle) -> AddedRows:
        """Return the rows of the added barriers on the tip's velocity, each over the size of its gradient."""
        along = np.array([needle.chord_x, needle.chord_y])
        left = np.array([-along[1], along[0]])
        found: list[AddedRows] = []
        ahead = self._data.hold / CHECKS
        for index, barrier in enumerate(self.barriers, start=self._first):
            self.set_time(ahead)
            later = np.asarray(barrier.value(needle.points), np.float64)
            self.set_time()
            rows = barrier.rows(needle.points)
            # What appears meanwhile is left to the checks.
            drift = (later - rows.value) / ahead if later.shape == rows.value.shape else np.zeros(len(rows.value))
            slope = np.sqrt(np.einsum("rkd,rkd->r", rows.gradient, rows.gradient))
            size = np.where(slope > 0.0, slope, 1.0)
            gradient = rows.gradient / size[:, None, None]
            drive = np.einsum("rkd,d->r", gradient, along)
            turn = np.einsum("rkd,rkd->r", gradient, needle.turning[rows.nodes])
            rate, which = np.full(len(size), min(barrier.gain, self._data.rate)), np.full(len(size), index, np.int64)
            on_tip = drive[:, None] * along + turn[:, None] * left
            found.append(AddedRows(on_tip, rows.value / size, rate, drift / size, which))
        return AddedRows(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def checked_share(self, velocity: Vector, tail: Vector, heading: Vector, drift: float = 0.0) -> tuple[float, str]:
        """Return the share of a velocity with which every added barrier holds at every check, and what it is for."""
        broken = self._broken(velocity, tail, heading, drift)
        if not broken:
            return 1.0, ""
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            is_broken = bool(self._broken(middle * velocity, tail, heading, middle * drift))
            low, high = (low, middle) if is_broken else (middle, high)
        return low, broken

    def _broken(self, velocity: Vector, tail: Vector, heading: Vector, drift: float) -> str:
        """Return the first added barrier that gets below 0, and lower than for a needle at rest; empty for none."""
        heading = np.asarray(heading) / math.hypot(float(heading[0]), float(heading[1]))
        along, across = self._kinematics.body_velocity(heading, velocity)
        begin = self.points_at(np.asarray(tail), heading)
        times = [check / CHECKS * self._data.hold for check in range(1, CHECKS + 1)]
        points = [self.points_at(*self._kinematics.moved(tail, heading, along, across, time, drift)) for time in times]
        for time, where in zip(times, points, strict=True):
            self.set_time(time)
            for barrier in self.barriers:
                least, value = np.minimum(barrier.value(begin), 0.0) - ROUNDING, barrier.value(where)
                # Where the number of rows changes with the place, every one of them has to be safe.
                if not (value >= (least if value.shape == least.shape else -ROUNDING)).all():
                    return barrier.name
        return ""

    def set_time(self, ahead: float = 0.0) -> None:
        """Set the time of the barriers' next evaluation, ahead of now [s]."""
        for barrier in self.barriers:
            if self.time is not None:
                barrier.move_to(self.time + ahead, self.first_time)
            elif barrier.moves:
                raise InvalidInputError("time", None, f"the time now [s], as the barrier {barrier.name} moves")

    def points_at(self, tail: Vector, heading: Vector) -> Vector:
        """Return the points that stand for the needle, from tail to tip, shape (m, 2) [m]."""
        c, s = float(heading[0]), float(heading[1])
        return np.asarray(self._data.body.points @ np.array([[c, s], [-s, c]]) + tail)
