"""How far the camera is tilted, by the ellipse that the dish's rim is seen as, and the frame without the tilt."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.dish.ellipse import Ellipse
from magnetosuture_thread.vision.dish.find import RAYS, rim_points

MIN_ANGLE = math.radians(3.5)  # below, light from one side moves the rim as much
ANGLE_ERROR = math.radians(2.0)  # by which light and noise change a tilt that is told
NEAR = 0.1  # of its distance from the camera, that the dish's radius is at most; more is hardly used over a dish


@dataclass(frozen=True)
class Tilt:
    """The camera's tilt.

    Attributes:
        angle: between its axis and the dish's normal [rad].
        direction: in the image, along which the dish looks shortened [rad], from u towards v.
        rotation: of the dish's x axis in the image [rad]; see `DishView`.
    """

    angle: float
    direction: float
    rotation: float = 0.0

    @property
    def direction_in_dish(self) -> np.ndarray:
        """Direction along which the dish looks shortened, in the dish frame, shape (2,)."""
        angle = -self.direction - self.rotation
        return np.array([math.cos(angle), math.sin(angle)])

    def covariance(self, tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
        """Return what perspective leaves unknown, shape (3, 3) [m, m, rad].

        An ellipse does not tell which side is nearer.

        Args:
            tail: in the dish frame, shape (2,) [m].
            heading: unit tangent there, shape (2,).
            radius: of the dish [m].
        """
        along = self.direction_in_dish
        change = perspective(tail, heading, radius)
        either = change @ (math.tan(self.angle) * along)
        return np.outer(either, either) + unseen_tilt_covariance(tail, heading, ANGLE_ERROR, radius)

    @property
    def warning(self) -> str:
        """What to tell of it."""
        return f"the camera is tilted by {math.degrees(self.angle):.0f} degrees"

    def corrected(self, image: np.ndarray, view: DishView) -> np.ndarray:
        """Return a frame in which the dish is a circle about its centre: stretched along the direction by 1 / cos."""
        along = np.array([math.cos(self.direction), math.sin(self.direction)])
        tilted = np.eye(3)
        tilted[:2, :2] += (math.cos(self.angle) - 1.0) * np.outer(along, along)
        to_centre = np.array([[1.0, 0.0, view.centre_px[0]], [0.0, 1.0, view.centre_px[1]], [0.0, 0.0, 1.0]])
        inverse = to_centre @ tilted @ np.linalg.inv(to_centre)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = image.shape[1::-1]
        return np.asarray(cv2.warpPerspective(image, inverse, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def tilt_of(ellipse: Ellipse, rotation: float) -> Tilt | None:
    """Return the tilt under which a circle is seen as an ellipse; None below what an ellipse tells."""
    angle = math.acos(min(1.0, ellipse.minor / ellipse.major))
    return Tilt(angle, ellipse.direction, rotation) if angle > MIN_ANGLE else None


def perspective(tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
    """Return how a tail and a heading angle in a dish change with a small tilt of the camera, shape (3, 2) [m, m, rad].

    Under a camera at a distance d, a tilt t (its angle, along the direction that is nearer) moves a point p of the dish
    by p (t . p) / d, and so the centre of the rim's ellipse by R^2 t / d, from which points are measured:

        dp = (p p^T - R^2 I) t / d,    d(angle) = (p . n) (h . t) / d,    n = h turned by a right angle

    Args:
        tail: p, shape (2,) [m].
        heading: h, shape (2,).
        radius: R of the dish [m], the share `NEAR` of d.
    """
    aside = np.array([-heading[1], heading[0]])
    moved = np.outer(tail, tail) - radius**2 * np.eye(2)
    return np.vstack([moved, float(tail @ aside) * heading]) * (NEAR / radius)


def unseen_tilt_covariance(tail: np.ndarray, heading: np.ndarray, angle: float, radius: float) -> np.ndarray:
    """Return what a tilt that no ellipse tells leaves unknown, shape (3, 3) [m, m, rad].

    All tilts up to an angle are held to be as likely: along each axis a variance of angle^2 / 4. See `perspective`.
    """
    change = perspective(tail, heading, radius)
    short = 0.5 * (1.0 - math.cos(angle))  # foreshortening, of second order
    lengths = np.array([np.hypot(*tail), np.hypot(*tail), 1.0])
    return np.asarray(0.25 * angle**2 * change @ change.T + np.diag((short * lengths) ** 2))


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
    fitted = np.empty(5)
    count, spread = fit_rim(points, view.centre_px, RAYS // 2, fitted)
    if not count:
        return None, view
    shape = fitted[3:]
    half = float(np.hypot(*shape))
    deviation = spread * math.sqrt(2.0 / count)
    angle = math.acos(min(1.0, (fitted[0] - half) / (fitted[0] + half)))
    if angle < MIN_ANGLE or half < 4.0 * deviation:
        return None, view
    # The greatest radius lies along the axis of the tilt, the least along the direction that is shortened.
    direction = 0.5 * math.atan2(float(shape[1]), float(shape[0])) + 0.5 * math.pi
    middle = (view.centre_px[0] + float(fitted[1]), view.centre_px[1] + float(fitted[2]))
    scale = view.metres_per_pixel * float(fitted[0]) / (float(fitted[0]) + half)
    return Tilt(angle, direction, view.rotation), DishView(middle, scale, view.rotation)


@compiled
def fit_rim(points, centre, min_points, rim):
    """Fit harmonics to a rim about a centre, leaving out what is far from it.

        r(t) = c_0 + c_1 cos t + c_2 sin t + c_3 cos 2t + c_4 sin 2t

    by least squares, over the points within three standard deviations of the last fit.

    Args:
        points: on the rim, shape (m, 2) [px].
        centre: u and v [px].
        min_points: that have to agree.
        rim: filled with c, shape (5,) [px].

    Returns:
        How many points agree, 0 if too few do, and the root mean square of their residuals [px].
    """
    total = len(points)
    basis, away, residual = np.empty((total, 5)), np.empty(total), np.empty(total)
    for index in range(total):
        x, y = points[index, 0] - centre[0], points[index, 1] - centre[1]
        away[index] = np.hypot(x, y)
        cosine, sine = x / max(away[index], 1e-9), y / max(away[index], 1e-9)
        basis[index, 0], basis[index, 1], basis[index, 2] = 1.0, cosine, sine
        basis[index, 3], basis[index, 4] = cosine * cosine - sine * sine, 2.0 * sine * cosine
    kept, count = np.ones(total, np.bool_), total
    system, right = np.empty((5, 5)), np.empty(5)
    for _ in range(4):
        if count < min_points:
            return 0, 0.0
        system[:], right[:] = 0.0, 0.0
        for index in range(total):
            if kept[index]:
                for i in range(5):
                    right[i] += basis[index, i] * away[index]
                    for j in range(5):
                        system[i, j] += basis[index, i] * basis[index, j]
        rim[:] = np.linalg.solve(system, right)
        for index in range(total):
            fitted = 0.0
            for i in range(5):
                fitted += basis[index, i] * rim[i]
            residual[index] = abs(away[index] - fitted)
        bound = max(0.3, 3.0 * 1.4826 * np.median(residual))
        square, count = 0.0, 0
        for index in range(total):
            kept[index] = residual[index] < bound
            if kept[index]:
                square += residual[index] ** 2
                count += 1
    return count, np.sqrt(square / max(count, 1))
