"""Circular arcs in the plane: what a needle, straight or curved, lies along."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.polyline import Points

MOST_TURN = 1.02 * np.pi  # of a needle, tail to tip [rad]; a little more than what suture needles have


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


def require_needle(group: str, length: float, curvature: float) -> None:
    """Refuse a needle that is bent beyond a half circle: its chord would not be along it any more.

    Args:
        group: section of the settings, for the error.
        length: of the arc [m].
        curvature: [1/m].

    Raises:
        ConfigurationError: the arc turns by more.
    """
    if abs(curvature) * length > MOST_TURN:
        expectation = f"at most {MOST_TURN / length:.0f} 1/m, a half circle for a needle of {length:g} m"
        raise ConfigurationError(f"{group}.needle_curvature", curvature, expectation)
