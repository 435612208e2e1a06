"""Keeps the dish's view over time, and notices when the camera was bumped."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.dish.find import RIM_RAYS, RIM_SHARE, STILL_PX, rim_shift
from magnetosuture_thread.vision.images import measured_channel
from magnetosuture_thread.vision.look import FoundDish, see_dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings

AGREEING = 3  # frames in a row that must agree on a new view
AGREEMENT_PX, AGREEMENT = 1.0, 0.005  # of centres, and of scales ...
DEVIATIONS = 2.0  # ... or so many standard deviations of both, as of a dish by its ellipse, if that is more
LONG_SEARCH = 4  # frames without a dish, in one of which it is looked for as in a photograph


class DishWatch:
    """Gives the view for each frame.

    The dish is found once. In every frame its rim is looked at again: as long as it is where it was, the
    view stays as it is. Where it is not, there is no view until several frames in a row agree on a new one.

    Args:
        settings: what to look for.
        diameter: inner diameter of the dish [m].

    Attributes:
        found: the dish as it was found; None if it was not yet.
    """

    def __init__(self, settings: VisionTrackerSettings, diameter: float) -> None:
        self._settings = settings
        self._diameter = diameter
        self._fixed = settings.fixed_view()
        self.found: FoundDish | None = None
        self._anew: list[FoundDish] = []
        self._searched = 0  # frames in a row without a dish

    @property
    def view(self) -> DishView | None:
        """Where the dish is; None if it was not found yet."""
        return self._fixed or (self.found.view if self.found is not None else None)

    def forget(self) -> None:
        """Begin anew, as with a camera of another size."""
        self.found, self._anew, self._searched = None, [], 0

    def look(self, image: np.ndarray) -> tuple[str, np.ndarray]:
        """Look at the rim in a frame.

        Args:
            image: shape (rows, columns) or (rows, columns, 3), uint8.

        Returns:
            Why the view must not be used in this frame, empty if it may; and the frame as it is measured on, see
            `FoundDish.prepared`.
        """
        if self._fixed is not None or self.found is None:
            self.found = self._search(image)
            if self.found is None:
                return "no dish in the image", image
            return "", self.found.prepared(image)
        prepared = self.found.prepared(image)
        gray, view = measured_channel(prepared), self.found.view
        shift, rays = rim_shift(gray, view.centre_px, 0.5 * self._diameter / view.metres_per_pixel)
        seen = rays >= RIM_SHARE * RIM_RAYS
        if seen and shift < STILL_PX:
            self._anew, self._searched = [], 0
            return "", prepared
        found = self._search(image)
        if found is None:
            self._anew = []
            return "too little of the dish is seen", prepared
        if self._agree(found, self.found):  # A rim that is not dark is seen by its ellipse only.
            self._anew = []
            return "", prepared
        if self._anew and not self._agree(found, self._anew[-1]):
            self._anew = []
        self._anew.append(found)
        if len(self._anew) < AGREEING:
            return "the dish is not where it was", prepared
        self.found, self._anew = found, []
        return "", found.prepared(image)

    def _search(self, image: np.ndarray) -> FoundDish | None:
        """Look for the dish; in most frames only as long as a live node has time for, until one was found."""
        long = bool(self._anew) or self._searched % LONG_SEARCH == 0
        found = see_dish(image, self._settings, self._diameter, photographed=long)
        self._searched = 0 if found is not None else self._searched + 1
        return found

    def _agree(self, one: FoundDish, other: FoundDish) -> bool:
        """Say whether two dishes that were found are where one is, as far as is known of each."""
        slack = DEVIATIONS * max(one.scale_error, other.scale_error)
        scale = one.view.metres_per_pixel
        apart = math.dist(one.view.centre_px, other.view.centre_px)
        near = apart < max(AGREEMENT_PX, slack * 0.5 * self._diameter / scale)
        return near and abs(scale / other.view.metres_per_pixel - 1.0) < max(AGREEMENT, slack)
