"""Conversion between headings in the dish plane and the unit quaternions of messages."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.settings.errors import InvalidInputError


def yaw_quaternion(angle: float) -> tuple[float, float]:
    """Return z and w of the quaternion that turns about z by an angle [rad]; its x and y are 0.

    >>> yaw_quaternion(0.0)
    (0.0, 1.0)
    """
    return math.sin(0.5 * angle), math.cos(0.5 * angle)


def heading_angle(heading: NDArray[np.float64]) -> float:
    """Return the angle of a direction of shape (2,), from the x axis on [rad]."""
    return math.atan2(heading[1], heading[0])


def heading_from_quaternion(x: float, y: float, z: float, w: float, field: str) -> NDArray[np.float64]:
    """Return the unit vector, shape (2,), along the x axis that a unit quaternion turns.

    Args:
        x: of the quaternion.
        y: of the quaternion.
        z: of the quaternion.
        w: of the quaternion.
        field: what it is, for the error.

    Raises:
        InvalidInputError: it is no unit quaternion, or turns the x axis out of the dish plane.
    """
    # Not by squares: Python raises an error for those of what a hostile message may hold.
    size = math.hypot(x, y, z, w)
    if not abs(size - 1.0) < 1e-3:
        raise InvalidInputError(field, f"norm {size:g}", "a unit quaternion")
    along = np.array([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)])
    length = float(np.linalg.norm(along))
    if length < 1e-3:
        raise InvalidInputError(field, "an upright needle", "an x axis in the dish plane")
    return np.asarray(along / length)


def round_trip_heading(heading: NDArray[np.float64], field: str) -> NDArray[np.float64]:
    """Return a direction of shape (2,) after a round trip through a quaternion, which rounds its last bits.

    Code that passes a heading on without a message applies this, so that results equal those with a message.
    """
    z, w = yaw_quaternion(heading_angle(heading))
    return heading_from_quaternion(0.0, 0.0, z, w, field)
