"""Between messages and the core's own types: pure functions, nothing else."""

from __future__ import annotations

import struct

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    TwistStamped,
    Vector3,
)
from magnetosuture_msgs.msg import TrackerState
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.orientation import (
    heading_angle,
    heading_from_quaternion,
    round_trip_heading,
    yaw_quaternion,
)
from magnetosuture_thread.interface import DISH_FRAME, NEEDLE_POSE
from magnetosuture_thread.model.predictor import NeedlePose
from magnetosuture_thread.vision.look import State, Track

_IN_PLANE = (0, 1, 5)  # x, y and the turn about z among ROS's six coordinates of a pose


def nanoseconds(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def stamp_of(nanoseconds: int) -> Time:
    """Return a time in nanoseconds as a stamp."""
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def checked_nanoseconds(stamp: Time, field: str) -> int:
    """Return a stamp in nanoseconds, or refuse one with a second's or more beside its seconds."""
    if stamp.nanosec >= 1_000_000_000:
        raise InvalidInputError(f"{field}.header.stamp.nanosec", stamp.nanosec, "less than a second's")
    return nanoseconds(stamp)


def seconds(stamp: Time) -> float:
    """Return a stamp in seconds."""
    return nanoseconds(stamp) * 1e-9


def header_stamp(data: bytes) -> int | None:
    """Return the stamp of a serialised message that begins with a header [ns]; None if it is too short."""
    if len(data) < 12:
        return None
    whole, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)  # behind what begins all CDR
    return int(whole) * 1_000_000_000 + int(nanoseconds)


def header(stamp: Time) -> Header:
    """Return a header in the dish frame."""
    return Header(stamp=stamp, frame_id=DISH_FRAME)


def require_dish_frame(frame: str, field: str) -> None:
    """Refuse a message in another frame than the dish's."""
    if frame != DISH_FRAME:
        raise InvalidInputError(f"{field}.header.frame_id", repr(frame), repr(DISH_FRAME))


def pose_message(
    stamp: Time, tail: np.ndarray, heading: np.ndarray, covariance: np.ndarray | None = None
) -> PoseWithCovarianceStamped:
    """Return the needle's pose: position of the tail, x axis along the needle there.

    Args:
        stamp: of the frame that it was measured in.
        tail: shape (2,) [m].
        heading: unit vector, shape (2,).
        covariance: of x, y [m] and the angle of the heading [rad], shape (3, 3); zeros, which say in ROS
            that it is not known, if None.
    """
    message = PoseWithCovarianceStamped(header=header(stamp))
    message.pose.pose = flat_pose(tail, heading_angle(heading))
    if covariance is not None:
        whole = np.zeros((6, 6))
        whole[np.ix_(_IN_PLANE, _IN_PLANE)] = covariance
        message.pose.covariance = whole.ravel()
    return message


def tracker_state(stamp: Time, track: Track, processing_time: float) -> TrackerState:
    """Return what the tracker makes of a frame; `processing_time` is the wall-clock time it took [s]."""
    numbers = {
        State.SEARCHING: TrackerState.STATE_SEARCHING,
        State.TRACKED: TrackerState.STATE_TRACKED,
        State.LOST: TrackerState.STATE_LOST,
    }
    message = TrackerState(header=header(stamp), state=numbers[track.state], reason=track.reason)
    message.processing_time = processing_time
    if track.view is not None:
        message.dish_centre = [float(pixels) for pixels in track.view.centre_px]
        message.metres_per_pixel = float(track.view.metres_per_pixel)
        message.camera_rotation = float(track.view.rotation)
    if track.state is State.TRACKED:
        message.confidence = float(track.confidence)
        message.curvature = float(track.curvature)
    return message


def placed(stamp: Time, point: np.ndarray, angle: float) -> PoseStamped:
    """Return a pose in the dish plane that has no uncertainty: a truth, or a wish."""
    return PoseStamped(header=header(stamp), pose=flat_pose(point, angle))


def needle_pose(message: PoseWithCovarianceStamped) -> NeedlePose:
    """Return the needle's pose in the plane.

    Raises:
        InvalidInputError: wrong frame, no stamp, or no unit quaternion.
    """
    require_dish_frame(message.header.frame_id, NEEDLE_POSE.name)
    stamp = message.header.stamp
    checked_nanoseconds(stamp, NEEDLE_POSE.name)  # the prediction could not be stamped by another
    position, q = message.pose.pose.position, message.pose.pose.orientation
    heading = heading_from_quaternion(q.x, q.y, q.z, q.w, f"{NEEDLE_POSE.name}.pose.orientation")
    return NeedlePose(seconds(stamp), np.array([position.x, position.y]), heading)


