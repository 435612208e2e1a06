"""Keeps the dish's view over time, and notices when the camera was bumped."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.dish.find import RIM_RAYS, RIM_SHARE, STILL_PX, rim_shift
from magnetosuture_thread.vision.look import find_view
from magnetosuture_thread.vision.settings import VisionTrackerSettings

AGREEING = 3  # frames in a row that must agree on a new view
AGREEMENT_PX, AGREEMENT = 1.0, 0.005  # of centres, and of scales


class DishWatch:
    """Gives the view for each frame.

    The dish is found once. In every frame its rim is looked at again: as long as it is where it was, the
    view stays as it is. Where it is not, there is no view until several frames in a row agree on a new one.

    Args:
        settings: what to look for.
        diameter: inner diameter of the dish [m].
    """

    def __init__(self, settings: VisionTrackerSettings, diameter: float) -> None:
        self._settings = settings
        self._diameter = diameter
        self._fixed = settings.fixed_view()
        self.view = self._fixed
        self._anew: list[DishView] = []

    def forget(self) -> None:
        """Begin anew, as with a camera of another size."""
        self.view, self._anew = self._fixed, []

    def look(self, gray: np.ndarray) -> str:
        """Look at the rim in a frame.

        Args:
            gray: image, shape (rows, columns), uint8.

        Returns:
            Why the view must not be used in this frame; empty if it may.
        """
        if self._fixed is not None:
            return ""
        if self.view is None:
            self.view = find_view(gray, self._settings, self._diameter)
            return "" if self.view is not None else "no dish in the image"
        shift, rays = rim_shift(gray, self.view.centre_px, 0.5 * self._diameter / self.view.metres_per_pixel)
        seen = rays >= RIM_SHARE * RIM_RAYS
        if seen and shift < STILL_PX:
            self._anew = []
            return ""
        found = find_view(gray, self._settings, self._diameter)
        if found is None:
            self._anew = []
            return "too little of the dish is seen"
        if self._anew and not _agree(found, self._anew[-1]):
            self._anew = []
        self._anew.append(found)
        if len(self._anew) < AGREEING:
            return "the dish is not where it was"
        self.view, self._anew = found, []
        return ""


def _agree(one: DishView, other: DishView) -> bool:
    apart = math.dist(one.centre_px, other.centre_px)
    return apart < AGREEMENT_PX and abs(one.metres_per_pixel / other.metres_per_pixel - 1.0) < AGREEMENT
