"""Where the dish is in a frame, and whether it still is there in the next: a camera may be bumped."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.dish.ellipse import circle_through, find_ellipse
from magnetosuture_thread.vision.dish.find import (
    MIN_ANGLE,
    RIM_RAYS,
    RIM_SHARE,
    STILL_PX,
    Guess,
    Tilt,
    find_cut_dish,
    find_dish,
    find_tilt,
    floor_level,
    rim_shift,
    tilt_of,
    unseen_tilt_covariance,
)
from magnetosuture_thread.vision.images import measured_channel
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.settings import VisionTrackerSettings

DARK_FLOOR = 130.0  # grey levels; a dish, or with a given view a frame, whose median is below may have a dark floor
SCALE_ERROR = 0.001  # of a scale by the dish's rim: how far its light moves the edge
ELLIPSE_ERROR = 0.01  # of a scale by an edge of the wall in a photograph: which one it is, and where light moves it
SCALE_SLACK = 0.03  # that a dish found may differ from the size that a given scale makes of it
MAX_SCALE_SLACK = 0.1  # the same, beyond which it is another dish; between, the dish's own size gives the scale
AGREEING = 3  # frames in a row that must agree on a new view
LONG_SEARCH = 4  # frames without a dish, in one of which it is looked for as in a photograph


@dataclass(frozen=True)
class FoundDish:
    """The dish in a frame.

    Attributes:
        view: where it is, once the frame is prepared.
        dark_field: whether the floor is dark, and needle, thread and rim are bright.
        tilt: of the camera; None if there is none to be sure of.
        scale_error: standard deviation of the view's scale, as a share; 0 where the scale is given.
        unseen_tilt: angle of a tilt that the rim would not tell [rad].
        remark: what a user should know of the view; empty if nothing.
        homography: from the frame to the one in which the view holds, shape (3, 3); None where they are the same.
    """

    view: DishView
    dark_field: bool = False
    tilt: Tilt | None = None
    scale_error: float = 0.0
    unseen_tilt: float = 0.0
    remark: str = ""
    homography: np.ndarray | None = None

    def covariance(self, tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
        """Return what the view leaves unknown of a tail and a heading in a dish, shape (3, 3) [m, m, rad]."""
        total = np.zeros((3, 3))
        total[:2, :2] = self.scale_error**2 * np.outer(tail, tail)  # A wrong scale shifts what is far from the centre.
        if self.tilt is not None:
            total += self.tilt.covariance(tail, heading, radius)
        elif self.unseen_tilt:
            total += unseen_tilt_covariance(tail, heading, self.unseen_tilt, radius)
        return total

    @property
    def warning(self) -> str:
        """What makes the measurement worse than it could be; empty if nothing does."""
        return "; ".join(filter(None, (self.tilt.warning if self.tilt is not None else "", self.remark)))

    def prepared(self, image: np.ndarray) -> np.ndarray:
        """Return a frame with a bright floor and a round dish."""
        if self.dark_field:
            image = 255 - image
        if self.homography is not None:
            size = image.shape[1::-1]
            return np.asarray(cv2.warpPerspective(image, self.homography, size, borderMode=cv2.BORDER_REPLICATE))
        return image if self.tilt is None else self.tilt.corrected(image, self.view)


def see_dish(
    image: np.ndarray, settings: VisionTrackerSettings, diameter: float, *, photographed: bool = True
) -> FoundDish | None:
    """Find the view: what of it is given, and the rest by the dish; None if none is seen.

    Args:
        image: frame, shape (rows, columns) or (rows, columns, 3), uint8.
        settings: what to look for.
        diameter: of the dish [m].
        photographed: whether to look for a dish as in a photograph where there is no other, which takes long.
    """
    gray = measured_channel(image)
    guesses: dict[int, Guess | None] = {}
    fixed = settings.fixed_view()
    if fixed is not None:
        # Only a dark frame whose negative shows the dish has a dark floor: others are just dark.
        dark = middle(gray[::8, ::8]) < DARK_FLOOR and _with_given(find_dish(gray, diameter, guesses), settings) is None
        dark = dark and _with_given(find_dish(255 - gray, diameter, guesses), settings) is not None
        return FoundDish(fixed, dark, homography=settings.homography())
    for dark_field in (False, True):
        if dark_field:
            gray = 255 - gray
        found = _with_given(find_dish(gray, diameter, guesses), settings)
        if found is None:
            continue
        view, remark = found
        if dark_field and floor_level(gray, view, diameter) < 255.0 - DARK_FLOOR:
            continue  # A bright rim around a bright floor, as of clear walls.
        if settings.dish_centre_px or settings.metres_per_pixel:  # measured by a calibration
            error = 0.0 if settings.metres_per_pixel and not remark else SCALE_ERROR
            return FoundDish(view, dark_field, scale_error=error, remark=remark)
        tilt, view = find_tilt(gray, view, diameter)
        return FoundDish(view, dark_field, tilt, SCALE_ERROR, 0.0 if tilt is not None else MIN_ANGLE)
    return _photographed(image, settings, diameter) if photographed else None


def _with_given(found: DishView | None, settings: VisionTrackerSettings) -> tuple[DishView, str] | None:
    """Return a view that was found with what is given of it, and a remark; None if they don't fit at all.

    Where a given scale and the dish differ by more than a rim's light can make, all that is known of the scene is
    relative to its dish: the dish gives the scale.
    """
    if found is None:
        return None
    scale, remark = settings.metres_per_pixel or found.metres_per_pixel, ""
    apart = found.metres_per_pixel / scale - 1.0
    if abs(apart) > MAX_SCALE_SLACK:
        return None
    if abs(apart) > SCALE_SLACK:
        scale = found.metres_per_pixel
        remark = f"metres_per_pixel is {100.0 * abs(apart):.0f} % off what the dish's diameter makes it, which is used"
    centre = settings.dish_centre_px
    return DishView((centre[0], centre[1]) if centre else found.centre_px, scale, settings.camera_rotation), remark


def _photographed(image: np.ndarray, settings: VisionTrackerSettings, diameter: float) -> FoundDish | None:
    """Find a dish by its ellipse alone, as in a photograph: cut, saturated, with a lid, on any ground."""
    ellipse = find_ellipse(image)
    if ellipse is None:
        return None
    gray, found = measured_channel(image), DishView(ellipse.centre_px, 0.5 * diameter / ellipse.major)
    tilt, unseen_tilt = tilt_of(ellipse.minor, ellipse.major, ellipse.direction, settings.camera_rotation), MIN_ANGLE
    if tilt is not None and ellipse.is_cut(image.shape):  # The part that is seen does not determine a tilt.
        cut = find_cut_dish(gray, circle_through(image, ellipse), diameter)
        if cut is None:
            return None
        found, tilt, unseen_tilt = cut, None, math.radians(10.0)
    if (given := _with_given(found, settings)) is None:
        return None
    view, remark = given
    dark_field = floor_level(gray, found, diameter) < 64.0
    tilt = None if settings.dish_centre_px or settings.metres_per_pixel else tilt
    return FoundDish(view, dark_field, tilt, ELLIPSE_ERROR, 0.0 if tilt is not None else unseen_tilt, remark)


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
        """Say whether two dishes are one: within 1 px and 0.5 % of scale, or within two standard deviations."""
        slack = 2.0 * max(one.scale_error, other.scale_error)
        scale = one.view.metres_per_pixel
        apart = math.dist(one.view.centre_px, other.view.centre_px)
        near = apart < max(1.0, slack * 0.5 * self._diameter / scale)
        return near and abs(scale / other.view.metres_per_pixel - 1.0) < max(0.005, slack)