def pose_covariance(message: PoseWithCovarianceStamped) -> np.ndarray | None:
    """Return the covariance of x, y [m] and the heading's angle [rad], shape (3, 3); None for zeros, as for unknown.

    Raises:
        InvalidInputError: it is not finite, or a variance is negative.
    """
    whole = np.asarray(message.pose.covariance).reshape(6, 6)
    if not whole.any():
        return None
    covariance = whole[np.ix_(_IN_PLANE, _IN_PLANE)]
    if not np.isfinite(covariance).all() or (np.diag(covariance) < 0.0).any():
        diagonal = np.diag(covariance).tolist()
        raise InvalidInputError("needle/measured_cp.pose.covariance", diagonal, "finite variances of at least 0")
    return covariance


def tracked_pose(stamp: Time, tail: np.ndarray, heading: np.ndarray) -> NeedlePose:
    """Return a needle's pose as `needle_pose` returns it of its message, to the last bit.

    Raises:
        InvalidInputError: no stamp.
    """
    checked_nanoseconds(stamp, NEEDLE_POSE.name)
    along = round_trip_heading(heading, f"{NEEDLE_POSE.name}.pose.orientation")
    return NeedlePose(seconds(stamp), np.array([float(tail[0]), float(tail[1])]), along)


class PathMaker:
    """Makes paths, from one to the next in the same message: most of a new one's time is its hundred poses.

    A message is good until the next is made.
    """

    def __init__(self) -> None:
        self._message = Path(header=header(Time()))
        self._spare: list[PoseStamped] = []

    def message(self, stamp: Time, points: np.ndarray) -> Path:
        """Return a polyline of shape (m, 2) as a path."""
        shared = self._message.header
        shared.stamp = stamp
        while len(self._spare) < len(points):
            self._spare.append(PoseStamped(header=shared))
        poses = self._spare[: len(points)]
        for pose, (x, y) in zip(poses, points.tolist(), strict=True):
            position = pose.pose.position
            position.x, position.y = x, y
        self._message.poses = poses
        return self._message


def path_points(message: Path) -> np.ndarray:
    """Return a path as an array of shape (m, 2).

    Raises:
        InvalidInputError: wrong frame.
    """
    require_dish_frame(message.header.frame_id, "thread/measured")
    return np.array([[p.pose.position.x, p.pose.position.y] for p in message.poses]).reshape(-1, 2)


def plane_velocity(message: TwistStamped, field: str) -> np.ndarray:
    """Return a velocity in the dish plane, shape (2,) [m/s].

    Raises:
        InvalidInputError: wrong frame, or a motion that the needle cannot make: out of the plane, or a turn
            apart from that which the tip's velocity amounts to.
    """
    require_dish_frame(message.header.frame_id, field)
    linear, angular = message.twist.linear, message.twist.angular
    others = [linear.z, angular.x, angular.y, angular.z]
    if any(value != 0.0 for value in others):
        raise InvalidInputError(f"{field}.twist", f"linear.z, angular = {others}", "zeros: x and y alone count")
    return np.array([linear.x, linear.y])


def serialised_velocity(data: bytes) -> np.ndarray:
    """Return the velocity of a serialised stamped twist, shape (2,) [m/s]."""
    linear = deserialize_message(data, TwistStamped).twist.linear
    return np.array([linear.x, linear.y])


def vector(velocity: np.ndarray) -> Vector3:
    """Return a velocity of shape (2,) [m/s] as a vector."""
    return Vector3(x=float(velocity[0]), y=float(velocity[1]))


def twist_message(stamp: Time, velocity: np.ndarray) -> TwistStamped:
    """Return a velocity of shape (2,) [m/s] as a stamped twist."""
    message = TwistStamped(header=header(stamp))
    message.twist.linear = vector(velocity)
    return message


def flat_pose(point: np.ndarray, angle: float) -> Pose:
    """Return a pose in the dish plane: a point of shape (2,) [m] and an angle from the x axis on [rad]."""
    z, w = yaw_quaternion(angle)
    return Pose(position=Point(x=float(point[0]), y=float(point[1])), orientation=Quaternion(z=z, w=w))


def point_list(vertices: np.ndarray) -> list[Point]:
    """Return points of shape (m, 2) [m] as a message has them."""
    return [Point(x=x, y=y) for x, y in vertices.tolist()]
