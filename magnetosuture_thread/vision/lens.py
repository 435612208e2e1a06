"""A lens by its camera_info, and frames without its distortion."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.files import BudgetError, check_yaml, read_regular

COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
ALIASES = {
    **dict.fromkeys(("pinhole", "radtan", "radial_tangential", "brown_conrady"), "plumb_bob"),
    **dict.fromkeys(("fisheye", "equi", "kannala_brandt", "kannala_brandt4", "kb4"), "equidistant"),
    "none": "",
}
MAX_SIDE_PX = 65536
GRID = 33  # points along each side at which a lens is checked


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a camera, as in sensor_msgs/CameraInfo.

    Attributes:
        size: width and height of the frames [px].
        model: plumb_bob, rational_polynomial or equidistant.
        coefficients: of the distortion, in OpenCV's order.
        matrix: K, nine numbers by rows [px].

    Raises:
        InvalidInputError: they are those of no camera, or of one whose distortion cannot be undone in its frame.
    """

    size: tuple[int, int]
    model: str
    coefficients: tuple[float, ...]
    matrix: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check that it is a lens whose distortion can be undone."""
        if not (0 < self.size[0] <= MAX_SIDE_PX and 0 < self.size[1] <= MAX_SIDE_PX):
            raise InvalidInputError("camera_info.width", f"{self.size[0]} x {self.size[1]} pixels", "the frames' size")
        if len(self.matrix) != 9 or not np.isfinite(self.matrix).all():
            raise InvalidInputError("camera_info.k", str(self.matrix)[:100], "nine finite numbers")
        focal = self.matrix[0], self.matrix[4]
        if min(focal) <= 0.0 or self.matrix[6:] != (0.0, 0.0, 1.0):
            given = f"focal lengths {focal[0]:g}, {focal[1]:g} px"
            raise InvalidInputError("camera_info.k", given, "above 0, of a camera that is calibrated")
        if not np.isfinite(self.coefficients).all():
            raise InvalidInputError("camera_info.d", str(self.coefficients)[:100], "finite numbers")
        if self.is_straight:
            return  # also a model of no name, as of cameras that have none
        lengths = COEFFICIENTS.get(self.model)
        if lengths is None:
            raise InvalidInputError("camera_info.distortion_model", repr(self.model[:40]), ", ".join(COEFFICIENTS))
        if len(self.coefficients) not in lengths:
            expected = f"{' or '.join(map(str, lengths))} of {self.model}"
            raise InvalidInputError("camera_info.d", f"{len(self.coefficients)} coefficients", expected)
        # Where a small image of the frame shows its own pixels, in order and less than half of the frame away.
        u, v = self.maps((GRID, GRID), np.array(self.size) / GRID, cv2.CV_32FC1)
        shift = np.hypot(u - np.arange(GRID), v - np.arange(GRID)[:, None]).max()
        (down_u, across_u), (down_v, across_v) = np.gradient(u), np.gradient(v)
        folded = min(across_u.min(), down_v.min(), (across_u * down_v - down_u * across_v).min()) <= 0.0
        if not np.isfinite(shift) or shift > 0.5 * math.sqrt(2.0) * GRID or folded:
            given = f"{self.model} with coefficients up to {np.abs(self.coefficients).max():g}"
            raise InvalidInputError("camera_info.d", given, "a distortion that can be undone over the whole frame")

    @property
    def is_straight(self) -> bool:
        """Whether it has no distortion; an equidistant lens without coefficients bends straight lines too."""
        return not any(self.coefficients) and self.model in ("", *COEFFICIENTS) and self.model != "equidistant"

    def problem_with(self, shape: tuple[int, ...]) -> InvalidInputError | None:
        """Return why frames of a shape (rows, columns) are not of this camera; None if they are."""
        if tuple(shape[1::-1]) == self.size:
            return None
        given = f"{self.size[0]} x {self.size[1]} pixels"
        return InvalidInputError("camera_info.width", given, f"the frames' {shape[1]} x {shape[0]}")

    def undistorted(self, image: np.ndarray, factor: int = 1) -> np.ndarray:
        """Return a frame, shrunk by a factor, as a pinhole camera with the same K sees it; itself if it is straight."""
        if self.is_straight:
            return image
        at, parts = _undistortion(self, image.shape[1::-1], factor)
        return np.asarray(cv2.remap(image, at, parts, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def maps(self, size: tuple[int, int], factor: np.ndarray, kind: int) -> tuple[np.ndarray, np.ndarray]:
        """Return where the lens shows what a pinhole camera sees, in an image shrunk by factors in u and v."""
        scaling = np.diag([*(1.0 / factor), 1.0])
        scaling[:2, 2] = 0.5 / factor - 0.5  # the frame's corner is that of the image
        matrix, none = scaling @ np.reshape(self.matrix, (3, 3)), np.eye(3)
        coefficients = np.array(self.coefficients)
        if self.model == "equidistant":
            return cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, none, matrix, size, kind)
        return cv2.initUndistortRectifyMap(matrix, coefficients, none, matrix, size, kind)


@lru_cache(maxsize=2)  # of a camera; as large as its frames
def _undistortion(lens: Lens, size: tuple[int, int], factor: int) -> tuple[np.ndarray, np.ndarray]:
    return lens.maps(size, np.full(2, float(factor)), cv2.CV_16SC2)


def lens_of(message: Any) -> Lens:
    """Return the lens of a sensor_msgs/CameraInfo.

    Raises:
        InvalidInputError: see `Lens`; or it is binned or a region of interest, which is not supported.
    """
    if message.binning_x > 1 or message.binning_y > 1:
        given = f"{message.binning_x} x {message.binning_y}"
        raise InvalidInputError("camera_info.binning", given, "0 or 1: frames of the size that was calibrated")
    coefficients, matrix = tuple(map(float, message.d)), tuple(map(float, message.k))
    model = _model(message.distortion_model, "", len(coefficients))
    return Lens((int(message.width), int(message.height)), model, coefficients, matrix)


def _model(distortion: str, camera: str, count: int) -> str:
    """Return the model of a number of coefficients by its name and that of the camera's, either of which may be empty.

    Raises:
        InvalidInputError: they contradict each other.
    """
    names = [re.sub("[- ]", "_", name.strip().lower()) for name in (distortion, camera)]
    own, whole = (ALIASES.get(name, name) for name in names)
    if own and whole not in ("", "plumb_bob", own):
        raise InvalidInputError("camera_model", camera, f"that of distortion_model, which is {distortion}")
    model = own or whole
    # Each begins with the coefficients of the one before.
    return "rational_polynomial" if model == "plumb_bob" and count > 5 else model


def read_lens(path: Path) -> Lens:
    """Read a camera's calibration, a YAML file as ROS's `camera_calibration_parsers` writes it, or with `camera_model`.

    Raises:
        InvalidInputError: it cannot be read, is no such file, or see `Lens`.
    """
    try:
        text = read_regular(path, 1 << 16).decode()
        check_yaml(text)
        content = yaml.load(text, yaml.CSafeLoader)
        matrix, coefficients = (content[key]["data"] for key in ("camera_matrix", "distortion_coefficients"))
        size = int(content["image_width"]), int(content["image_height"])
        distortion, camera = (str(content.get(key) or "") for key in ("distortion_model", "camera_model"))
        model = _model(distortion, camera, len(coefficients))
        return Lens(size, model, tuple(map(float, coefficients)), tuple(map(float, matrix)))
    except OSError as error:
        raise InvalidInputError(str(path), f"{error.strerror}", "a camera's calibration") from None
    except (BudgetError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        given = f"{type(error).__name__}: {str(error).splitlines()[0][:60] if str(error) else ''}"
        expected = "image_width, image_height, camera_matrix, distortion_model and distortion_coefficients"
        raise InvalidInputError(str(path), given, expected) from None
