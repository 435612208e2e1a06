"""Settings of the vision tracker."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

MIN_SCALE = 1e-7  # m; of a pixel: finer than light resolves
MIN_SIDE_PX = 64  # of a frame that is looked at
WORKING_NEEDLE_PX = 5.0  # width of the needle in a frame that is measured on; more pixels take time and tell little


@dataclass(frozen=True)
class VisionTrackerSettings(
    shared.LifecycleSettings, shared.SceneName, shared.NeedleLength, shared.NeedleWidth, shared.ThreadLength
):
    """What the vision tracker must know of the scene, the needle and the camera."""

    GROUP: ClassVar[str] = "vision_tracker"

    image_transport: str = quantity("compressed", "which camera topic to take", choices=("raw", "compressed"))
    region_px: tuple[float, ...] = quantity(
        (),
        "part of the frame that is looked at: left, top, right, bottom; not given: all of it",
        unit="px",
        minimum=0.0,
        maximum=1e5,
        multiple=4,
    )
    max_needle_brightness: float = quantity(
        0.55,
        "greatest brightness of a pixel that may be the needle's, as a share of the floor's; more for a bright needle",
        minimum=0.1,
        maximum=0.95,
    )
    needle_colour: tuple[float, ...] = quantity(
        (),
        "weights of blue, green and red that tell the needle from the floor, as `teach` measures; not given: all dark",
        minimum=0.0,
        maximum=1.0,
        multiple=3,
    )
    needle_is_blunt: bool = quantity(
        False, "whether both ends of the needle look alike, so that neither looks like a tip"
    )
    max_needle_bend: float = quantity(
        4.0,
        "angle that the needle turns by from end to end, at most; 0: straight",
        unit="rad",
        minimum=0.0,
        maximum=4.0,
    )
    outline_tolerance: float = quantity(
        0.0003,
        "what the outline of a shape of the scene and the visible one may differ by, for parallax and calibration",
        unit="m",
        minimum=0.0,
        maximum=0.01,
    )
    dish_centre_px: tuple[float, ...] = quantity(
        (),
        "the dish's centre in the image, u and v; not given: found",
        unit="px",
        minimum=-1e5,
        maximum=1e5,
        multiple=2,
    )
    metres_per_pixel: float = quantity(
        0.0, "the image's scale; 0: from the dish's diameter", unit="m", minimum=0.0, maximum=0.01
    )
    scale_error: float = quantity(
        0.0,
        "standard deviation of metres_per_pixel as a share of it, as calibrate-camera measures it",
        minimum=0.0,
        maximum=0.5,
    )
    rim: str = quantity(
        "",
        "edge of the dish's wall that the scene's diameter is of; not given: the inner one, in doubt by the others",
        choices=("", "inner", "outer"),
    )
    camera_rotation: float = quantity(
        0.0,
        "angle of the dish's x axis in the image, counter-clockwise as seen",
        unit="rad",
        minimum=-math.pi,
        maximum=math.pi,
    )
    straightening: tuple[float, ...] = quantity(
        (),
        "homography, nine numbers by rows, from a tilted camera's frame to the one in which the view holds",
        minimum=-1e9,
        maximum=1e9,
        multiple=9,
    )
    max_needle_speed: float = quantity(
        0.05, "maximum speed of the needle; what is faster is not it", unit="m/s", minimum=1e-4, maximum=1.0
    )
    max_turn_rate: float = quantity(
        6.0, "maximum turn rate of the needle; what is faster is not it", unit="rad/s", minimum=0.1, maximum=100.0
    )
    confirm_frames: int = quantity(
        3, "frames in a row that must agree before a needle found anew is tracked", minimum=1, maximum=30
    )
    forget_after: float = quantity(
        1.0, "time without the needle after which it is found anew", unit="s", minimum=0.05, maximum=60.0
    )

    def check(self) -> None:
        """Refuse more than one centre, and a scale that no camera has."""
        if len(self.dish_centre_px) > 2:
            name = f"{self.GROUP}.dish_centre_px"
            raise ConfigurationError(name, self.dish_centre_px, "u and v [px], or no entries to find the dish")
        if len(self.region_px) > 4:
            raise ConfigurationError(f"{self.GROUP}.region_px", self.region_px, "left, top, right, bottom [px]")
        if self.needle_colour and (len(self.needle_colour) > 3 or not 0.9 < sum(self.needle_colour) < 1.1):
            name = f"{self.GROUP}.needle_colour"
            raise ConfigurationError(name, self.needle_colour, "three weights whose sum is 1, or no entries")
        if self.straightening:
            name, matrix = f"{self.GROUP}.straightening", self.homography()
            if len(self.straightening) > 9 or matrix is None or abs(np.linalg.det(matrix)) < 1e-12:
                raise ConfigurationError(name, self.straightening, "a homography by calibrate-camera, or no entries")
            if self.fixed_view() is None:
                raise ConfigurationError(name, self.straightening, "dish_centre_px and metres_per_pixel beside it")
        if 0.0 < self.metres_per_pixel < MIN_SCALE:
            name = f"{self.GROUP}.metres_per_pixel"
            raise ConfigurationError(name, self.metres_per_pixel, f"at least {MIN_SCALE:g} m, or 0 to find it")

    def homography(self) -> np.ndarray | None:
        """Return the homography that straightens a frame, shape (3, 3); None if none is given."""
        return np.array(self.straightening[:9]).reshape(3, 3) if len(self.straightening) >= 9 else None

    def fixed_view(self) -> DishView | None:
        """Return the view if all of it is given; None if the dish must be found."""
        if len(self.dish_centre_px) == 2 and self.metres_per_pixel:
            u, v = self.dish_centre_px
            return DishView((u, v), self.metres_per_pixel, self.camera_rotation)
        return None

    def region_in(self, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
        """Return left, top, right and bottom of what is looked at of a frame of a shape (rows, columns) [px].

        Raises:
            InvalidInputError: the region leaves too little of it.
        """
        rows, columns = shape[:2]
        left, top, right, bottom = (int(value) for value in self.region_px or (0, 0, columns, rows))
        right, bottom = min(right, columns), min(bottom, rows)
        if min(right - left, bottom - top) < MIN_SIDE_PX:
            expected = f"left, top, right, bottom of {MIN_SIDE_PX} x {MIN_SIDE_PX} px or more of {columns} x {rows}"
            raise InvalidInputError(f"{self.GROUP}.region_px", list(self.region_px), expected)
        return left, top, right, bottom

    def working_factor(self, shape: tuple[int, ...], diameter: float) -> int:
        """Return by how much frames of a shape (rows, columns) of a dish are shrunk before they are measured on.

        The needle stays at least `WORKING_NEEDLE_PX` wide, and the frame `MIN_SIDE_PX`. Where the scale is not given,
        the dish is taken to fill the frame.
        """
        side = min(shape[:2])
        scale = self.metres_per_pixel or diameter / side
        return max(1, min(int(self.needle_width / scale / WORKING_NEEDLE_PX), side // MIN_SIDE_PX))

    def shrunk(self, factor: int, left: int = 0, top: int = 0) -> VisionTrackerSettings:
        """Return the settings for frames shrunk by a factor, of which a part is looked at, from (left, top) on [px]."""
        shift = 0.5 * (factor - 1.0)
        corner = zip(self.dish_centre_px, (left, top), strict=False)
        centre = tuple((value - shift) / factor - begin for value, begin in corner)
        matrix = self.homography()
        if matrix is not None:
            matrix = scaled_homography(matrix, factor, left, top)
        return replace(
            self,
            dish_centre_px=centre,
            metres_per_pixel=self.metres_per_pixel * factor,
            straightening=tuple(float(value) for value in matrix.ravel()) if matrix is not None else (),
        )


def scaled_homography(matrix: np.ndarray, factor: float, left: float = 0.0, top: float = 0.0) -> np.ndarray:
    """Return a homography between frames, shape (3, 3), for parts of these frames shrunk by a factor; see `shrunk`."""
    shift = 0.5 * (factor - 1.0) / factor
    small = np.array([[1.0 / factor, 0.0, -shift - left], [0.0, 1.0 / factor, -shift - top], [0.0, 0.0, 1.0]])
    return np.asarray(small @ matrix @ np.linalg.inv(small))
