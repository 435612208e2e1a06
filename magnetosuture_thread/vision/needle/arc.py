"""The needle in the image: the circular arc that it lies along, straight or curved, and what is measured of it.

The tangent of an arc with curvature k, after a length s, is its first direction turned by k s; positive
turns u towards v, clockwise as seen. A straight line is k = 0, without a special case.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.compiled import compiled

SET_TOLERANCE = 0.1  # of the length as it is set
MEASURED_TOLERANCE = 0.02  # of the length once it is measured
FRAMES = 8  # that must agree
AGREEMENT = 0.02  # share of the length within which they agree
CONFIDENT = 0.3  # confidence of a pose that counts
REVERSED_PX = 3.0  # px; standard deviation, along the axis, of a tail placed where a tip was fitted


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


@dataclass(frozen=True)
class MeasuredNeedle:
    """The needle in the image.

    Attributes:
        arc: axis of the drawn needle that fits, from its tail on; the thread is looked for by it.
        length_px: of the drawn needle, from tail to tip [px].
        width_px: mean width of the body [px].
        contrast: darkness of the body as a share of the floor's brightness, 0 to 1.
        confidence: how well all fits, 0 to 1.
        covariance: of the tail along and aside of the axis and of its angle [px, px, rad], shape (3, 3).
        heading_known: whether it is told which end is the tail.
        size_measured: whether the length was measured, and not only known before.
        tail_shift_px: how far along the axis the tail's edge lies from where the tail is drawn [px]; see `tail_shift`.
        direction_is_clear: whether the needle fits much worse the other way round.
    """

    arc: Arc
    length_px: float
    width_px: float
    contrast: float = 1.0
    confidence: float = 1.0
    covariance: np.ndarray | None = None
    heading_known: bool = True
    size_measured: bool = False
    tail_shift_px: float = 0.0
    direction_is_clear: bool = True

    def shifted(self, offset: tuple[float, float]) -> MeasuredNeedle:
        """Return the needle in pixels that begin elsewhere."""
        return replace(self, arc=replace(self.arc, start=self.arc.start + offset))

    def reversed(self) -> MeasuredNeedle:
        """Return the needle the other way round: its tip is where its tail was.

        What the tail's covariance becomes there, with the length l, in the reversed directions along and aside:

            T C T',    T = [[-1, 0, 0], [0, -1, -l], [0, 0, 1]]

        and `REVERSED_PX` along: what made an end look like the other one has drawn the fit along the axis, too.
        """
        turn = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, -self.length_px], [0.0, 0.0, 1.0]])
        covariance = self.covariance
        if covariance is not None:
            covariance = turn @ covariance @ turn.T + np.diag([REVERSED_PX**2, 0.0, 0.0])
        arc = self.arc.reversed_at(self.length_px)
        return replace(self, arc=arc, covariance=covariance, size_measured=False, tail_shift_px=0.0)

    @property
    def tail_px(self) -> np.ndarray:
        """The blunt end as it is drawn, shape (2,) [px]."""
        return self.arc.start

    @property
    def tail_edge_px(self) -> np.ndarray:
        """The blunt end as it is measured by its edge, shape (2,) [px]."""
        return self.arc.at(self.tail_shift_px)

    @property
    def tip_px(self) -> np.ndarray:
        """The pointed end, shape (2,) [px]."""
        return self.arc.at(self.length_px)

    @property
    def direction_px(self) -> np.ndarray:
        """Unit tangent at the tail, u right and v down, shape (2,)."""
        return self.arc.direction(self.tail_shift_px)

    @property
    def curvature_px(self) -> float:
        """Of the axis [1/px]; positive turns from u towards v, clockwise as seen."""
        return self.arc.curvature


@dataclass(frozen=True)
class NeedleSize:
    """The needle's size in an image.

    Attributes:
        length_px: along its axis [px].
        width_px: of its body [px].
        tolerance: share of the length by which it may be off, two standard deviations; 0: it is known.
    """

    length_px: float
    width_px: float
    tolerance: float = 0.0


class LengthEstimator:
    """Measures the needle's length over the first frames, and keeps it from then on.

    It is the median of the last `FRAMES` lengths of confident poses that show both ends, once all of them lie within
    `AGREEMENT` of each other.

    Attributes:
        length: measured [m]; None until then.
    """

    def __init__(self) -> None:
        self.length: float | None = None
        self._lengths: list[float] = []

    def add(self, length: float, confidence: float) -> None:
        """Take the length of a needle whose ends a frame shows [m], and the confidence of its pose."""
        if self.length is not None or confidence < CONFIDENT:
            return
        self._lengths = [*self._lengths[1 - FRAMES :], length]
        middle = float(np.median(self._lengths))
        if len(self._lengths) == FRAMES and np.ptp(self._lengths) < AGREEMENT * middle:
            self.length = middle

    def size(self, length: float, width: float, metres_per_pixel: float) -> NeedleSize:
        """Return the size in an image of a needle whose length and width are set [m], by the image's scale [m]."""
        known, tolerance = (length, SET_TOLERANCE) if self.length is None else (self.length, MEASURED_TOLERANCE)
        return NeedleSize(known / metres_per_pixel, width / metres_per_pixel, tolerance)


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
