"""What stands before the simulated camera, and the light on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.obstacles import Obstacle
from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class Scene:
    """The things before the camera, all in the dish frame [m].

    Attributes:
        dish_diameter: inner diameter of the dish.
        needle_length: length of the needle along its body.
        needle_width: width of its body.
        needle_curvature: of its arc, positive to the left of the heading [1/m].
        thread_diameter: diameter of the thread.
        thread_bgr: the thread's colour, blue, green, red from 0 to 255.
        obstacles: seen from above, of pale silicone.
    """

    dish_diameter: float = 0.035
    needle_length: float = 0.007
    needle_width: float = 0.0004
    needle_curvature: float = 0.0
    thread_diameter: float = 60e-6
    thread_bgr: tuple[float, float, float] = (132.0, 78.0, 100.0)
    obstacles: Sequence[Obstacle] = ()


@dataclass(frozen=True)
class Lighting:
    """The light, the lens and the sensor.

    Attributes:
        gain: of the exposure; 1 is well exposed.
        slope: how much darker one corner is than the opposite one, in units of the usual.
        tint_bgr: colour of the light.
        glare: strength of the lamp's reflections in the liquid, 0 for none.
        noise: standard deviation of the sensor's noise, in units of the usual.
        blur_px: the lens's, as the standard deviation of a Gaussian.
    """

    gain: float = 1.0
    slope: float = 1.0
    tint_bgr: tuple[float, float, float] = (0.955, 0.985, 1.0)
    glare: float = 1.0
    noise: float = 1.0
    blur_px: float = 0.75


def needle_axis(tail: Points, heading: float, length: float, curvature: float, at: Points) -> tuple[Points, Points]:
    """Return points and unit tangents of a needle's axis, a circular arc.

        x(s) = x_tail + R(heading) [sin(c s) / c, (1 - cos(c s)) / c],    0 <= s <= length

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
