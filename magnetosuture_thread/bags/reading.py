"""Reads messages of any library, and paths among CDR bytes, many times faster than decoded."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.cdr import BEGIN, DISH_END, header_stamp, is_in_dish_frame
from magnetosuture_thread.bags.packing import IN_PLANE, PATH_AT, PATH_GAP, PATH_POSES
from magnetosuture_thread.geometry.needle_arc import heading_from_quaternion, round_trip_heading
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.thread.margins import BarrierMargins, Friction, FrictionState, Margins
from magnetosuture_thread.thread.prediction import NeedlePose

MAX_PIECES, MAX_PIECE_POINTS, MAX_OUTLINES = 64, 4096, 256  # of an observation of the thread
RecordedMessage: TypeAlias = Any  # with `topic`, `time` [ns], `data` (CDR bytes), and `decode()`, or a `BagError`
_STAMP = f"{interface.NEEDLE_POSE.name}.header.stamp"
_ORIENTATION = f"{interface.NEEDLE_POSE.name}.pose.orientation"


def nanoseconds(stamp: Any) -> int:
    """Return a time message in nanoseconds."""
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def checked_nanoseconds(stamp: Any, field: str) -> int:
    """Return a time message in nanoseconds, or refuse one with a second's or more beside its seconds."""
    if stamp.nanosec >= 1_000_000_000:
        raise InvalidInputError(f"{field}.nanosec", stamp.nanosec, "less than a second's")
    return nanoseconds(stamp)


def clock_nanoseconds(message: Any) -> int:
    """Return the time of a Clock in nanoseconds, or refuse one that rclpy cannot represent."""
    if message.clock.sec < 0:
        raise InvalidInputError(f"/{interface.CLOCK.name}.clock.sec", message.clock.sec, "a time since 1970")
    return checked_nanoseconds(message.clock, f"/{interface.CLOCK.name}.clock")


def seconds(stamp: Any) -> float:
    """Return a time message in seconds."""
    return nanoseconds(stamp) * 1e-9


def constant_name(message: Any, value: int, prefix: str, other: str = "unknown") -> str:
    """Return the name of a constant of a message or its class in lower case, without its prefix.

    Args:
        message: a message of rclpy, or its class.
        value: of the constant.
        prefix: of the constant's name, as `STATE_`.
        other: returned where no constant has the value.
    """
    names = (name for name in dir(message) if name.startswith(prefix) and getattr(message, name) == value)
    return next((name.removeprefix(prefix).lower() for name in names), other)


def require_dish_frame(frame: str, field: str) -> None:
    """Refuse a message in another frame than the dish's."""
    if frame != interface.DISH_FRAME:
        raise InvalidInputError(f"{field}.header.frame_id", repr(frame), repr(interface.DISH_FRAME))


def needle_pose(message: Any, directed: bool = True) -> NeedlePose:
    """Return the needle's pose in the plane, of a PoseWithCovarianceStamped.

    Args:
        message: the pose.
        directed: whether to refuse one whose heading is unknown.

    Raises:
        InvalidInputError: wrong frame, no stamp, no unit quaternion, or a heading that is unknown by its covariance.
    """
    tail, heading, deviation = _plane_pose(message, interface.NEEDLE_POSE.name)
    checked_nanoseconds(message.header.stamp, _STAMP)  # the prediction could not be stamped by another
    if directed and not heading_known(message):
        expected = "a standard deviation of at most 1 rad: the heading is unknown"
        found = f"{math.sqrt(message.pose.covariance[-1]):g} rad"
        raise InvalidInputError(f"{interface.NEEDLE_POSE.name}.pose.covariance", found, expected)
    return NeedlePose(seconds(message.header.stamp), tail, heading, deviation)


def heading_known(message: Any) -> bool:
    """Return whether a PoseWithCovarianceStamped tells which end of the needle is the tail."""
    return not float(message.pose.covariance[-1]) > 1.0  # rad^2


