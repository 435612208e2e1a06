"""Packs needle poses and polylines as CDR bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.orientation import heading_angle, yaw_quaternion
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.packing.layout import BEGIN, DISH, HEADER, REAL, Time, form

_IN_PLANE = (0, 1, 5)  # x, y and the turn about z among ROS's six coordinates of a pose
_PLACES = [6 * row + column for row in _IN_PLANE for column in _IN_PLANE]
_POSE = form(*HEADER, *"d" * 7, *"d" * 36)
_PATH = form(*HEADER, "I")
# One PoseStamped of a path begins at a multiple of 8, as the next does.
_STAMPED = np.dtype(
    {
        "names": ["sec", "nanosec", "length", "frame", "x", "y", "w"],
        "formats": ["<i4", "<u4", "<u4", f"S{DISH[0]}", REAL, REAL, REAL],
        "offsets": [0, 4, 8, 12, 24, 32, 72],
        "itemsize": 80,
    }
)


def packed_pose(
    time: Time, tail: NDArray[np.float64], heading: NDArray[np.float64], covariance: NDArray[np.float64] | None = None
) -> bytes:
    """Return the needle's pose, a PoseWithCovarianceStamped: position of the tail, x axis along the needle there.

    Args:
        time: of the frame that it was measured in, seconds and nanoseconds.
        tail: shape (2,) [m].
        heading: unit vector, shape (2,).
        covariance: of x, y [m] and the angle of the heading [rad], shape (3, 3); zeros, which say in ROS
            that it is not known, if None.
    """
    whole = [0.0] * 36
    if covariance is not None:
        for place, value in zip(_PLACES, covariance.ravel().tolist(), strict=True):
            whole[place] = value
    z, w = yaw_quaternion(heading_angle(heading))
    return BEGIN + _POSE.pack(*time, *DISH, tail[0], tail[1], 0.0, 0.0, 0.0, z, w, *whole)


def packed_path(time: Time, points: Points) -> bytes:
    """Return a polyline of shape (m, 2) [m] as a Path.

    Args:
        time: seconds and nanoseconds.
        points: of the polyline.
    """
    poses = np.zeros(len(points), _STAMPED)
    poses["sec"], poses["nanosec"] = time
    poses["length"], poses["frame"] = DISH
    poses["x"], poses["y"], poses["w"] = points[:, 0], points[:, 1], 1.0
    return BEGIN + _PATH.pack(*time, *DISH, len(points)) + poses.tobytes()
