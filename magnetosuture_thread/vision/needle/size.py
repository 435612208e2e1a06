"""How large the needle is in an image, as far as it is known."""

from __future__ import annotations

from dataclasses import dataclass


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
