"""The needle as it was measured in an image, and its size as it is set and as the first frames show it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.vision.needle.arc import Arc

SET_TOLERANCE = 0.1  # of the length as it is set
MEASURED_TOLERANCE = 0.02  # of the length once it is measured
FRAMES = 8  # that must agree
AGREEMENT = 0.02  # share of the length within which they agree
CONFIDENT = 0.3  # confidence of a pose that counts
REVERSED_PX = 3.0  # px; standard deviation, along the axis, of a tail placed where a tip was fitted


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
