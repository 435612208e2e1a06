"""How large the needle is: as it is set, and as the first frames show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SET_TOLERANCE = 0.1  # of the length as it is set
MEASURED_TOLERANCE = 0.02  # of the length once it is measured
FRAMES = 8  # that must agree
AGREEMENT = 0.02  # share of the length within which they agree
CONFIDENT = 0.3  # confidence of a pose that counts


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
