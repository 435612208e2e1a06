"""Steering by hand: the velocity that is asked of the needle, slowed by friction and kept off the obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.friction import Friction
from magnetosuture_thread.model.needle import NeedleFilter

FASTEST = 1.0  # m/s; what asks for more was meant in another unit
BENT = 1e-6  # m/s; less than that is rounding


@dataclass(frozen=True)
class Steered:
    """What comes of one velocity that was asked for.

    Attributes:
        asked: shape (2,) [m/s].
        passed: what the needle is told, shape (2,) [m/s].
        slowdown: by friction.
        held_off: whether an obstacle's barrier changed it.
        reason: why the needle is told to rest; empty while it is not.
    """

    asked: NDArray[np.float64]
    passed: NDArray[np.float64]
    slowdown: float
    held_off: bool
    reason: str


def steered(
    needle: NeedleFilter, friction: Friction, tail: Points, heading: Points, asked: NDArray[np.float64]
) -> Steered:
    """Return what the needle is told, of a thread that is known.

        u = filter(slowdown v)

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback": v_0 <- v_0 beta^length(index),
    then the controller. Deviation: none.

    Args:
        needle: its barriers.
        friction: of the thread.
        tail: of the needle, shape (2,) [m].
        heading: unit vector along it, shape (2,).
        asked: v, shape (2,) [m/s].

    Raises:
        InvalidInputError: what was asked for is not finite, or beyond 1 m/s.
        SolverError: the filter's program has no solution.
    """
    check_asked(asked)
    slowed = friction.slowdown * asked
    passed = needle.safe_velocity(tail, heading, slowed) if asked.any() else slowed
    held_off = float(np.abs(passed - slowed).max()) > BENT
    return Steered(asked, passed, friction.slowdown, held_off, "")


def at_rest(asked: NDArray[np.float64], reason: str) -> Steered:
    """Return that the needle is told to rest, and why."""
    check_asked(asked)
    return Steered(asked, np.zeros(2), 1.0, False, reason)


def check_asked(asked: NDArray[np.float64]) -> None:
    """Refuse a velocity that is not finite, or beyond 1 m/s."""
    if not (np.isfinite(asked).all() and math.hypot(*asked.tolist()) <= FASTEST):
        raise InvalidInputError("needle velocity", asked.tolist(), f"finite numbers, at most {FASTEST:g} m/s")