def _plane_pose(message: Any, field: str) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[float, float]]:
    """Return tail, heading and their standard deviations of a PoseWithCovarianceStamped."""
    require_dish_frame(message.header.frame_id, field)
    position, q = message.pose.pose.position, message.pose.pose.orientation
    heading = heading_from_quaternion(q.x, q.y, q.z, q.w, _ORIENTATION)
    # x, y and the turn about z among the 36 numbers of the covariance.
    deviation = pose_deviation([message.pose.covariance[7 * k] for k in IN_PLANE])
    return np.array([position.x, position.y]), heading, deviation


def check_pose_age(stamp: float, now: float, max_age: float) -> None:
    """Refuse a pose that was too long on its way: a command that it gives would be stamped as of now.

    Args:
        stamp: of the pose [s].
        now: the same clock now [s].
        max_age: of the pose [s].

    Raises:
        InvalidInputError: it is older.
    """
    if now - stamp > max_age:
        raise InvalidInputError(_STAMP, f"{now - stamp:.3f} s old", f"at most {max_age:g} s")


def tracked_pose(
    stamp: Any,
    tail: NDArray[np.float64],
    heading: NDArray[np.float64],
    covariance: NDArray[np.float64] | None = None,
) -> NeedlePose:
    """Return a needle's pose as `needle_pose` returns it of its message, to the last bit.

    Raises:
        InvalidInputError: no stamp.
    """
    checked_nanoseconds(stamp, _STAMP)
    along = round_trip_heading(heading, _ORIENTATION)
    deviation = (0.0, 0.0) if covariance is None else pose_deviation(np.diag(covariance))
    return NeedlePose(seconds(stamp), np.array([float(tail[0]), float(tail[1])]), along, deviation)


def pose_deviation(variances: Sequence[float] | NDArray[np.float64]) -> tuple[float, float]:
    """Return the standard deviations of a needle's tail in each direction [m] and of its heading [rad].

    Args:
        variances: of x, y [m^2] and the heading's angle [rad^2]; what is none gives zeros, as for unknown.
    """
    x, y, turn = (float(variance) for variance in variances)
    if not (math.isfinite(x + y + turn) and min(x, y, turn) >= 0.0):
        return 0.0, 0.0
    return math.sqrt(0.5 * (x + y)), math.sqrt(turn)


def pose_covariance(message: Any) -> NDArray[np.float64] | None:
    """Return the covariance of x, y [m] and the heading's angle [rad], shape (3, 3); None for zeros, as for unknown.

    Raises:
        InvalidInputError: it is not finite, or a variance is negative.
    """
    whole = np.asarray(message.pose.covariance).reshape(6, 6)
    if not whole.any():
        return None
    covariance = whole[np.ix_(IN_PLANE, IN_PLANE)]
    if not np.isfinite(covariance).all() or (np.diag(covariance) < 0.0).any():
        diagonal = np.diag(covariance).tolist()
        raise InvalidInputError(
            f"{interface.NEEDLE_POSE.name}.pose.covariance", diagonal, "finite variances of at least 0"
        )
    return np.asarray(covariance)


def filtered_command(message: Any) -> tuple[int, NDArray[np.float64], NDArray[np.float64], str]:
    """Return stamp [ns], commanded and filtered velocity, shapes (2,) [m/s], and followed input of a FilterState.

    Raises:
        InvalidInputError: a velocity is not finite, or the stamp no time.
    """
    stamp = checked_nanoseconds(message.header.stamp, f"{interface.FILTER_STATE.name}.header.stamp")
    commanded, filtered = np.array([[v.x, v.y] for v in (message.commanded, message.filtered)])
    if not (np.isfinite(commanded).all() and np.isfinite(filtered).all()):
        raise InvalidInputError(interface.FILTER_STATE.name, [*commanded, *filtered], "finite velocities [m/s]")
    return stamp, commanded, filtered, message.source


