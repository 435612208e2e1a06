"""The needle in the image: the circular arc that it lies along, straight or curved, and what is measured of it.

The tangent of an arc with curvature k, after a length s, is its first direction turned by k s; positive
turns u towards v, clockwise as seen. A straight line is k = 0, without a special case.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.vision.images import straighten

SET_TOLERANCE = 0.1  # of the length as it is set
FRAMES = 8  # that must agree
AGREEMENT = 0.02  # share of the length within which they agree


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

    def at(self, along: np.ndarray, aside: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the points at lengths along the arc and distances aside of it, shape (..., 2) [px].

        p = start + s sinc(k s / 2) (cos b, sin b) + d (-sin c, cos c),  b = angle + k s / 2,  c = angle + k s
        """
        half = 0.5 * self.curvature * along
        middle, turned = self.angle + half, self.angle + 2.0 * half
        chord = 2.0 / self.curvature * np.sin(half) if abs(self.curvature) > 1e-12 else along
        points = np.empty((*along.shape, 2))
        points[..., 0] = self.start[0] + chord * np.cos(middle) - aside * np.sin(turned)
        points[..., 1] = self.start[1] + chord * np.sin(middle) + aside * np.cos(turned)
        return points

    def point(self, along: float, aside: float = 0.0) -> np.ndarray:
        """Return one point, shape (2,) [px]; see `at`, which takes ten times as long for it."""
        half = 0.5 * self.curvature * along
        chord = 2.0 / self.curvature * math.sin(half) if abs(self.curvature) > 1e-12 else along
        middle, turned = self.angle + half, self.angle + 2.0 * half
        u, v = chord * math.cos(middle) - aside * math.sin(turned), chord * math.sin(middle) + aside * math.cos(turned)
        return np.array([self.start[0] + u, self.start[1] + v])

    def strip(self, image: np.ndarray, along: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """Return an image at n lengths along the arc and m distances aside of it, shape (n, m)."""
        start = float(self.start[0]), float(self.start[1]), float(self.angle), float(self.curvature)
        strip = np.empty((len(along), len(aside)))
        straighten(image, start, along, aside, strip)
        return strip

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
        return Arc(self.point(along, aside), angle, self.curvature / stretch + bend)

    def shifted(self, offset: np.ndarray | tuple[float, float]) -> Arc:
        """Return the same arc in pixels that begin elsewhere."""
        return replace(self, start=self.start + offset)

    def reversed_at(self, along: float) -> Arc:
        """Return the same arc, walked back from a length."""
        return Arc(self.point(along), self.angle + self.curvature * along + math.pi, -self.curvature)


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
        told_by_line: whether nothing but a line that leaves one end tells which is the tail: a thread, or a mark on
            the floor.
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
    told_by_line: bool = False

    def shifted(self, offset: np.ndarray | tuple[float, float]) -> MeasuredNeedle:
        """Return the needle in pixels that begin elsewhere."""
        return replace(self, arc=self.arc.shifted(offset))

    def reversed(self) -> MeasuredNeedle:
        """Return the needle the other way round: its tip is where its tail was.

        What the tail's covariance becomes there, with the length l, in the reversed directions along and aside:

            T C T',    T = [[-1, 0, 0], [0, -1, -l], [0, 0, 1]]

        and 3 px along, one deviation: what made an end look like the other one has drawn the fit along the axis, too.
        """
        turn = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, -self.length_px], [0.0, 0.0, 1.0]])
        covariance = self.covariance
        if covariance is not None:
            covariance = turn @ covariance @ turn.T + np.diag([3.0**2, 0.0, 0.0])
        arc = self.arc.reversed_at(self.length_px)
        return replace(self, arc=arc, covariance=covariance, size_measured=False, tail_shift_px=0.0)

    def area(
        self, shape: tuple[int, ...], first: float, last: float, width: float
    ) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        """Return a box of an image, and which of its pixels a part of the axis covers, as wide as given [px]."""
        axis = self.arc.at(first + (last - first) / 23.0 * np.arange(24.0))
        (left, top), (right, bottom) = (axis.min(axis=0) - width).tolist(), (axis.max(axis=0) + width).tolist()
        left, top = min(max(int(left), 0), shape[1] - 1), min(max(int(top), 0), shape[0] - 1)
        right, bottom = max(left + 1, min(int(right), shape[1])), max(top + 1, min(int(bottom), shape[0]))
        covered = np.zeros((bottom - top, right - left), np.uint8)
        at = np.round((axis - (left, top)) * 16.0).astype(np.int32)
        cv2.polylines(covered, [at], False, 1, max(1, round(width)), cv2.LINE_8, 4)
        return (slice(top, bottom), slice(left, right)), covered.view(np.bool_)

    def near(self, points: np.ndarray, before: float, beyond: float, half: float) -> NDArray[np.bool_]:
        """Say which points lie up to some lengths before the tail and beyond the tip, and aside of the axis [px]."""
        along, aside = self.arc.coordinates(points)
        return np.asarray((along > -before) & (along < self.length_px + beyond) & (np.abs(aside) < half))

    def undirected(self) -> MeasuredNeedle:
        """Return the needle, its tail perhaps where its tip is taken to be."""
        chord, ahead = self.tip_px - self.tail_px, self.direction_px
        tip = np.array([chord @ ahead, chord @ [-ahead[1], ahead[0]], 0.0])
        assert self.covariance is not None
        covariance = self.covariance + np.outer(tip, tip) + np.diag([0.0, 0.0, math.pi**2])
        confidence = 0.5 * self.confidence
        return replace(self, covariance=covariance, confidence=confidence, heading_known=False, tail_shift_px=0.0)

    @property
    def tail_px(self) -> np.ndarray:
        """The blunt end as it is drawn, shape (2,) [px]."""
        return self.arc.start

    @property
    def tail_edge_px(self) -> np.ndarray:
        """The blunt end as it is measured by its edge, shape (2,) [px]."""
        return self.arc.point(self.tail_shift_px)

    @property
    def tip_px(self) -> np.ndarray:
        """The pointed end, shape (2,) [px]."""
        return self.arc.point(self.length_px)

    @property
    def direction_px(self) -> np.ndarray:
        """Unit tangent at the tail, u right and v down, shape (2,)."""
        return self.arc.direction(self.tail_shift_px)

    @property
    def middle_direction_px(self) -> np.ndarray:
        """Unit tangent at the middle, u right and v down, shape (2,)."""
        return self.arc.direction(0.5 * self.length_px)


