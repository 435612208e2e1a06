"""Builds messages as objects, for the conversion of messages that others have recorded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.interface import MEASURED_THREAD, NEEDLE_COMMAND, NEEDLE_POSE, TIP_SETPOINT

Vector = NDArray[np.float64]


class MessageBuilder:
    """Builds messages.

    Args:
        make: called with the name of a type, for example `nav_msgs/msg/Path`, and fields by name; returns the
            message, with zeros, or nothing, in fields that are not named.
    """

    def __init__(self, make: Callable[..., Any]) -> None:
        self.make = make

    def header(self, stamp: Any, frame: str) -> Any:
        """Return a header; the stamp is nanoseconds, or a time message of any library."""
        whole, rest = divmod(stamp, 10**9) if isinstance(stamp, int) else (stamp.sec, stamp.nanosec)
        time = self.make("builtin_interfaces/msg/Time", sec=whole, nanosec=rest)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def vector(self, x: float, y: float, z: float) -> Any:
        """Return a vector."""
        return self.make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def pose(self, position: Sequence[float] | Vector, orientation: Sequence[float] | Vector) -> Any:
        """Return a pose of a position in space [m] and a quaternion x, y, z, w."""
        place = self.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, position), strict=True)))
        turn = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, orientation), strict=True)))
        return self.make("geometry_msgs/msg/Pose", position=place, orientation=turn)

    def pose_stamped(self, header: Any, pose: Any) -> Any:
        """Return a PoseStamped."""
        return self.make(TIP_SETPOINT.type_name, header=header, pose=pose)

    def pose_with_covariance(self, header: Any, pose: Any, covariance: Vector) -> Any:
        """Return a PoseWithCovarianceStamped; the covariance of shape (36,)."""
        held = self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        return self.make(NEEDLE_POSE.type_name, header=header, pose=held)

    def path(self, header: Any, poses: Sequence[Any]) -> Any:
        """Return a Path of poses."""
        return self.make(MEASURED_THREAD.type_name, header=header, poses=[self.pose_stamped(header, p) for p in poses])

    def twist(self, linear: Any, angular: Any) -> Any:
        """Return a Twist of two vectors."""
        return self.make("geometry_msgs/msg/Twist", linear=linear, angular=angular)

    def twist_stamped(self, header: Any, twist: Any) -> Any:
        """Return a TwistStamped."""
        return self.make(NEEDLE_COMMAND.type_name, header=header, twist=twist)
