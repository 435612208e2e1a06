"""Circular arcs in the image: what a needle, straight or curved, lies along.

The tangent of an arc with curvature k, after a length s, is its first direction turned by k s; positive
turns u towards v, clockwise as seen. A straight line is k = 0, without a special case.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.compiled import compiled


@dataclass(frozen=True)
class Arc:
    """A circular arc from a point.

    Attributes:
        start: point of length 0, shape (2,) [px].
        angle: direction there, from u towards v [rad].
        curvature: [1/px]
    """

    start: np.ndarray
    angle: float
    curvature: float

    def at(self, along: np.ndarray | float, aside: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the points at lengths along the arc and distances aside of it, shape (..., 2) [px].

        p = start + s sinc(k s / 2) (cos b, sin b) + d (-sin c, cos c),  b = angle + k s / 2,  c = angle + k s
        """
        s = np.asarray(along, dtype=float)
        result = np.empty((s.size, 2))
        apart = np.full(s.size, aside) if np.ndim(aside) == 0 else np.broadcast_to(aside, s.shape).ravel()
        _points(self.start[0], self.start[1], self.angle, self.curvature, s.ravel(), apart, result)
        return result.reshape(*s.shape, 2)

    def direction(self, along: float = 0.0) -> np.ndarray:
        """Return the unit tangent after a length, shape (2,)."""
        turned = self.angle + self.curvature * along
        return np.array([math.cos(turned), math.sin(turned)])

    def coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return lengths along the arc and distances aside of it of points, the inverse of `at` [px]."""
        along, across = self.direction(), np.array([-math.sin(self.angle), math.cos(self.angle)])
        offset = points - self.start
        forward, side = offset @ along, offset @ across
        if abs(self.curvature) < 1e-6:
            return forward, side
        turned = np.arctan2(self.curvature * forward, 1.0 - self.curvature * side)
        radius = 1.0 / self.curvature
        return turned * radius, radius - math.copysign(1.0, radius) * np.hypot(forward, radius - side)

    def moved(self, along: float, aside: float, slope: float, bend: float) -> Arc:
        """Return the arc that leaves at a length, with an offset, a slope and a second derivative of it."""
        stretch = 1.0 - self.curvature * aside
        angle = self.angle + self.curvature * along + math.atan2(slope, stretch)
        return Arc(self.at(along, aside), angle, self.curvature / stretch + bend)

    def reversed_at(self, along: float) -> Arc:
        """Return the same arc, walked back from a length."""
        return Arc(self.at(along), self.angle + self.curvature * along + math.pi, -self.curvature)


def fit_arc(points: np.ndarray) -> Arc:
    """Fit a circle or a line to points; the arc starts at its point nearest to their mean.

    Minimises sum (A z + B x + C y + D)^2 over sum of its squared gradients, z = x^2 + y^2, by a singular
    value decomposition, in which a line is the case A = 0.

    Args:
        points: shape (m, 2), m >= 3 [px].

    Source: [Taubin1991] G. Taubin, "Estimation of planar curves, surfaces, and nonplanar space curves defined by
    implicit equations", IEEE T-PAMI 13(11). Deviation: none.
    """
    u, v, angle, curvature = _fit_arc(np.ascontiguousarray(points, dtype=float))
    return Arc(np.array([u, v]), angle, curvature)


@compiled
def _fit_arc(points):
    """Return the arc of `fit_arc`: its first point, its direction there and its curvature."""
    count = len(points)
    mean_u, mean_v = points[:, 0].sum() / count, points[:, 1].sum() / count
    x, y = points[:, 0] - mean_u, points[:, 1] - mean_v
    z = x * x + y * y
    spread = max(z.sum() / count, 1e-12)
    scaled = (z - spread) / (2.0 * math.sqrt(spread))
    moments = np.empty((3, 3))
    moments[0, 0], moments[1, 1], moments[2, 2] = (scaled * scaled).sum(), (x * x).sum(), (y * y).sum()
    moments[0, 1] = moments[1, 0] = (scaled * x).sum()
    moments[0, 2] = moments[2, 0] = (scaled * y).sum()
    moments[1, 2] = moments[2, 1] = (x * y).sum()
    _, axes = np.linalg.eigh(moments)
    a, b, c = axes[0, 0] / (2.0 * math.sqrt(spread)), axes[1, 0], axes[2, 0]
    d = -spread * a
    size = math.sqrt(max(b * b + c * c - 4.0 * a * d, 1e-24))
    a, b, c, d = a / size, b / size, c / size, d / size
    gradient = math.hypot(b, c)
    if gradient < 1e-9:  # The mean is the centre: any point is as near as another.
        b, c, gradient = 1.0, 0.0, 1.0
    normal_u, normal_v = b / gradient, c / gradient
    # Along the normal through the mean: a t^2 + gradient t + d = 0, the root of smaller size.
    root = math.sqrt(max(gradient * gradient - 4.0 * a * d, 0.0))
    foot = -2.0 * d / (gradient + root)
    # Across the tangent (n_v, -n_u) lies the normal itself, and the circle's centre lies against it where a > 0.
    return mean_u + foot * normal_u, mean_v + foot * normal_v, math.atan2(-normal_u, normal_v), -2.0 * a


@compiled
def _points(u, v, angle, curvature, along, aside, points):
    """Fill in the points of an arc; see `Arc.at`."""
    for index in range(len(along)):
        half = 0.5 * curvature * along[index]
        chord = along[index] if abs(half) < 1e-9 else along[index] * math.sin(half) / half
        middle, turned = angle + half, angle + 2.0 * half
        points[index, 0] = u + chord * math.cos(middle) - aside[index] * math.sin(turned)
        points[index, 1] = v + chord * math.sin(middle) + aside[index] * math.cos(turned)
