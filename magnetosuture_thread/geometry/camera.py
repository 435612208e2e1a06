"""The overhead camera's view: pixels and the dish frame.

Pixels: u to the right, v down, the centre of the top left pixel at (0, 0). Dish frame: x to the right,
y up, origin at the dish's centre [m]; turned where the camera is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class DishView:
    """The place of the dish in the image.

        u = u_0 + (x cos r - y sin r) / s,    v = v_0 - (x sin r + y cos r) / s

    Attributes:
        centre_px: (u_0, v_0), the dish's centre [px].
        metres_per_pixel: s [m].
        rotation: r, angle of the dish's x axis in the image, counter-clockwise as seen [rad].
    """

    centre_px: tuple[float, float]
    metres_per_pixel: float
    rotation: float = 0.0

    def shrunk(self, factor: float) -> DishView:
        """Return the view in an image shrunk by a factor, below 1 in one enlarged."""
        shift = 0.5 * (factor - 1.0)
        u, v = ((value - shift) / factor for value in self.centre_px)
        return DishView((u, v), self.metres_per_pixel * factor, self.rotation)

    def to_dish(self, pixels: Points) -> Points:
        """Return points of shape (..., 2) in the dish frame [m]."""
        offsets = np.asarray(pixels, dtype=float) - self.centre_px
        return self.directions_to_dish(offsets) * self.metres_per_pixel

    def to_pixels(self, points: Points) -> Points:
        """Return points of shape (..., 2) in pixels."""
        return self.directions_to_pixels(np.asarray(points, dtype=float) / self.metres_per_pixel) + self.centre_px

    def directions_to_dish(self, directions: Points) -> Points:
        """Return directions of shape (..., 2), u right and v down, in the dish frame; their lengths stay."""
        upright = np.asarray(directions, dtype=float) * (1.0, -1.0)
        return _turned(upright, -self.rotation) if self.rotation else upright

    def directions_to_pixels(self, directions: Points) -> Points:
        """Return directions of shape (..., 2) of the dish frame as u right and v down; their lengths stay."""
        upright = np.asarray(directions, dtype=float)
        return (_turned(upright, self.rotation) if self.rotation else upright) * (1.0, -1.0)

    def intrinsics(self, distance: float) -> NDArray[np.float64]:
        """Return the camera matrix of a pinhole camera straight above the dish's plane, shape (3, 3) [px].

            f = distance / s

        Args:
            distance: from the camera to the plane [m].
        """
        focal, (u, v) = distance / self.metres_per_pixel, self.centre_px
        return np.array([[focal, 0.0, u], [0.0, focal, v], [0.0, 0.0, 1.0]])


def _turned(vectors: Points, angle: float) -> Points:
    """Return vectors of shape (..., 2), turned counter-clockwise."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.asarray(vectors @ np.array([[cosine, sine], [-sine, cosine]]))
