"""The overhead camera's view: pixels and the dish frame.

Pixels: u to the right, v down, the centre of the top left pixel at (0, 0). Dish frame: x to the right,
y up, origin at the dish's centre [m].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class DishView:
    """Where the dish is in the image.

        u = u_0 + x / s,    v = v_0 - y / s

    Attributes:
        centre_px: (u_0, v_0), the dish's centre [px].
        metres_per_pixel: s [m].
    """

    centre_px: tuple[float, float]
    metres_per_pixel: float

    def to_dish(self, pixels: Points) -> Points:
        """Return points of shape (..., 2) in the dish frame [m]."""
        return (np.asarray(pixels, dtype=float) - self.centre_px) * (self.metres_per_pixel, -self.metres_per_pixel)

    def to_pixels(self, points: Points) -> Points:
        """Return points of shape (..., 2) in pixels."""
        return np.asarray(points, dtype=float) / (self.metres_per_pixel, -self.metres_per_pixel) + self.centre_px
