"""Limits on how large a vector is and how fast it changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def shortened(vector: Vector, largest: float) -> Vector:
    """Return a vector of at most a length, its direction kept.

    >>> shortened(np.array([3.0, 4.0]), 1.0)
    array([0.6, 0.8])
    """
    # By the greatest component first: the squares of what a hostile command holds may be infinite.
    greatest = float(np.max(np.abs(vector)))
    if greatest == 0.0:
        return np.zeros_like(vector)
    direction = vector / greatest
    length = float(np.linalg.norm(direction))
    return vector if greatest * length <= largest else direction * (largest / length)


def approached(before: Vector, wanted: Vector, largest: float) -> Vector:
    """Return what comes nearest to the one wanted within a distance of the one before."""
    return before + shortened(wanted - before, largest)
