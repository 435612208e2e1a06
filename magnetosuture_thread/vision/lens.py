"""A lens by its camera_info, and frames without its distortion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.files import read_regular
from magnetosuture_thread.untrusted import BudgetError, check_yaml

COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
MAX_SIDE_PX = 65536
GRID = 33  # points along each side at which a lens is checked


class Lens:
    """The intrinsics of a camera, as in sensor_msgs/CameraInfo.

    Args:
        size: width and height of the frames [px].
        model: plumb_bob, rational_polynomial or equidistant.
        coefficients: of the distortion, in OpenCV's order.
        matrix: K, nine numbers by rows [px].

    Raises:
        InvalidInputError: they are those of no camera, or of one whose distortion cannot be undone in its frame.
    """

    def __init__(
        self,
        size: tuple[int, int],
        model: str,
        coefficients: Sequence[float] | np.ndarray,
        matrix: Sequence[float] | np.ndarray,
    ) -> None:
        self.size = int(size[0]), int(size[1])
        self.model = str(model)
        self.coefficients = np.array(coefficients, dtype=float).ravel()
        self.matrix: np.ndarray = np.array(matrix, dtype=float).ravel()
        self._maps: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._check()

    def _check(self) -> None:
        name = "camera_info"
        if not (0 < self.size[0] <= MAX_SIDE_PX and 0 < self.size[1] <= MAX_SIDE_PX):
            raise InvalidInputError(f"{name}.width", f"{self.size[0]} x {self.size[1]} pixels", "the frames' size")
        if self.matrix.size != 9 or not np.isfinite(self.matrix).all():
            raise InvalidInputError(f"{name}.k", str(self.matrix.tolist())[:100], "nine finite numbers")
        self.matrix = self.matrix.reshape(3, 3)
        focal = self.matrix[0, 0], self.matrix[1, 1]
        if min(focal) <= 0.0 or not np.array_equal(self.matrix[2], (0.0, 0.0, 1.0)):
            given = f"focal lengths {focal[0]:g}, {focal[1]:g} px"
            raise InvalidInputError(f"{name}.k", given, "above 0, of a camera that is calibrated")
        if not np.isfinite(self.coefficients).all():
            raise InvalidInputError(f"{name}.d", str(self.coefficients.tolist())[:100], "finite numbers")
        if not self.coefficients.any():
            return  # also a model of no name, as of cameras that have none
        lengths = COEFFICIENTS.get(self.model)
        if lengths is None:
            raise InvalidInputError(f"{name}.distortion_model", repr(self.model[:40]), ", ".join(COEFFICIENTS))
        if self.coefficients.size not in lengths:
            expected = f"{' or '.join(map(str, lengths))} of {self.model}"
            raise InvalidInputError(f"{name}.d", f"{self.coefficients.size} coefficients", expected)
        u, v = self._distorted(*(np.linspace(0.0, side - 1.0, GRID) for side in self.size))
        diagonal = float(np.hypot(*self.size))
        regular = np.meshgrid(*(np.linspace(0.0, side - 1.0, GRID) for side in self.size))
        shift = np.hypot(u - regular[0], v - regular[1]).max()
        du, dv = np.gradient(u), np.gradient(v)
        turned = (du[1] * dv[0] - du[0] * dv[1]).min() <= 0.0 or min(du[1].min(), dv[0].min()) <= 0.0
        if not np.isfinite(shift) or shift > 0.5 * diagonal or turned:
            given = f"{self.model} with coefficients up to {np.abs(self.coefficients).max():g}"
            raise InvalidInputError(f"{name}.d", given, "a distortion that can be undone over the whole frame")

    @property
    def is_straight(self) -> bool:
        """Whether it has no distortion."""
        return not self.coefficients.any()

    def same_as(self, other: Lens | None) -> bool:
        """Say whether another lens is this one."""
        return (
            other is not None
            and (self.size, self.model) == (other.size, other.model)
            and np.array_equal(self.coefficients, other.coefficients)
            and np.array_equal(self.matrix, other.matrix)
        )

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
        if factor not in self._maps:
            rows, columns = image.shape[:2]
            shift = 0.5 * (factor - 1.0)
            u, v = self._distorted(np.arange(columns) * factor + shift, np.arange(rows) * factor + shift)
            maps = ((u - shift) / factor).astype(np.float32), ((v - shift) / factor).astype(np.float32)
            self._maps = {factor: cv2.convertMaps(*maps, cv2.CV_16SC2)}
        at, parts = self._maps[factor]
        return np.asarray(cv2.remap(image, at, parts, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def _distorted(self, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the lens shows what a pinhole camera sees at columns and rows, both of shape (rows, columns)."""
        u, v = np.meshgrid(columns.astype(float), rows.astype(float))
        pixels = np.column_stack([u.ravel(), v.ravel(), np.ones(u.size)])
        x, y = (pixels @ np.linalg.inv(self.matrix).T).T[:2]
        if self.model == "equidistant":
            points = np.column_stack([x, y])[None]
            seen = cv2.fisheye.distortPoints(points, self.matrix, self.coefficients)[0]
        else:
            points = np.column_stack([x, y, np.ones(x.size)])
            seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, self.coefficients)[0][:, 0]
        return seen[:, 0].reshape(u.shape), seen[:, 1].reshape(u.shape)


def lens_of(message: Any) -> Lens:
    """Return the lens of a sensor_msgs/CameraInfo.

    Raises:
        InvalidInputError: see `Lens`; or it is binned or a region of interest, which is not supported.
    """
    if message.binning_x > 1 or message.binning_y > 1:
        given = f"{message.binning_x} x {message.binning_y}"
        raise InvalidInputError("camera_info.binning", given, "0 or 1: frames of the size that was calibrated")
    return Lens((message.width, message.height), message.distortion_model, message.d, message.k)


def read_lens(path: Path) -> Lens:
    """Read a camera's calibration, a YAML file as ROS's `camera_calibration_parsers` writes it.

    Raises:
        InvalidInputError: it cannot be read, is no such file, or see `Lens`.
    """
    try:
        text = read_regular(path, 1 << 16).decode()
        check_yaml(text)
        content = yaml.load(text, yaml.CSafeLoader)
        matrix, coefficients = (content[key]["data"] for key in ("camera_matrix", "distortion_coefficients"))
        size = int(content["image_width"]), int(content["image_height"])
        model = content.get("distortion_model", "plumb_bob")
        return Lens(size, model, [float(value) for value in coefficients], [float(value) for value in matrix])
    except OSError as error:
        raise InvalidInputError(str(path), f"{error.strerror}", "a camera's calibration") from None
    except (BudgetError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        given = f"{type(error).__name__}: {str(error).splitlines()[0][:60] if str(error) else ''}"
        expected = "image_width, image_height, camera_matrix, distortion_model and distortion_coefficients"
        raise InvalidInputError(str(path), given, expected) from None
