"""The parameters that can be learned on line: how each enters a thread, its bounds, and what is known beforehand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.model.thread import MAX_REST_ANGLE, Thread

NORMAL_95 = 1.959963984540054
# Bounds are those of `calibrate` where it fits the same.
STIFFNESS_RANGE = 1e3  # within this factor of what is set
ANISOTROPY_BOUNDS = (0.05, 1.0)
MAX_FLOW = 0.02  # m/s
# What a set value is worth before anything is measured: 95 % are within a factor, the others have a deviation.
STIFFNESS_KNOWN, ANISOTROPY_KNOWN = 10.0, 3.0
KNOWN_TURN = 2.0  # rad; of the thread at rest, over its length
KNOWN_FLOW = 2e-3  # m/s


@dataclass(frozen=True)
class ParameterKind:
    """How a parameter enters a thread, and what is known of it beforehand.

    Attributes:
        name: of it.
        unit: of its value.
        logarithmic: whether it is positive and estimated as x = ln value, or else as x = value.
        read: its value in a thread.
        write: a thread with another value.
        bounds: of its value.
        deviation: of x, before anything is measured.
    """

    name: str
    unit: str
    logarithmic: bool
    read: Callable[[Thread], float]
    write: Callable[[Thread, float], Thread]
    bounds: Callable[[Thread], tuple[float, float]]
    deviation: Callable[[Thread], float]

    def to_x(self, value: float) -> float:
        """Return x of a value."""
        return math.log(value) if self.logarithmic else value

    def from_x(self, x: float) -> float:
        """Return the value of x."""
        return math.exp(x) if self.logarithmic else x


def _stiffness(thread: Thread) -> float:
    return thread.bending_stiffness / thread.medium.drag_across


def _with_stiffness(thread: Thread, value: float) -> Thread:
    return replace(thread, bending_stiffness=value * thread.medium.drag_across)


def _anisotropy(thread: Thread) -> float:
    return thread.medium.drag_along / thread.medium.drag_across


def _with_anisotropy(thread: Thread, value: float) -> Thread:
    return replace(thread, medium=replace(thread.medium, drag_along=value * thread.medium.drag_across))


def _curvature(thread: Thread) -> float:
    return float(np.mean(thread.rest_curvature))


def _with_curvature(thread: Thread, value: float) -> Thread:
    """Return a thread whose curvature at rest is that on the average, and differs along it as before."""
    if isinstance(thread.rest_curvature, tuple):
        more = value - _curvature(thread)
        return replace(thread, rest_curvature=tuple(each + more for each in thread.rest_curvature))
    return replace(thread, rest_curvature=value)


def _max_curvature(thread: Thread) -> tuple[float, float]:
    most = min(2000.0, 0.99 * MAX_REST_ANGLE / thread.segment_length)
    return -most, most


def _flow(axis: int) -> ParameterKind:
    def read(thread: Thread) -> float:
        return (thread.medium.flow or (0.0, 0.0))[axis]

    def write(thread: Thread, value: float) -> Thread:
        both = list(thread.medium.flow or (0.0, 0.0))
        both[axis] = value
        return replace(thread, medium=replace(thread.medium, flow=tuple(both)))

    return ParameterKind(
        f"flow_{'xy'[axis]}", "m/s", False, read, write, lambda thread: (-MAX_FLOW, MAX_FLOW), lambda thread: KNOWN_FLOW
    )


KINDS = {
    "stiffness_over_drag": (
        ParameterKind(
            "stiffness_over_drag",
            "m^4/s",
            True,
            _stiffness,
            _with_stiffness,
            lambda thread: (_stiffness(thread) / STIFFNESS_RANGE, _stiffness(thread) * STIFFNESS_RANGE),
            lambda thread: math.log(STIFFNESS_KNOWN) / NORMAL_95,
        ),
    ),
    "drag_anisotropy": (
        ParameterKind(
            "drag_anisotropy",
            "",
            True,
            _anisotropy,
            _with_anisotropy,
            lambda thread: ANISOTROPY_BOUNDS,
            lambda thread: math.log(ANISOTROPY_KNOWN) / NORMAL_95,
        ),
    ),
    "rest_curvature": (
        ParameterKind(
            "rest_curvature",
            "1/m",
            False,
            _curvature,
            _with_curvature,
            _max_curvature,
            lambda thread: KNOWN_TURN / thread.length,
        ),
    ),
    "flow": (_flow(0), _flow(1)),
}
