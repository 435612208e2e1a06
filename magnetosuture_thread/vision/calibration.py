"""Calibrates the overhead camera: where the dish is in its image, how large a pixel is, how it is turned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import yaml

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.shared_parameters import EVERY_NODE
from magnetosuture_thread.vision.arc import FRAMES, SET_TOLERANCE
from magnetosuture_thread.vision.dish import NO_DISH, RING_ERROR, see_dish
from magnetosuture_thread.vision.images import check_image, measured_channel, shrunk
from magnetosuture_thread.vision.settings import VisionTrackerSettings, scaled_homography
from magnetosuture_thread.vision.tracker import VisionTracker

MAX_RESIDUAL_PX = 1.5  # of the markers' corners, root of mean square; beyond, they are not where they should be
MAX_SCATTER_PX = 1.5  # of the dish or the markers from frame to frame
CORNERS = ((-1, 1), (1, 1), (1, -1), (-1, -1))  # of a square, clockwise as seen from the top left


@dataclass(frozen=True)
class Calibration:
    """What a calibration found.

    Attributes:
        view: centre, scale and rotation.
        frames: how many frames it rests on.
        residual_px: root of the mean square of the markers' corners' errors; 0 without markers [px].
        scatter_px: root of the mean square by which the frames differ from one another [px].
        dish_diameter: inner diameter of the dish [m].
        homography: from a tilted camera's frame to the one in which the view holds, shape (3, 3); None if straight.
        needle: length and width [m], its length measured; None if it was not asked for. See `measure_needle_length`.
        looked: settings of the tracker that it was looked for with: part of the frame, edge of the wall, and how the
            needle looks.
        scale_error: standard deviation of the scale by the dish, as a share.
        remark: what a user should know of the view; empty if nothing.
    """

    view: DishView
    frames: int
    residual_px: float
    scatter_px: float
    dish_diameter: float
    homography: np.ndarray | None = None
    needle: tuple[float, float] | None = None
    looked: VisionTrackerSettings = field(default_factory=VisionTrackerSettings)
    scale_error: float = 0.0
    remark: str = ""

    def to_yaml(self) -> str:
        """Return a section of a ROS 2 parameter file for the vision tracker, and the needle's size for every node."""
        values: dict[str, Any] = {
            "dish_centre_px": [round(float(value), 3) for value in self.view.centre_px],
            "metres_per_pixel": float(f"{self.view.metres_per_pixel:.7g}"),
            "scale_error": round(float(self.scale_error), 4),
            "camera_rotation": round(float(self.view.rotation), 6),
        }
        usual = VisionTrackerSettings()
        looks = ("max_needle_brightness", "needle_colour", "needle_is_blunt", "max_needle_bend")
        for name in ("region_px", "rim", *looks):
            value = getattr(self.looked, name)
            if value != getattr(usual, name):
                values[name] = [round(each, 4) for each in value] if isinstance(value, tuple) else value
        if self.homography is not None:
            values["straightening"] = [float(f"{value:.12g}") for value in self.homography.ravel()]
        sections = {}
        if self.needle is not None:
            sizes = zip(("needle_length", "needle_width"), self.needle, strict=True)
            sections[EVERY_NODE] = {"ros__parameters": {name: round(size, 6) for name, size in sizes}}
        sections[f"{EVERY_NODE}/{VisionTrackerSettings.GROUP}"] = {"ros__parameters": values}
        return yaml.safe_dump(sections, sort_keys=False)


def measure_needle_length(images: Sequence[np.ndarray], calibration: Calibration, length: float, width: float) -> float:
    """Return the needle's length as the tracker measures it over its first frames, in a calibrated view [m].

    Args:
        images: that show both ends of a needle, at least `FRAMES` of them, BGR or grey, uint8.
        calibration: of the camera that took them.
        length: of the needle's body, known within `SET_TOLERANCE` [m].
        width: of it [m].

    Raises:
        InvalidInputError: too few images show a needle of about that length, or they do not agree on one.
    """
    settings = replace(
        calibration.looked,
        needle_length=length,
        needle_width=width,
        dish_centre_px=calibration.view.centre_px,
        metres_per_pixel=calibration.view.metres_per_pixel,
        camera_rotation=calibration.view.rotation,
        straightening=() if calibration.homography is None else tuple(calibration.homography.ravel().tolist()),
        confirm_frames=1,
    )
    tracker = VisionTracker(settings, Scene(dish=Dish(calibration.dish_diameter)))
    apart = 2.0 * settings.forget_after  # Frames of a calibration may be of any time: the needle is found anew in each.
    for index, image in enumerate(images):
        found = tracker.track(image, apart * index).needle_length
        if found is not None:
            return found
    expected = f"both ends of a needle of {1e3 * length:.3g} mm, known within {SET_TOLERANCE:.0%}, in {FRAMES} of them"
    raise InvalidInputError("frames", f"no needle's length in {len(images)} frames", expected)


