"""Geometry of the needle: a circular arc in the plane, and its heading as the unit quaternion of messages."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.settings.errors import InvalidInputError

MAX_NORM_ERROR = 0.01  # of unit vectors and quaternions: two decimals of each entry, as a person or a text gives them


def needle_axis(
    tail: Points, heading: float, length: float, curvature: float, at: NDArray[np.float64]
) -> tuple[Points, Points]:
    """Return points and unit tangents of a needle's axis, a circular arc.

        x(s) = x_tail + s sinc(c s / 2) [cos, sin](heading + c s / 2),    0 <= s <= length

    Args:
        tail: shape (2,) [m].
        heading: angle of the tangent at the tail against the x axis [rad].
        length: of the arc [m].
        curvature: c, positive to the left [1/m].
        at: where along the arc, 0 at the tail and 1 at the tip, shape (m,); beyond, the arc goes on.

    Returns:
        Points, shape (m, 2) [m], and tangents, shape (m, 2).
    """
    s = np.asarray(at, dtype=float) * length
    half = 0.5 * curvature * s
    chord = s * np.sinc(half / np.pi)  # sin(half) / half without a division by zero
    points = tail + chord[:, None] * np.column_stack([np.cos(heading + half), np.sin(heading + half)])
    turned = heading + curvature * s
    return points, np.column_stack([np.cos(turned), np.sin(turned)])


def needle_chord(length: float, curvature: float) -> tuple[float, NDArray[np.float64]]:
    """Return a needle's chord from tail to tip, and the rotation from its heading at the tail to it.

        l = length sinc(c length / 2),    by the angle c length / 2

    Args:
        length: of the arc [m].
        curvature: c, positive to the left [1/m].

    Returns:
        The chord's length [m], and a rotation matrix, shape (2, 2).
    """
    half = 0.5 * curvature * length
    c, s = np.cos(half), np.sin(half)
    return length * float(np.sinc(half / np.pi)), np.array([[c, -s], [s, c]])


def needle_points(length: float, curvature: float, spacing: float) -> tuple[Points, Points]:
    """Return points along a needle, an odd number, and how they move as it turns, in the frame of its tail.

    Driven along its chord and turned about the chord's middle, the needle moves a point by

        v_p = (v . e) e + (v . n) turning_p,    turning_p = perp(p - middle) / (chord / 2)

    with the tip's velocity v, the unit vector e along the chord, and n to its left. Its middle is among the points.

    Args:
        length: of the arc [m].
        curvature: positive to the left [1/m].
        spacing: of the points at the most [m].

    Returns:
        p, shape (m, 2) [m], with the heading at the tail along x; and turning, shape (m, 2).
    """
    pieces = 2 * math.ceil(0.5 * length / spacing - 1e-9)
    points, _ = needle_axis(np.zeros(2), 0.0, length, curvature, np.linspace(0.0, 1.0, pieces + 1))
    chord, turned = needle_chord(length, curvature)
    apart = (points - 0.5 * chord * turned[:, 0]) / (0.5 * chord)
    return points, np.column_stack([-apart[:, 1], apart[:, 0]])


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
    """Return the unit vector, shape (2,), along the x axis that a unit quaternion turns; `field` is its name.

        [w^2 + x^2 - y^2 - z^2, 2 (x y + w z)],    of length one

    Raises:
        InvalidInputError: its norm is not one to `MAX_NORM_ERROR`, or it turns the x axis out of the dish plane.
    """
    # Not by squares: Python raises an error for those of what a hostile message may hold.
    size = math.hypot(x, y, z, w)
    if not abs(size - 1.0) <= MAX_NORM_ERROR:
        raise InvalidInputError(field, f"norm {size:g}", f"a unit quaternion, to {MAX_NORM_ERROR:g}")
    along = np.array([w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z)])
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
