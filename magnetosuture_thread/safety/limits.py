"""Limits on the size of a velocity and on its change."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.configuration import Quantity
from magnetosuture_thread.geometry.arrays import finite_array

Vector = NDArray[np.float64]

FINITE = Quantity("", "m/s")


def limit_norm(vector: Vector, max_norm: float) -> Vector:
    """Return a vector scaled down to a maximum norm; its direction is kept.

    >>> limit_norm(np.array([3.0, 4.0]), 1.0)
    array([0.6, 0.8])
    """
    # Scaled by the largest component first: the squares of a hostile command may overflow.
    greatest = float(np.abs(vector).max())
    if greatest == 0.0:
        return np.zeros_like(vector)
    direction = vector / greatest
    norm = math.sqrt(float(direction @ direction))
    return vector if greatest * norm <= max_norm else direction * (max_norm / norm)


def rate_limit(previous: Vector, target: Vector, max_change: float) -> Vector:
    """Return the vector closest to the target within a maximum change from the previous one."""
    return previous + limit_norm(target - previous, max_change)


def checked_velocity(velocity: Vector) -> Vector:
    """Return a velocity as an array of shape (2,) [m/s].

    Raises:
        InvalidInputError: it is of another shape, or not finite.
    """
    return finite_array("velocity", velocity, (2,), FINITE)