def calibrate_by_dish(
    images: Sequence[np.ndarray], dish_diameter: float, settings: VisionTrackerSettings | None = None
) -> Calibration:
    """Return the median of the dishes over several frames, as the tracker finds them; the rotation is 0.

    Args:
        images: of one size, BGR or grey, uint8.
        dish_diameter: inner diameter of the dish [m].
        settings: of the tracker, whose view is not used.

    Raises:
        InvalidInputError: no images, images of different sizes, too few with a dish, or dishes that differ.
    """
    _check_images(images)
    given = replace(settings or VisionTrackerSettings(), dish_centre_px=(), metres_per_pixel=0.0, straightening=())
    box = given.region_in(images[0].shape)
    factor = given.working_factor((box[3] - box[1], box[2] - box[0]), dish_diameter)
    left, top, right, bottom = (value // factor for value in box)
    parts = (shrunk(image, factor)[top:bottom, left:right] for image in images)
    seen = (see_dish(np.ascontiguousarray(part), given, dish_diameter) for part in parts)
    dishes = [dish for dish in seen if dish is not None]
    if not dishes or len(dishes) < 0.5 * len(images):
        expected = f"a dish in at least half; else {NO_DISH}"
        raise InvalidInputError("frames", f"{len(dishes)} of {len(images)} with a dish", expected)
    circles = np.array([(*dish.view.centre_px, 0.5 * dish_diameter / dish.view.metres_per_pixel) for dish in dishes])
    slack = max(MAX_SCATTER_PX, RING_ERROR * float(np.median(circles[:, 2])))
    apart = circles[:, None] - circles
    still = np.hypot(apart[..., 0], apart[..., 1]) < slack
    if 2 * still.sum(axis=1).max() <= len(dishes):
        _check_scatter("dishes", float(np.sqrt(np.mean(np.sum((circles - circles.mean(axis=0)) ** 2, axis=1)))))
    # In some frames another edge of the wall may be found, which is no motion: what most agree on is taken.
    alike = still & (np.abs(apart[..., 2]) < slack)
    kept = alike[alike.sum(axis=1).argmax()]
    u, v, radius = np.median(circles[kept], axis=0) if kept.sum() > 2 else circles[kept].mean(axis=0)
    scatter = factor * float(np.sqrt(np.mean(np.sum((circles[kept] - (u, v, radius)) ** 2, axis=1))))
    nearest = dishes[int(np.where(kept, np.abs(circles[:, 2] - radius), np.inf).argmin())]
    view = DishView((float(u) + left, float(v) + top), 0.5 * dish_diameter / radius).shrunk(1.0 / factor)
    straight = nearest.straightening()
    moved = int((~still[kept].any(axis=0)).sum())
    elsewhere = f"{moved} of {len(dishes)} frames show the dish elsewhere, and are left out" if moved else ""
    return Calibration(
        view,
        int(kept.sum()),
        0.0,
        scatter,
        dish_diameter,
        None if straight is None else scaled_homography(scaled_homography(straight, 1.0, -left, -top), 1.0 / factor),
        looked=given,
        scale_error=nearest.scale_error,
        remark="; ".join(filter(None, (nearest.warning, elsewhere))),
    )


def calibrate_by_markers(
    images: Sequence[np.ndarray], dish_diameter: float, spacing: float, side: float
) -> Calibration:
    """Fit a similarity, or of a tilted camera a homography, to four ArUco markers (4x4_50, ids 0 to 3) around the dish.

    Their centres are the corners of a square around the dish's centre: id 0 at the top left in the dish
    frame (x < 0, y > 0), then clockwise; all upright, their tops towards positive y. Least squares over
    their 16 corners p in the dish frame and w in pixels:

        u = u_0 + a x - b y,    v = v_0 - b x - a y,    a = cos(r) / s,    b = sin(r) / s

    A tilted camera sees (u, v, 1) ~ H (x, y, 1). Centre, scale and rotation are then those of H at the dish's centre.

    Args:
        images: of one size, BGR or grey, uint8.
        dish_diameter: inner diameter of the dish [m].
        spacing: of the markers' centres along the square's side [m].
        side: of a marker [m].

    Raises:
        InvalidInputError: no images, images of different sizes, a marker that no image shows, markers that
            differ from frame to frame, corners that no overhead camera sees so, or OpenCV is older than 4.7.
    """
    _check_images(images)
    if not hasattr(cv2, "aruco") or not hasattr(cv2.aruco, "ArucoDetector"):
        expected = "OpenCV 4.7 or newer, which is needed for markers"
        raise InvalidInputError("markers", f"OpenCV {cv2.__version__}", expected)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters)
    seen: dict[int, list[np.ndarray]] = {index: [] for index in range(4)}
    for image in images:
        corners, ids, _ = detector.detectMarkers(measured_channel(image))
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
    homography = None
    # Beyond 0.3 px, and beyond twice the residual of a homography, the camera is tilted.
    tilted = _homography(points, pixels) if residual > 0.3 else None
    if tilted is not None and tilted[2] < 0.5 * residual:
        view, homography, residual = tilted
    if residual > MAX_RESIDUAL_PX:
        expected = f"at most {MAX_RESIDUAL_PX} px, from a camera above markers at these distances"
        raise InvalidInputError("frames", f"marker corners off by {residual:.2f} px", expected)
    return Calibration(view, len(images), residual, scatter, dish_diameter, homography)


