"""Discs and balls: the obstacles with a closed formula."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class Disc:
    """A disc in the plane, or a ball in space.

    Attributes:
        centre: coordinates of the centre, d values [m].
        radius: radius [m].
    """

    centre: tuple[float, ...]
    radius: float

    def signed_distance(self, points: Points) -> tuple[NDArray[np.float64], Points]:
        """Return the signed distance of points from the surface, and the outward direction.

        Args:
            points: shape (m, d) [m].

        Returns:
            Distance, shape (m,), negative inside [m]; its gradient, unit vectors, shape (m, d). At the
            very centre, where every direction is as good, the first axis.
        """
        offset = points - np.asarray(self.centre)
        distance = np.linalg.norm(offset, axis=1)
        first_axis = np.zeros_like(offset)
        first_axis[:, 0] = 1.0
        safe = np.where(distance > 0.0, distance, 1.0)[:, None]
        normal = np.where(distance[:, None] > 0.0, offset / safe, first_axis)
        return distance - self.radius, normal
