"""Calibrates the overhead camera: where the dish is in its image, how large a pixel is, how it is turned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import yaml

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.parameter_files import EVERY_NODE
from magnetosuture_thread.vision.dish.find import find_dish
from magnetosuture_thread.vision.images import check_image, measured_channel
from magnetosuture_thread.vision.settings import VisionTrackerSettings

MAX_RESIDUAL_PX = 1.5  # of the markers' corners, root of mean square; beyond, the camera is not overhead
MAX_SCATTER_PX = 1.5  # of the dish or the markers from frame to frame
CORNERS = ((-1, 1), (1, 1), (1, -1), (-1, -1))  # of a square, clockwise as seen from the top left
SHARE_WITH_DISH = 0.5  # of the frames must show the dish


@dataclass(frozen=True)
class Calibration:
    """What a calibration found.

    Attributes:
        view: centre, scale and rotation.
        frames: how many frames it rests on.
        residual_px: root of the mean square of the markers' corners' errors; 0 without markers [px].
        scatter_px: root of the mean square by which the frames differ from one another [px].
        dish_diameter: inner diameter of the dish [m].
    """

    view: DishView
    frames: int
    residual_px: float
    scatter_px: float
    dish_diameter: float

    def to_yaml(self) -> str:
        """Return a section of a ROS 2 parameter file for the vision tracker."""
        values = {
            "dish_centre_px": [round(float(value), 3) for value in self.view.centre_px],
            "metres_per_pixel": float(f"{self.view.metres_per_pixel:.7g}"),
            "camera_rotation": round(float(self.view.rotation), 6),
        }
        key = f"{EVERY_NODE}/{VisionTrackerSettings.GROUP}"
        return yaml.safe_dump({key: {"ros__parameters": values}}, sort_keys=False)


def calibrate_by_dish(images: Sequence[np.ndarray], dish_diameter: float) -> Calibration:
    """Return the mean of the dish's circle over several frames; the rotation is 0.

    Args:
        images: of one size, BGR or grey, uint8.
        dish_diameter: inner diameter of the dish [m].

    Raises:
        InvalidInputError: no images, images of different sizes, too few with a dish, or dishes that differ.
    """
    grays = _grays(images)
    views = [view for view in (find_dish(gray, dish_diameter) for gray in grays) if view is not None]
    if not views or len(views) < SHARE_WITH_DISH * len(grays):
        raise InvalidInputError("frames", f"{len(views)} of {len(grays)} with a dish", "a dish in at least half")
    circles = np.array([(*view.centre_px, 0.5 * dish_diameter / view.metres_per_pixel) for view in views])
    u, v, radius = np.median(circles, axis=0) if len(circles) > 2 else circles.mean(axis=0)
    scatter = float(np.sqrt(np.mean(np.sum((circles - (u, v, radius)) ** 2, axis=1))))
    _check_scatter("dishes", scatter)
    return Calibration(
        DishView((float(u), float(v)), 0.5 * dish_diameter / radius), len(views), 0.0, scatter, dish_diameter
    )


def calibrate_by_markers(
    images: Sequence[np.ndarray], dish_diameter: float, spacing: float, side: float
) -> Calibration:
    """Fit a similarity to four ArUco markers (4x4_50, ids 0 to 3) around the dish.

    Their centres are the corners of a square around the dish's centre: id 0 at the top left in the dish
    frame (x < 0, y > 0), then clockwise; all upright, their tops towards positive y. Least squares over
    their 16 corners p in the dish frame and w in pixels:

        u = u_0 + a x - b y,    v = v_0 - b x - a y,    a = cos(r) / s,    b = sin(r) / s

    Args:
        images: of one size, BGR or grey, uint8.
        dish_diameter: inner diameter of the dish [m].
        spacing: of the markers' centres along the square's side [m].
        side: of a marker [m].

    Raises:
        InvalidInputError: no images, images of different sizes, a marker that no image shows, markers that
            differ from frame to frame, corners that no overhead camera sees so, or OpenCV is older than 4.7.
    """
    grays = _grays(images)
    detector = _detector()
    seen: dict[int, list[np.ndarray]] = {index: [] for index in range(4)}
    for gray in grays:
        corners, ids, _ = detector.detectMarkers(gray)
        for at, index in zip(corners, [] if ids is None else ids.ravel(), strict=True):
            if int(index) in seen:
                seen[int(index)].append(at.reshape(4, 2).astype(float))
    missing = [str(index) for index, found in seen.items() if not found]
    if missing:
        raise InvalidInputError("frames", f"no marker {', '.join(missing)}", "ArUco markers 4x4_50 with ids 0 to 3")
    pixels = np.vstack([np.mean(seen[index], axis=0) for index in range(4)])
    # Of the markers that several frames show: one seen once says nothing of whether the camera stood still.
    apart = [np.array(found) - np.mean(found, axis=0) for found in seen.values() if len(found) > 1]
    scatter = float(np.sqrt(np.mean(np.sum(np.vstack(apart) ** 2, axis=2)))) if apart else 0.0
    _check_scatter("markers", scatter)
    square = np.array(CORNERS, dtype=float)
    points = np.vstack([0.5 * spacing * centre + 0.5 * side * square for centre in square])
    view, residual = _similarity(points, pixels)
    if residual > MAX_RESIDUAL_PX:
        expected = f"at most {MAX_RESIDUAL_PX} px, from a camera straight above markers at these distances"
        raise InvalidInputError("frames", f"marker corners off by {residual:.2f} px", expected)
    return Calibration(view, len(grays), residual, scatter, dish_diameter)


def _check_scatter(what: str, scatter_px: float) -> None:
    """Refuse frames between which the camera moved."""
    if scatter_px > MAX_SCATTER_PX:
        expected = f"a camera that stands still: at most {MAX_SCATTER_PX} px"
        raise InvalidInputError("frames", f"{what} that differ by {scatter_px:.2f} px", expected)


def _detector() -> cv2.aruco.ArucoDetector:
    if not hasattr(cv2, "aruco") or not hasattr(cv2.aruco, "ArucoDetector"):
        raise InvalidInputError(
            "markers", f"OpenCV {cv2.__version__}", "OpenCV 4.7 or newer, which is needed for markers"
        )
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters)


def _similarity(points: np.ndarray, pixels: np.ndarray) -> tuple[DishView, float]:
    """Return the view that takes points to pixels best, and the root of the mean square error [px]."""
    x, y = points.T
    one, none = np.ones(len(x)), np.zeros(len(x))
    system = np.vstack([np.column_stack([one, none, x, -y]), np.column_stack([none, one, -y, -x])])
    values, *_ = np.linalg.lstsq(system, pixels.T.ravel(), rcond=None)
    u, v, a, b = (float(value) for value in values)
    view = DishView((u, v), 1.0 / float(np.hypot(a, b)), float(np.arctan2(b, a)))
    return view, float(np.sqrt(np.mean(np.sum((view.to_pixels(points) - pixels) ** 2, axis=1))))


def _grays(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    for image in images:
        check_image(image)
    sizes = sorted({image.shape[1::-1] for image in images})
    if len(sizes) != 1:
        given = " and ".join(f"{wide} x {high}" for wide, high in sizes) or "none"
        raise InvalidInputError("frames", given, "frames of one size")
    return [measured_channel(image) for image in images]