def _check_scatter(what: str, scatter_px: float) -> None:
    """Refuse frames between which the camera moved."""
    if scatter_px > MAX_SCATTER_PX:
        expected = f"a camera that stands still: at most {MAX_SCATTER_PX} px"
        raise InvalidInputError("frames", f"{what} that differ by {scatter_px:.2f} px", expected)


def _similarity(points: np.ndarray, pixels: np.ndarray) -> tuple[DishView, float]:
    """Return the view that takes points to pixels best, and the root of the mean square error [px]."""
    x, y = points.T
    one, none = np.ones(len(x)), np.zeros(len(x))
    system = np.vstack([np.column_stack([one, none, x, -y]), np.column_stack([none, one, -y, -x])])
    values, *_ = np.linalg.lstsq(system, pixels.T.ravel(), rcond=None)
    u, v, a, b = (float(value) for value in values)
    view = DishView((u, v), 1.0 / float(np.hypot(a, b)), float(np.arctan2(b, a)))
    return view, float(np.sqrt(np.mean(np.sum((view.to_pixels(points) - pixels) ** 2, axis=1))))


def _homography(points: np.ndarray, pixels: np.ndarray) -> tuple[DishView, np.ndarray, float] | None:
    """Return the view at the dish's centre, what straightens a frame, and the root of the mean square error [px].

    None where the camera would be tilted by more than 35 degrees, by the ratio of the scales at the centre.
    """
    seen, _ = cv2.findHomography(points / np.abs(points).max(), pixels)
    if seen is None or abs(seen[2, 2]) < 1e-9:
        return None
    seen = seen @ np.diag([1.0 / np.abs(points).max(), 1.0 / np.abs(points).max(), 1.0])
    centre = seen[:2, 2] / seen[2, 2]
    slope = (seen[:2, :2] - np.outer(centre, seen[2, :2])) / seen[2, 2]
    u, scales, v = np.linalg.svd(slope * ((1.0,), (-1.0,)))  # image v goes down
    turn = u @ v
    if np.linalg.det(turn) < 0.0 or scales[1] < math.cos(math.radians(35.0)) * scales[0]:
        return None
    rotation = math.atan2(turn[1, 0], turn[0, 0])
    view = DishView((float(centre[0]), float(centre[1])), 1.0 / math.sqrt(scales[0] * scales[1]), rotation)
    a, b = math.cos(rotation) / view.metres_per_pixel, math.sin(rotation) / view.metres_per_pixel
    straight = np.array([[a, -b, centre[0]], [-b, -a, centre[1]], [0.0, 0.0, 1.0]])
    found = np.column_stack([points, np.ones(len(points))]) @ seen.T
    residual = float(np.sqrt(np.mean(np.sum((found[:, :2] / found[:, 2:] - pixels) ** 2, axis=1))))
    homography = straight @ np.linalg.inv(seen)
    return view, homography / homography[2, 2], residual


def _check_images(images: Sequence[np.ndarray]) -> None:
    """Refuse what are no images of one size."""
    for image in images:
        check_image(image)
    sizes = sorted({image.shape[1::-1] for image in images})
    if len(sizes) != 1:
        given = " and ".join(f"{wide} x {high}" for wide, high in sizes) or "none"
        raise InvalidInputError("frames", given, "frames of one size")