def margins_of(message: Any) -> Margins:
    """Return the margins of a SafetyMargins that is valid.

    Raises:
        InvalidInputError: its parallel arrays differ in length, or a row is of no barrier.
    """
    row, names = np.asarray(message.barrier, dtype=np.intp), list(message.barrier_names)
    bound = getattr(message, "clearance_bound", ())  # older bags have none
    columns: list[Any] = [
        np.asarray(message.node, np.uint32),
        np.asarray(message.obstacle, np.int32),
        np.asarray(message.value, np.float64),
        np.asarray(message.clearance, np.float64),
        np.asarray(bound, np.float64) if len(bound) else np.full(len(row), -np.inf),
    ]
    if any(len(column) != len(row) for column in columns) or (len(row) and row.max() >= len(names)):
        found = f"{[len(row), *map(len, columns)]} rows of {len(names)} barriers"
        raise InvalidInputError(interface.MARGINS.name, found, "parallel arrays, each row of a barrier that is named")
    if message.friction_state not in set(FrictionState):
        raise InvalidInputError(
            f"{interface.MARGINS.name}.friction_state", message.friction_state, "a state of SafetyMargins"
        )
    margins = [BarrierMargins(name, *(column[row == k] for column in columns)) for k, name in enumerate(names)]
    squeezed = tuple(int(node) for node in message.friction_nodes)
    friction = Friction(FrictionState(message.friction_state), squeezed, message.slowdown)
    return Margins(tuple(margins), tuple(int(node) for node in message.contact_nodes), friction, message.scene_version)


def planar_pose(pose: Any) -> tuple[float, float, float]:
    """Return x, y [m] and the angle [rad] of a Pose in the plane."""
    turn = pose.orientation
    return pose.position.x, pose.position.y, 2.0 * float(np.arctan2(turn.z, turn.w))


def path_points(message: Any, field: str = interface.MEASURED_THREAD.name) -> Points:
    """Return a Path as an array of shape (m, 2) [m].

    Raises:
        InvalidInputError: wrong frame.
    """
    require_dish_frame(message.header.frame_id, field)
    return np.array([[p.pose.position.x, p.pose.position.y] for p in message.poses]).reshape(-1, 2)


def path_poses(message: Any, field: str) -> Points:
    """Return x, y [m] and angle [rad] of the poses of a Path in the dish plane, shape (m, 3).

    Raises:
        InvalidInputError: wrong frame, too many poses, or one that is not finite or far away.
    """
    if len(message.poses) > 20_000:
        raise InvalidInputError(field, f"{len(message.poses)} poses", "at most 20000")
    turns = np.reshape([(p.pose.orientation.z, p.pose.orientation.w) for p in message.poses], (-1, 2))
    found = np.column_stack([path_points(message, field), 2.0 * np.arctan2(turns[:, 0], turns[:, 1])])
    if not (np.abs(found) <= (0.5, 0.5, math.inf)).all():  # m, m, rad
        raise InvalidInputError(field, "a pose that is not finite or far away", "within 0.5 m")
    return found


def thread_observation(message: Any, field: str = interface.THREAD_OBSERVATION.name) -> ThreadObservation:
    """Return a ThreadObservation that is valid.

    Raises:
        InvalidInputError: wrong frame; too many pieces, points or outlines; a piece of fewer than 2 points, of another
            number of deviations, with numbers that are not finite, an end that is none, or an interval that is none.
    """
    require_dish_frame(message.header.frame_id, field)
    if len(message.pieces) > MAX_PIECES:
        raise InvalidInputError(f"{field}.pieces", len(message.pieces), f"at most {MAX_PIECES}")
    if len(message.hidden) > MAX_OUTLINES:
        raise InvalidInputError(f"{field}.hidden", len(message.hidden), f"at most {MAX_OUTLINES}")
    pieces = tuple(_piece(piece, f"{field}.pieces[{number}]") for number, piece in enumerate(message.pieces))
    outlines = tuple(
        _finite_points(outline.corners, f"{field}.hidden[{number}].corners", 3)
        for number, outline in enumerate(message.hidden)
    )
    if message.complete and not (len(pieces) == 1 and pieces[0].last_end is PieceEnd.FREE):
        raise InvalidInputError(f"{field}.complete", True, "False unless one piece ends freely")
    return ThreadObservation(pieces, bool(message.complete), outlines)


