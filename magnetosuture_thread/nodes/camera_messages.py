"""Camera frames as messages: pure functions, nothing else."""

from __future__ import annotations

from array import array

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.interface import CAMERA_FRAME


def compressed_image(stamp: Time, data: np.ndarray) -> CompressedImage:
    """Return a JPEG file's bytes, shape (bytes,), as a message."""
    message = CompressedImage(format="bgr8; jpeg compressed bgr8")
    message.header = Header(stamp=stamp, frame_id=CAMERA_FRAME)
    message.data = array("B", data.tobytes())  # of another type each byte would be checked for itself
    return message


def image(stamp: Time, pixels: np.ndarray) -> Image:
    """Return a BGR image of shape (height, width, 3) as a message."""
    height, width = pixels.shape[:2]
    message = Image(height=height, width=width, step=3 * width, encoding="bgr8")
    message.header = Header(stamp=stamp, frame_id=CAMERA_FRAME)
    message.data = array("B", pixels.tobytes())
    return message


def camera_info(stamp: Time, size: tuple[int, int], view: DishView, distance: float) -> CameraInfo:
    """Return the intrinsics of a camera that looks straight down from a distance [m]."""
    matrix = view.intrinsics(distance)
    message = CameraInfo(width=size[0], height=size[1], distortion_model="plumb_bob", d=[0.0] * 5)
    message.header = Header(stamp=stamp, frame_id=CAMERA_FRAME)
    message.k = matrix.ravel().tolist()
    message.r = np.eye(3).ravel().tolist()
    message.p = np.column_stack([matrix, np.zeros(3)]).ravel().tolist()
    return message