@dataclass(frozen=True)
class NeedleSize:
    """The needle's size in an image.

    Attributes:
        length_px: along its axis [px].
        width_px: of its body [px].
        tolerance: share of the length by which it may be off, two standard deviations; 0: it is known.
        max_brightness: greatest brightness of a pixel that may be the needle's, as a share of the floor's.
        is_blunt: whether both ends are known to be blunt, so that no shape tells the tip.
        max_bend: angle that it turns by from end to end, at most [rad].
    """

    length_px: float
    width_px: float
    tolerance: float = 0.0
    max_brightness: float = 0.55
    is_blunt: bool = False
    max_bend: float = 4.0


class LengthEstimator:
    """Measures the needle's length over the first frames, and keeps it from then on.

    It is the median of `FRAMES` lengths of confident poses that show both ends, of the last twice as many, once these
    lie within `AGREEMENT` of each other.

    Attributes:
        length: measured [m]; None until then.
    """

    def __init__(self) -> None:
        self.length: float | None = None
        self._lengths: list[float] = []

    def add(self, length: float, confidence: float) -> None:
        """Take the length of a needle whose ends a frame shows [m], and the confidence of its pose."""
        if self.length is not None or confidence < 0.3:
            return
        self._lengths = [*self._lengths[1 - 2 * FRAMES :], length]
        ordered = np.sort(self._lengths)
        for first in range(len(ordered) - FRAMES + 1):
            alike = ordered[first : first + FRAMES]
            if np.ptp(alike) < AGREEMENT * np.median(alike):
                self.length = float(np.median(alike))
