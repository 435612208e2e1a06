"""Between messages and the core's own types: pure functions, nothing else."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

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
from magnetosuture_msgs.msg import BarrierMargin, PredictedThread, SafetyMargins, TrackerState
from nav_msgs.msg import Path
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon, triangulate
from magnetosuture_thread.interface import DISH_FRAME
from magnetosuture_thread.model.predictor import NeedlePose, Prediction
from magnetosuture_thread.vision.look import State, Track

_IN_PLANE = (0, 1, 5)  # x, y and the turn about z among ROS's six coordinates of a pose
FULL_COLOUR_CLEARANCE = 1e-3  # m; markers turn from green to red over this


def seconds(stamp: Time) -> float:
    """Return a stamp in seconds."""
    return (stamp.sec * 1_000_000_000 + stamp.nanosec) * 1e-9


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
    message.pose.pose = _pose(tail, math.atan2(heading[1], heading[0]))
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
    if track.state is State.TRACKED:
        message.confidence = float(track.confidence)
        message.curvature = float(track.curvature)
    return message


def placed(stamp: Time, point: np.ndarray, angle: float) -> PoseStamped:
    """Return a pose in the dish plane that has no uncertainty: a truth, or a wish."""
    return PoseStamped(header=header(stamp), pose=_pose(point, angle))


def needle_pose(message: PoseWithCovarianceStamped) -> NeedlePose:
    """Return the needle's pose in the plane.

    Raises:
        InvalidInputError: wrong frame, not finite, or no unit quaternion.
    """
    require_dish_frame(message.header.frame_id, "needle/measured_cp")
    position, q = message.pose.pose.position, message.pose.pose.orientation
    tail = np.array([position.x, position.y])
    # Not by squares: Python raises an error for those of what a hostile message may hold.
    size = math.hypot(q.x, q.y, q.z, q.w)
    if not abs(size - 1.0) < 1e-3:
        raise InvalidInputError("needle/measured_cp.pose.orientation", f"norm {size:g}", "a unit quaternion")
    along = np.array([1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.w * q.z)])
    length = float(np.linalg.norm(along))
    if length < 1e-3:
        raise InvalidInputError(
            "needle/measured_cp.pose.orientation", "an upright needle", "an x axis in the dish plane"
        )
    return NeedlePose(seconds(message.header.stamp), tail, along / length)


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


def twist_message(stamp: Time, velocity: np.ndarray) -> TwistStamped:
    """Return a velocity of shape (2,) [m/s] as a stamped twist."""
    message = TwistStamped(header=header(stamp))
    message.twist.linear = Vector3(x=float(velocity[0]), y=float(velocity[1]))
    return message


def prediction_message(stamp: Time, prediction: Prediction, material: str, step_time: float) -> PredictedThread:
    """Return a predicted thread; `step_time` is the wall-clock time it took [s]."""
    return PredictedThread(
        header=header(stamp),
        formulation=prediction.formulation,
        material=material,
        vertices=_points(prediction.vertices),
        stretch=prediction.stretch.tolist(),
        solver=prediction.solver,
        solver_status=prediction.status,
        residual=prediction.residual,
        interval=prediction.interval,
        substeps=prediction.substeps,
        step_time=step_time,
    )


def margins_message(stamp: Time, prediction: Prediction, contact_tolerance: float) -> SafetyMargins:
    """Return every barrier of a prediction, the least of each kind, and what touches."""
    message = SafetyMargins(header=header(stamp), valid=True, contact_state=SafetyMargins.CONTACT_FREE)
    kinds, nodes, obstacles, values, clearances = [], [], [], [], []
    touching: set[int] = set()
    for rows in prediction.margins:
        count = len(rows.value)
        if not count:
            continue
        node = rows.nodes[:, -1]
        kinds.append(np.full(count, rows.kind))
        nodes.append(node)
        obstacles.append(rows.obstacle)
        values.append(rows.value)
        clearances.append(rows.clearance)
        least = int(rows.clearance.argmin())
        message.least.append(
            BarrierMargin(
                kind=int(rows.kind),
                node=int(node[least]),
                obstacle=int(rows.obstacle[least]),
                value=float(rows.value[least]),
                clearance=float(rows.clearance[least]),
            )
        )
        if rows.kind == BarrierMargin.KIND_OBSTACLE:
            touching.update(node[rows.clearance <= contact_tolerance].tolist())
    message.kind = np.concatenate(kinds).astype(np.uint8)
    message.node = np.concatenate(nodes).astype(np.uint32)
    message.obstacle = np.concatenate(obstacles).astype(np.int32)
    message.value = np.concatenate(values)
    message.clearance = np.concatenate(clearances)
    if touching:
        message.contact_state = SafetyMargins.CONTACT_TOUCHING
        message.contact_nodes = sorted(touching)
    return message


def invalid_margins(stamp: Time, reason: str) -> SafetyMargins:
    """Return a margins message that says that there are none, and why."""
    return SafetyMargins(header=header(stamp), valid=False, reason=reason, contact_state=SafetyMargins.CONTACT_UNKNOWN)


def thread_markers(stamp: Time, prediction: Prediction, diameter: float) -> MarkerArray:
    """Return the predicted thread as a line, each node coloured by its clearance of obstacles."""
    clearance = np.full(len(prediction.vertices), np.inf)
    for rows in prediction.margins:
        if rows.kind == BarrierMargin.KIND_OBSTACLE:
            np.minimum.at(clearance, rows.nodes[:, -1], rows.clearance)
    line = Marker(header=header(stamp), ns="thread", id=0, type=Marker.LINE_STRIP, action=Marker.ADD)
    line.pose = _pose(np.zeros(2), 0.0)
    line.scale.x = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    line.points = _points(prediction.vertices)
    safe = np.clip(clearance / FULL_COLOUR_CLEARANCE, 0.0, 1.0)
    line.colors = [ColorRGBA(r=float(1.0 - s), g=float(0.75 * s), b=0.1, a=1.0) for s in safe]
    return MarkerArray(markers=[line])


def obstacle_markers(stamp: Time, obstacles: Sequence[Obstacle]) -> MarkerArray:
    """Return the obstacles: discs as flat cylinders, polygons as their triangles."""
    markers = []
    for index, obstacle in enumerate(obstacles):
        marker = Marker(header=header(stamp), ns="obstacles", id=index, action=Marker.ADD)
        marker.color = ColorRGBA(r=0.85, g=0.65, b=0.6, a=0.8)
        if isinstance(obstacle, Disc):
            marker.type = Marker.CYLINDER
            marker.pose = _pose(np.asarray(obstacle.centre), 0.0)
            marker.scale = Vector3(x=2.0 * obstacle.radius, y=2.0 * obstacle.radius, z=1e-3)
        elif isinstance(obstacle, Polygon):
            shape = triangulate(obstacle)
            marker.type = Marker.TRIANGLE_LIST
            marker.pose = _pose(np.zeros(2), 0.0)
            marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
            marker.points = _points(shape.vertices[shape.triangles].reshape(-1, 2))
        markers.append(marker)
    return MarkerArray(markers=markers)


def _pose(point: np.ndarray, angle: float) -> Pose:
    turned = Quaternion(z=math.sin(0.5 * angle), w=math.cos(0.5 * angle))
    return Pose(position=Point(x=float(point[0]), y=float(point[1])), orientation=turned)


def _points(vertices: np.ndarray) -> list[Point]:
    return [Point(x=x, y=y) for x, y in vertices.tolist()]
