"""Messages as the nodes publish them, made without ROS: what a bag gets in which no node had a part."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.geometry.orientation import heading_angle, yaw_quaternion
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import (
    DISH_FRAME,
    NEEDLE_POSE,
    SEEN_THREAD,
    TRACKER_STATE,
)
from magnetosuture_thread.vision.look import State, Track

_IN_PLANE = (0, 1, 5)  # x, y and the turn about z among ROS's six coordinates of a pose
_STATES = {State.SEARCHING: 0, State.TRACKED: 1, State.LOST: 2}  # as in TrackerState.msg


def make(type_name: str, **fields: Any) -> Any:
    """Return a message of the bags' type store."""
    return typestore().types[type_name](**fields)


def header(stamp: int, frame: str = DISH_FRAME) -> Any:
    """Return a header of a time [ns]."""
    time = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def placed(stamp: int, point: NDArray[np.float64], angle: float) -> Any:
    """Return a pose in the dish plane that has no uncertainty."""
    return make("geometry_msgs/msg/PoseStamped", header=header(stamp), pose=_pose(point, angle))


def pose_message(
    stamp: int, tail: NDArray[np.float64], heading: NDArray[np.float64], covariance: NDArray[np.float64] | None
) -> Any:
    """Return the needle's pose; the covariance, of x, y and the heading's angle, is zero where it is not known."""
    whole = np.zeros((6, 6))
    if covariance is not None:
        whole[np.ix_(_IN_PLANE, _IN_PLANE)] = covariance
    pose = make(
        "geometry_msgs/msg/PoseWithCovariance", pose=_pose(tail, heading_angle(heading)), covariance=whole.ravel()
    )
    return make(NEEDLE_POSE.type_name, header=header(stamp), pose=pose)


def path_message(stamp: int, points: Points) -> Any:
    """Return a polyline of shape (m, 2) as a path."""
    shared = header(stamp)
    poses = [make("geometry_msgs/msg/PoseStamped", header=shared, pose=_pose(point, 0.0)) for point in points]
    return make(SEEN_THREAD.type_name, header=shared, poses=poses)


def tracker_state(stamp: int, track: Track) -> Any:
    """Return what the tracker makes of a frame; how long it took is no property of the frame, and told as 0."""
    found, view = track.state is State.TRACKED, track.view
    return make(
        TRACKER_STATE.type_name,
        header=header(stamp),
        state=_STATES[track.state],
        reason=track.reason,
        confidence=float(track.confidence) if found else 0.0,
        curvature=float(track.curvature) if found else 0.0,
        processing_time=0.0,
        dish_centre=np.array(view.centre_px if view else (), dtype=np.float64),
        metres_per_pixel=view.metres_per_pixel if view else 0.0,
        camera_rotation=view.rotation if view else 0.0,
    )


def _pose(point: NDArray[np.float64], angle: float) -> Any:
    position = make("geometry_msgs/msg/Point", x=float(point[0]), y=float(point[1]), z=0.0)
    z, w = yaw_quaternion(angle)
    quaternion = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)
    return make("geometry_msgs/msg/Pose", position=position, orientation=quaternion)
