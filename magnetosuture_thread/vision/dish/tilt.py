"""How far the camera is tilted, by the ellipse that the dish's rim is seen as, and the frame without the tilt."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.dish.find import RAYS, rim_points

MIN_ANGLE = math.radians(3.5)  # below, light from one side moves the rim as much
SURE = 4.0  # standard deviations that an ellipse is off a circle at least
NEAR = 0.1  # of its distance from the camera, that the dish's radius is at most; more is hardly used over a dish


@dataclass(frozen=True)
class Tilt:
    """The camera's tilt.

    Attributes:
        angle: between its axis and the dish's normal [rad].
        direction: in the image, along which the dish looks shortened [rad], from u towards v.
    """

    angle: float
    direction: float

    def covariance(self, radius: float) -> np.ndarray:
        """Return what perspective leaves unknown of a place and a heading, shape (3, 3) [m, m, rad].

        It shifts what is nearer or farther by up to R^2 / d tan(angle) and turns it by up to R / d tan(angle); which
        side of the dish is nearer cannot be told by an ellipse.

        Args:
            radius: of the dish [m].
        """
        error = NEAR * math.tan(self.angle)
        return np.diag([radius * error, radius * error, error]) ** 2

    @property
    def warning(self) -> str:
        """What to tell of it."""
        return f"the camera is tilted by {math.degrees(self.angle):.0f} degrees"

    def corrected(self, image: np.ndarray, view: DishView) -> np.ndarray:
        """Return a frame stretched about the dish's centre, so that the dish is a circle."""
        along = np.array([math.cos(self.direction), math.sin(self.direction)])
        back = np.eye(2) + (math.cos(self.angle) - 1.0) * np.outer(along, along)
        centre = np.array(view.centre_px)
        inverse = np.column_stack([back, centre - back @ centre])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = image.shape[1::-1]
        return np.asarray(cv2.warpAffine(image, inverse, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def find_tilt(gray: np.ndarray, view: DishView, diameter: float) -> tuple[Tilt | None, DishView]:
    """Find the camera's tilt.

        r(t) = r_0 + x cos t + y sin t + a cos 2t + b sin 2t,    cos(angle) = (r_0 - h) / (r_0 + h),  h = |(a, b)|

    of the rim, robustly; see `find_dish`.

    Args:
        gray: frame, shape (rows, columns), uint8.
        view: of the dish as a circle.
        diameter: of the dish [m].

    Returns:
        The tilt, None if there is none to be sure of, and the view of the corrected frame.
    """
    radius = 0.5 * diameter / view.metres_per_pixel
    points = rim_points(gray, view.centre_px, radius)
    if len(points) < RAYS // 2:
        return None, view
    u, v = (points - view.centre_px).T
    around, away = np.arctan2(v, u), np.hypot(u, v)
    system = np.column_stack(
        [np.ones(len(u)), np.cos(around), np.sin(around), np.cos(2.0 * around), np.sin(2.0 * around)]
    )
    kept = np.ones(len(u), bool)
    for _ in range(4):
        if kept.sum() < RAYS // 2:
            return None, view
        fitted, *_ = np.linalg.lstsq(system[kept], away[kept], rcond=None)
        residual = np.abs(away - system @ fitted)
        spread = 1.4826 * float(np.median(residual))
        kept = residual < max(0.3, 3.0 * spread)
    shape = fitted[3:]
    half = float(np.hypot(*shape))
    deviation = math.sqrt(float((residual[kept] ** 2).mean()) * 2.0 / float(kept.sum()))
    angle = math.acos(min(1.0, (fitted[0] - half) / (fitted[0] + half)))
    if angle < MIN_ANGLE or half < SURE * deviation:
        return None, view
    # The greatest radius lies along the axis of the tilt, the least along the direction that is shortened.
    direction = 0.5 * math.atan2(float(shape[1]), float(shape[0])) + 0.5 * math.pi
    middle = (view.centre_px[0] + float(fitted[1]), view.centre_px[1] + float(fitted[2]))
    scale = view.metres_per_pixel * float(fitted[0]) / (float(fitted[0]) + half)
    return Tilt(angle, direction), DishView(middle, scale, view.rotation)
