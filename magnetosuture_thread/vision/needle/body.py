"""Measures one dark thing as a needle: its axis, its two ends, and whether both look like ends."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.covers import is_glaring, what_covers
from magnetosuture_thread.vision.needle.ends import FULL, tail_at, tip_at, turned_tail_first
from magnetosuture_thread.vision.needle.strip import TAPER, Strip, body_width, fit_axis, straight_strip

SHARPEST_PX = 4.5  # a tail fades within
LENGTH_SLACK_PX, LENGTH_SLACK = 1.4, 0.007  # that the seen length may differ from the known one, and share of it
MAX_BLOOM_PX = 0.6  # that an edge may seem to lie outside of where it is
OFF_AXIS_PX = 0.4  # that the tip may lie aside of the axis on which lengths are measured
TURNED = math.radians(2.0)  # that the needle may leave its tail beside that axis
THREAD_PX = 0.6  # by which a thread under the body widens it at least
TAIL_ROWS = 2.5  # next to the tail, that the thread pulls aside
MEASURED_WEIGHT = 0.3  # of the seen length beside the known one
GLARING = 0.8  # of the slack in length, where the lamp is reflected at an end


@dataclass(frozen=True)
class MeasuredNeedle:
    """The needle in the image.

    Attributes:
        arc: its axis from the tail on.
        length_px: of the axis, from tail to tip [px].
        width_px: mean width of the body [px].
        contrast: darkness of the body as a share of the floor's brightness, 0 to 1.
        confidence: how well all fits, 0 to 1.
        covariance: of the tail along and aside of the axis and of its angle [px, px, rad], shape (3, 3).
        heading_known: whether it is told which end is the tail.
    """

    arc: Arc
    length_px: float
    width_px: float
    contrast: float = 1.0
    confidence: float = 1.0
    covariance: np.ndarray | None = None
    heading_known: bool = True

    def shifted(self, offset: tuple[float, float]) -> MeasuredNeedle:
        """Return the needle in pixels that begin elsewhere."""
        return replace(self, arc=replace(self.arc, start=self.arc.start + offset))

    @property
    def tail_px(self) -> np.ndarray:
        """The blunt end, shape (2,) [px]."""
        return self.arc.start

    @property
    def tip_px(self) -> np.ndarray:
        """The pointed end, shape (2,) [px]."""
        return self.arc.at(self.length_px)

    @property
    def direction_px(self) -> np.ndarray:
        """Unit tangent at the tail, u right and v down, shape (2,)."""
        return self.arc.direction()

    @property
    def curvature_px(self) -> float:
        """Of the axis [1/px]; positive turns from u towards v, clockwise as seen."""
        return self.arc.curvature


def measure_body(
    gray: np.ndarray,
    guess: Arc,
    first: float,
    last: float,
    length: float,
    width: float,
    toward: np.ndarray | None = None,
) -> MeasuredNeedle | str:
    """Measure a dark thing that may be the needle.

    Args:
        gray: image, shape (rows, columns), uint8.
        guess: where its axis is, about.
        first: length along the guess at which the dark begins [px].
        last: and at which it ends [px].
        length: of the needle [px].
        width: of its body [px].
        toward: where it must point, u right and v down; see `find_needles`.

    Returns:
        The needle as `SeenNeedle`, or in words why this is none.
    """
    rows, columns = gray.shape
    arc = guess.moved(first, 0.0, 0.0, 0.0)
    last -= first
    for _ in range(3):
        strip = straight_strip(gray, arc, last, width)
        if strip is None:
            return "too faint"
        fitted = fit_axis(strip, 1.0, last - 1.0, (0.35 * width, np.inf))
        if fitted is None:
            return "not slender"
        arc, moved = fitted[0], fitted[1]
        if moved < 0.3:
            break
    strip = straight_strip(gray, arc, last, width)
    if strip is None:
        return "too faint"
    corners = arc.at(np.array([0.0, last]))
    if corners.min() < 3.0 or (corners > np.array([columns, rows]) - 4.0).any():
        return "cut by the image's border"
    body = body_width(strip, last)
    if not (0.65 * width - 0.5 < body < 1.35 * width + 1.2):
        return f"{body:.1f} px wide"
    turned = turned_tail_first(strip, last, body, toward)
    if turned is None:
        return "ends that look alike"
    strip, last = turned
    ends = _ends(strip, last, body, width)
    if ends is not None and (refined := _along_body(gray, strip, ends, body, width)) is not None:
        strip, last = refined
        ends = _ends(strip, last, body, width)
    if ends is None:
        return "no tail"
    tail, tip, fading = ends
    seen = tip - tail
    slack = LENGTH_SLACK_PX + LENGTH_SLACK * length
    if abs(seen - length) > slack:
        return f"{seen:.1f} px long instead of {length:.1f}"
    if is_glaring(strip, tail, tip, body):  # which may hide a part of an end
        slack *= GLARING
        if abs(seen - length) > slack:
            return f"{seen:.1f} px long instead of {length:.1f}, with glare at an end"
    if fading > SHARPEST_PX:
        return "a tail that fades away"
    reason = what_covers(strip, tail, tip, body)
    if reason:
        return reason
    axis = _body_axis(strip, tail, tip, body)
    if axis is None:
        return "not slender"
    arc, _, covariance = axis
    start = arc.coordinates(strip.arc.at(np.array([tail])))[0][0]
    # The tip is seen less well than the tail: the known length tells as much about it.
    final = arc.moved(float(start), 0.0, 0.0, 0.0)
    mismatch = (seen - length) / (LENGTH_SLACK_PX + LENGTH_SLACK * length)
    confidence = (1.0 - 0.5 * mismatch**2) * min(1.0, strip.depth / 0.6) * max(0.2, 1.0 - 2.0 * covariance[1, 1])
    return MeasuredNeedle(
        final, length + MEASURED_WEIGHT * (seen - length), body, strip.depth, float(confidence), covariance
    )


def _ends(strip: Strip, last: float, body: float, width: float) -> tuple[float, float, float] | None:
    """Return where tail and tip are along a strip, and how far the tail fades; None without a tail."""
    tail = tail_at(strip, body)
    if tail is None:
        return None
    # What lets the sides look wider than they are, the lens or the liquid's edge, does so at the tail too.
    bloom = min(max(0.5 * (body - width), -MAX_BLOOM_PX), MAX_BLOOM_PX)
    return tail[0] + bloom, tip_at(strip, last, body), tail[1]


def _body_axis(strip: Strip, tail: float, tip: float, body: float) -> tuple[Arc, float, np.ndarray] | None:
    """Fit the axis to the body alone.

    Left out are the taper, as a point may be ground to one side, and the edge on whose side a thread widens the body.
    """
    high = tail + (1.0 - TAPER) * (tip - tail) - 1.0
    return fit_axis(strip, tail + TAIL_ROWS, high, (FULL * body, body + THREAD_PX), tail, 0.5 * body)


def _along_body(
    gray: np.ndarray, strip: Strip, ends: tuple[float, float, float], body: float, width: float
) -> tuple[Strip, float] | None:
    """Straighten once more along the body's own axis, where that leads elsewhere at an end; None where it doesn't.

    Lengths are true along the axis only, and a thread that turns back beside the needle has bent the first guess at
    the tail: rows askew to the body take more of the thread for steel than the fit can pass over.
    """
    tail, tip, _ = ends
    axis = _body_axis(strip, tail, tip, body)
    if axis is None:
        return None
    arc = axis[0]
    aside = abs(float(arc.coordinates(strip.arc.at(np.array([tip])))[1][0]))
    if aside < OFF_AXIS_PX and arc.direction() @ strip.arc.direction(tail) > math.cos(TURNED):
        return None
    again = straight_strip(gray, arc, tip - tail, width)
    return None if again is None else (again, tip - tail)