def _piece(message: Any, field: str) -> ThreadPiece:
    """Return a ThreadPiece; see `thread_observation`."""
    points = _finite_points(message.points, f"{field}.points", 2)
    deviation = np.asarray(message.deviation, np.float64)
    if len(deviation) != len(points) or not np.isfinite(deviation).all() or (deviation < 0.0).any():
        raise InvalidInputError(f"{field}.deviation", f"{len(deviation)} values", f"{len(points)}, finite, at least 0")
    ends = []
    for name, value in (("first_end", message.first_end), ("last_end", message.last_end)):
        if value not in set(PieceEnd):
            raise InvalidInputError(f"{field}.{name}", value, "an end of ThreadPiece")
        ends.append(PieceEnd(value))
    low, high = message.arc_length_min, message.arc_length_max
    unknown = math.isnan(low) and math.isnan(high)
    if not unknown and not 0.0 <= low <= high < math.inf:
        raise InvalidInputError(
            f"{field}.arc_length_min", f"{low:g} to {high:g}", "an interval from 0 on, or twice NaN"
        )
    if not 0.0 <= message.confidence <= 1.0:
        raise InvalidInputError(f"{field}.confidence", message.confidence, "0 to 1")
    known, sure = bool(message.direction_known), float(message.confidence)
    return ThreadPiece(points, deviation, ends[0], ends[1], (float(low), float(high)), known, sure)


def _finite_points(corners: Any, field: str, minimum: int) -> Points:
    """Return points in the plane, shape (m, 2) [m]."""
    if not minimum <= len(corners) <= MAX_PIECE_POINTS:
        raise InvalidInputError(field, f"{len(corners)} points", f"{minimum} to {MAX_PIECE_POINTS}")
    points = np.array([[point.x, point.y] for point in corners])
    if not np.isfinite(points).all():
        raise InvalidInputError(field, "a number that is not finite", "finite numbers")
    return points


def plane_velocity(message: Any, field: str) -> NDArray[np.float64]:
    """Return the velocity of a TwistStamped in the dish plane, shape (2,) [m/s].

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


def plane_point(message: Any, field: str) -> NDArray[np.float64]:
    """Return the place of a PointStamped in the dish plane, shape (2,) [m].

    Raises:
        InvalidInputError: wrong frame, or not finite.
    """
    require_dish_frame(message.header.frame_id, field)
    place = np.array([message.point.x, message.point.y])
    if not np.isfinite(place).all():
        raise InvalidInputError(f"{field}.point", place.tolist(), "finite numbers [m]")
    return place


def stamp_of(record: RecordedMessage) -> int:
    """Return the stamp of a message that begins with a header [ns]; when it was recorded, if it is too short."""
    stamp = header_stamp(record.data)
    return record.time if stamp is None else stamp


def read_pose(
    record: RecordedMessage,
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[float, float]]:
    """Return tail, heading and their standard deviations of a recorded needle pose, as `thread_model` gets them.

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is of another frame, or its orientation is none.
    """
    return _plane_pose(record.decode(), record.topic)


def read_path(record: RecordedMessage) -> Points:
    """Return a recorded path as an array of shape (m, 2) [m].

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is of another frame.
    """
    found = _plain_path(record.data)
    return path_points(record.decode(), record.topic) if found is None else found


def read_force(record: RecordedMessage) -> NDArray[np.float64]:
    """Return the force in the dish plane of a recorded wrench, shape (2,) [N].

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is of another frame, or not finite.
    """
    message = record.decode()
    require_dish_frame(message.header.frame_id, record.topic)
    force = np.array([message.wrench.force.x, message.wrench.force.y])
    if not np.isfinite(force).all():
        raise InvalidInputError(record.topic, force.tolist(), "a finite force")
    return force


def read_observation(record: RecordedMessage) -> ThreadObservation:
    """Return a recorded observation of the thread.

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is not valid; see `thread_observation`.
    """
    return thread_observation(record.decode(), record.topic)


def _plain_path(data: bytes) -> Points | None:
    """Return a path whose poses all are in the dish frame, as ours are, so that they lie at equal distances."""
    if PATH_GAP or not is_in_dish_frame(data) or len(data) < PATH_AT:
        return None
    (count,) = struct.unpack_from("<I", data, PATH_AT - 4)
    if len(data) < PATH_AT + count * PATH_POSES.itemsize:
        return None
    poses = np.frombuffer(data, PATH_POSES, count, PATH_AT)
    if poses["frame"].tobytes() != data[len(BEGIN) + 8 : DISH_END] * count:
        return None
    return np.column_stack([poses["x"], poses["y"]])
