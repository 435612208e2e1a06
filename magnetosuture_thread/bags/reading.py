"""Reads messages of any library; and headers and paths among CDR bytes, many times faster than decoded."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np

from magnetosuture_thread.bags import packing
from magnetosuture_thread.bags.packing import Vector
from magnetosuture_thread.geometry import scene as scenes
from magnetosuture_thread.geometry.needle_arc import heading_from_quaternion, round_trip_heading
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.shapes import Ring
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError, ConfigurationError, InvalidInputError
from magnetosuture_thread.thread.margins import BarrierMargins, Friction, FrictionState, Margins
from magnetosuture_thread.thread.prediction import NeedlePose

MAX_PIECES = 64  # of an observation of the thread
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


def _finite(values: Any, field: str, expected: str) -> Vector:
    """Return numbers as an array, or refuse those that are not finite."""
    numbers = np.asarray(values, np.float64)
    if not np.isfinite(numbers).all():
        raise InvalidInputError(field, numbers.tolist(), expected)
    return numbers


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
        value = f"{math.sqrt(message.pose.covariance[-1]):g} rad"
        raise InvalidInputError(f"{interface.NEEDLE_POSE.name}.pose.covariance", value, expected)
    return NeedlePose(seconds(message.header.stamp), tail, heading, deviation)


def heading_known(message: Any) -> bool:
    """Return whether a PoseWithCovarianceStamped tells which end of the needle is the tail."""
    return not float(message.pose.covariance[-1]) > 1.0  # rad^2


def _plane_pose(message: Any, field: str) -> tuple[Vector, Vector, tuple[float, float]]:
    """Return tail, heading and their standard deviations of a PoseWithCovarianceStamped."""
    require_dish_frame(message.header.frame_id, field)
    position, q = message.pose.pose.position, message.pose.pose.orientation
    heading = heading_from_quaternion(q.x, q.y, q.z, q.w, _ORIENTATION)
    # x, y and the turn about z among the 36 numbers of the covariance.
    deviation = pose_deviation([message.pose.covariance[7 * k] for k in packing.IN_PLANE])
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


def tracked_pose(stamp: Any, tail: Vector, heading: Vector, covariance: Vector | None = None) -> NeedlePose:
    """Return a needle's pose as `needle_pose` returns it of its message, to the last bit.

    Raises:
        InvalidInputError: no stamp.
    """
    checked_nanoseconds(stamp, _STAMP)
    along = round_trip_heading(heading, _ORIENTATION)
    deviation = (0.0, 0.0) if covariance is None else pose_deviation(np.diag(covariance))
    return NeedlePose(seconds(stamp), np.array([float(tail[0]), float(tail[1])]), along, deviation)


def pose_deviation(variances: Sequence[float] | Vector) -> tuple[float, float]:
    """Return the standard deviations of a needle's tail in each direction [m] and of its heading [rad].

    Args:
        variances: of x, y [m^2] and the heading's angle [rad^2]; invalid ones give zeros, as for unknown.
    """
    x, y, turn = (float(variance) for variance in variances)
    if not (math.isfinite(x + y + turn) and min(x, y, turn) >= 0.0):
        return 0.0, 0.0
    return math.sqrt(0.5 * (x + y)), math.sqrt(turn)


def pose_covariance(message: Any) -> Vector | None:
    """Return the covariance of x, y [m] and the heading's angle [rad], shape (3, 3); None for zeros, as for unknown.

    Raises:
        InvalidInputError: it is not finite, or a variance is negative.
    """
    whole = np.asarray(message.pose.covariance).reshape(6, 6)
    if not whole.any():
        return None
    covariance = whole[np.ix_(packing.IN_PLANE, packing.IN_PLANE)]
    if not np.isfinite(covariance).all() or (np.diag(covariance) < 0.0).any():
        field, variances = f"{interface.NEEDLE_POSE.name}.pose.covariance", np.diag(covariance).tolist()
        raise InvalidInputError(field, variances, "finite variances of at least 0")
    return np.asarray(covariance)


def filtered_command(message: Any) -> tuple[int, Vector, Vector, str]:
    """Return stamp [ns], commanded and filtered velocity, shapes (2,) [m/s], and followed input of a FilterState.

    Raises:
        InvalidInputError: a velocity is not finite, or the stamp no time.
    """
    name = interface.FILTER_STATE.name
    stamp = checked_nanoseconds(message.header.stamp, f"{name}.header.stamp")
    velocities = [(vector.x, vector.y) for vector in (message.commanded, message.filtered)]
    commanded, filtered = _finite(velocities, name, "finite velocities [m/s]")
    return stamp, commanded, filtered, message.source


def margins_of(message: Any) -> Margins:
    """Return the margins of a SafetyMargins that is valid.

    Raises:
        InvalidInputError: its parallel arrays differ in length, or a row is of no barrier.
    """
    row, names, field = np.asarray(message.barrier, dtype=np.intp), list(message.barrier_names), interface.MARGINS.name
    bound = getattr(message, "clearance_bound", ())  # older bags have none
    bound = bound if len(bound) else np.full(len(row), -np.inf)
    columns: list[Any] = [np.asarray(message.node, np.uint32), np.asarray(message.obstacle, np.int32)]
    columns += [np.asarray(column, np.float64) for column in (message.value, message.clearance, bound)]
    if any(len(column) != len(row) for column in columns) or (len(row) and row.max() >= len(names)):
        rows = f"{[len(row), *map(len, columns)]} rows of {len(names)} barriers"
        raise InvalidInputError(field, rows, "parallel arrays, each row of a barrier that is named")
    if message.friction_state not in set(FrictionState):
        raise InvalidInputError(f"{field}.friction_state", message.friction_state, "a state of SafetyMargins")
    margins = [BarrierMargins(name, *(column[row == k] for column in columns)) for k, name in enumerate(names)]
    squeezed, touching = (tuple(map(int, nodes)) for nodes in (message.friction_nodes, message.contact_nodes))
    friction = Friction(FrictionState(message.friction_state), squeezed, message.slowdown)
    return Margins(tuple(margins), touching, friction, message.scene_version)


def planar_pose(pose: Any) -> tuple[float, float, float]:
    """Return x, y [m] and the angle [rad] of a Pose in the plane."""
    turn = pose.orientation
    return pose.position.x, pose.position.y, 2.0 * float(np.arctan2(turn.z, turn.w))


def plane_points(points: Iterable[Any]) -> Points:
    """Return points or vectors of a message in the dish plane, shape (m, 2)."""
    return np.array([[point.x, point.y] for point in points]).reshape(-1, 2)


def path_points(message: Any, field: str = interface.MEASURED_THREAD.name) -> Points:
    """Return a Path as an array of shape (m, 2) [m].

    Raises:
        InvalidInputError: wrong frame.
    """
    require_dish_frame(message.header.frame_id, field)
    return plane_points(stamped.pose.position for stamped in message.poses)


def path_poses(message: Any, field: str) -> Points:
    """Return x, y [m] and angle [rad] of the poses of a Path in the dish plane, shape (m, 3).

    Raises:
        InvalidInputError: wrong frame, too many poses, or one that is not finite or far away.
    """
    if len(message.poses) > 20_000:
        raise InvalidInputError(field, f"{len(message.poses)} poses", "at most 20000")
    turns = np.reshape([(p.pose.orientation.z, p.pose.orientation.w) for p in message.poses], (-1, 2))
    poses = np.column_stack([path_points(message, field), 2.0 * np.arctan2(turns[:, 0], turns[:, 1])])
    if not (np.abs(poses) <= (0.5, 0.5, math.inf)).all():  # m, m, rad
        raise InvalidInputError(field, "a pose that is not finite or far away", "within 0.5 m")
    return poses


def thread_observation(message: Any, field: str = interface.THREAD_OBSERVATION.name) -> ThreadObservation:
    """Return a ThreadObservation that is valid.

    Raises:
        InvalidInputError: wrong frame; too many pieces, points or outlines; a piece of fewer than 2 points, of another
            number of deviations, with numbers that are not finite, or with an invalid end or interval.
    """
    require_dish_frame(message.header.frame_id, field)
    for name, parts, maximum in (("pieces", message.pieces, MAX_PIECES), ("hidden", message.hidden, 256)):
        if len(parts) > maximum:
            raise InvalidInputError(f"{field}.{name}", len(parts), f"at most {maximum}")
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
    low, high, confidence = float(message.arc_length_min), float(message.arc_length_max), float(message.confidence)
    is_interval = (math.isnan(low) and math.isnan(high)) or 0.0 <= low <= high < math.inf
    is_deviation = len(deviation) == len(points) and np.isfinite(deviation).all() and not (deviation < 0.0).any()
    interval, ends = "an interval from 0 on, or twice NaN", set(PieceEnd)
    for name, is_valid, value, expected in (
        ("deviation", is_deviation, f"{len(deviation)} values", f"{len(points)}, finite, at least 0"),
        ("first_end", message.first_end in ends, message.first_end, "an end of ThreadPiece"),
        ("last_end", message.last_end in ends, message.last_end, "an end of ThreadPiece"),
        ("arc_length_min", is_interval, f"{low:g} to {high:g}", interval),
        ("confidence", 0.0 <= confidence <= 1.0, message.confidence, "0 to 1"),
    ):
        if not is_valid:
            raise InvalidInputError(f"{field}.{name}", value, expected)
    first, last, known = PieceEnd(message.first_end), PieceEnd(message.last_end), bool(message.direction_known)
    return ThreadPiece(points, deviation, first, last, (low, high), known, confidence)


def _finite_points(corners: Any, field: str, minimum: int) -> Points:
    """Return points in the plane, shape (m, 2) [m]."""
    if not minimum <= len(corners) <= 4096:
        raise InvalidInputError(field, f"{len(corners)} points", f"{minimum} to 4096")
    return _finite([(point.x, point.y) for point in corners], field, "finite numbers")


def needle_command(message: Any, field: str) -> Vector:
    """Return the motion that a TwistStamped commands: shape (2,), of the tip [m/s], or shape (3,), see `NeedleTwist`.

    In the dish frame its linear velocity is that of the tip, and turns the needle. In the needle's frame it is that of
    the chord's middle, beside the turn rate.

    Raises:
        InvalidInputError: wrong frame, or a motion that the needle cannot make: out of the plane, or a turn
            apart from that which the tip's velocity amounts to.
    """
    linear, angular = message.twist.linear, message.twist.angular
    if message.header.frame_id == interface.NEEDLE_FRAME:
        others, turn = [linear.z, angular.x, angular.y], [angular.z]
    else:
        require_dish_frame(message.header.frame_id, field)
        others, turn = [linear.z, angular.x, angular.y, angular.z], []
    if any(value != 0.0 for value in others):
        raise InvalidInputError(f"{field}.twist", f"out of the plane or apart from x and y: {others}", "zeros")
    return np.array([linear.x, linear.y, *turn])


def plane_point(message: Any, field: str) -> Vector:
    """Return the place of a PointStamped in the dish plane, shape (2,) [m].

    Raises:
        InvalidInputError: wrong frame, or not finite.
    """
    require_dish_frame(message.header.frame_id, field)
    return _finite((message.point.x, message.point.y), f"{field}.point", "finite numbers [m]")


def plane_force(message: Any, field: str) -> Vector:
    """Return the force of a WrenchStamped in the dish plane, shape (2,) [N].

    Raises:
        InvalidInputError: wrong frame, or not finite.
    """
    require_dish_frame(message.header.frame_id, field)
    return _finite((message.wrench.force.x, message.wrench.force.y), field, "a finite force")


def header_stamp(data: bytes) -> int | None:
    """Return the stamp of CDR bytes that begin with a header [ns]; None if there are too few."""
    if len(data) < 12:
        return None
    whole, rest = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, len(packing.BEGIN))
    return int(whole) * 1_000_000_000 + int(rest)


def stamp_and_frame(topic: str, data: bytes) -> tuple[int, str]:
    """Return when a message was stamped [ns], and in which frame it is.

    Args:
        topic: for errors.
        data: CDR bytes of a message whose type begins with std_msgs/Header.

    Raises:
        BagError: no header can be read there.
    """
    stamp, orders = header_stamp(data), {packing.BEGIN[:2]: "<I", b"\0\0": ">I"}
    if stamp is not None and data[:2] in orders and len(data) >= 16:
        (length,) = struct.unpack_from(orders[data[:2]], data, 12)
        frame = data[16 : 16 + length]
        with suppress(UnicodeDecodeError):
            if 0 < length == len(frame) and frame.endswith(b"\0"):
                return stamp, frame[:-1].decode()
    raise BagError(topic, "a message has no header that can be read")


def stamp_of(record: RecordedMessage) -> int:
    """Return the stamp of a message that begins with a header [ns]; when it was recorded, if it is too short."""
    stamp = header_stamp(record.data)
    return record.time if stamp is None else stamp


def read_pose(record: RecordedMessage) -> tuple[Vector, Vector, tuple[float, float]]:
    """Return tail, heading and their standard deviations of a recorded needle pose, as `thread_model` gets them.

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is of another frame, or its orientation is not valid.
    """
    return _plane_pose(record.decode(), record.topic)


def read_path(record: RecordedMessage) -> Points:
    """Return a recorded path as an array of shape (m, 2) [m].

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is of another frame.
    """
    points = _plain_path(record.data)
    return path_points(record.decode(), record.topic) if points is None else points


def _plain_path(data: bytes) -> Points | None:
    """Return a path whose bytes are those that `packing.packed_poses` gives, as ours are; None of another."""
    stamp, count = header_stamp(data), round((len(data) - packing.PATH_BYTES) / packing.POSE_BYTES)
    if stamp is None or count < 1:
        return None
    begin = len(data) - (count - 1) * packing.POSE_BYTES - packing.NUMBERS_BYTES
    poses = np.ndarray((count, 7), np.float64, data, begin, (packing.POSE_BYTES, 8))
    return poses[:, :2].copy() if packing.packed_poses(stamp, poses) == data else None


def parse_scene_message(message: Any) -> scenes.Scene:
    """Parse a Scene message and validate it.

    Args:
        message: a magnetosuture_msgs/Scene of any library.

    Raises:
        InvalidInputError: another frame, anything out of bounds, or a content whose hash is not the message's
            version: it is damaged, or was made by other rules.
    """
    name, self_contacts = interface.SCENE.name, {number: setting for setting, number in packing.SELF_CONTACT.items()}
    require_dish_frame(message.header.frame_id, name)
    _require_bounds(message.shapes)
    try:
        wall_friction = float(getattr(message, "wall_friction", 0.0))  # older messages have none, and no self-contact
        self_contact = int(getattr(message, "self_contact", 0))
        if self_contact not in self_contacts:
            raise ConfigurationError("self_contact", self_contact, "0, 1 or 2, see the message's constants")
        size = float(message.dish_diameter), float(message.dish_depth)
        dish = scenes.Dish(*size, wall_friction, self_contacts[self_contact])
        scene = scenes.Scene(dish, tuple(_shape_of(shape) for shape in message.shapes))
    except ConfigurationError as error:
        raise InvalidInputError(f"{name}.{error.name}", repr(error.value), error.expectation) from None
    if message.version != scene.version:
        expected = f"{scene.version!r}, the hash of the content"
        raise InvalidInputError(f"{name}.version", repr(message.version[: 2 * scenes.VERSION_CHARS]), expected)
    return scene


def parse_shape_message(message: Any) -> scenes.SceneShape:
    """Parse a SceneShape message and validate it.

    Raises:
        InvalidInputError: it is too large, or neither a disc nor a polygon.
        ConfigurationError: anything in it is out of bounds.
    """
    _require_bounds([message])
    shape = _shape_of(message)
    if isinstance(shape.geometry, Polygon):
        triangulate(shape.geometry)  # as its markers will be
    return shape


def _require_bounds(shapes: Sequence[Any]) -> None:
    """Refuse oversized shapes before anything is built from them."""
    sizes = {"shapes": (len(shapes), scenes.MAX_SHAPES)}
    for index, shape in enumerate(shapes[: scenes.MAX_SHAPES]):
        field = f"shapes[{index}]"
        sizes |= {f"{field}.{name}": (len(getattr(shape, name)), scenes.MAX_NAME_CHARS) for name in ("name", "kind")}
        if len(shape.disc) + len(shape.polygon) != 1:
            kinds = f"{len(shape.disc)} discs and {len(shape.polygon)} polygons"
            raise InvalidInputError(f"{interface.SCENE.name}.{field}", kinds, "one disc or one polygon")
    polygons = [polygon for shape in shapes for polygon in shape.polygon]
    rings = [ring for polygon in polygons for ring in (polygon.outline, *polygon.holes)]
    sizes["shapes.polygon"] = len(rings), scenes.MAX_OUTLINES
    sizes["shapes.polygon.corners"] = sum(len(ring.corners) for ring in rings), scenes.MAX_VERTICES
    for field, (count, maximum) in sizes.items():
        if count > maximum:
            raise InvalidInputError(f"{interface.SCENE.name}.{field}", count, f"at most {maximum}")


def _shape_of(shape: Any) -> scenes.SceneShape:
    def ring(outline: Any) -> Ring:
        return tuple((float(corner.x), float(corner.y)) for corner in outline.corners)

    geometry: Disc | Polygon
    try:
        if len(shape.disc):
            disc = shape.disc[0]
            geometry = Disc((float(disc.x), float(disc.y)), float(disc.radius))
        else:
            polygon = shape.polygon[0]
            geometry = Polygon(ring(polygon.outline), tuple(map(ring, polygon.holes)))
    except ConfigurationError as error:
        raise ConfigurationError(f"{shape.name}.{error.name}", error.value, error.expectation) from None
    return scenes.SceneShape(shape.name, shape.kind, geometry, friction=float(getattr(shape, "friction", 0.0)))
