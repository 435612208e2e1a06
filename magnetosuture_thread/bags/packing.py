"""Packs the messages of the graph as CDR bytes, which nodes publish and bags store as they are; and markers for RViz.

Each layout has the fields of the message's definition in their order; stamps are nanoseconds or time messages.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magnetosuture_thread.geometry.barrier import COMPRESSION, CONNECTIVITY, ENHANCED_CONNECTIVITY, STIFFNESS
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import heading_angle, yaw_quaternion
from magnetosuture_thread.geometry.obstacles import Disc, triangulate
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.settings import interface
from magnetosuture_thread.thread.margins import UNKNOWN, FrictionState, Margins, friction_colour
from magnetosuture_thread.thread.prediction import Prediction

if TYPE_CHECKING:
    from magnetosuture_thread.coils.bridge import BridgeOutput
    from magnetosuture_thread.coils.coil_system import CoilSystem
    from magnetosuture_thread.coils.drivers import DriverState
    from magnetosuture_thread.estimator.estimator import ThreadEstimate
    from magnetosuture_thread.estimator.thread_session import PredictionResult
    from magnetosuture_thread.forecast.forecaster import Forecast
    from magnetosuture_thread.vision.tracker import Track

Vector = NDArray[np.float64]
Outputs = Iterator[tuple[interface.Channel, bytes]]
Colour = tuple[float, ...]
Place = Sequence[float] | Vector

Stamp = Any  # nanoseconds as int, or a time message of any library
Fields = tuple[tuple[str, Any, int], ...]  # of each what it is, its format, type or fields, and its size [bytes]

IN_PLANE = (0, 1, 5)  # x, y and the turn about z among ROS's six coordinates of a pose
SELF_CONTACT = {None: 0, True: 1, False: 2}  # as in Scene.msg
BEGIN = b"\x00\x01\x00\x00"  # plain CDR, little endian, as every ROS 2 machine of today writes it
_COUNT = struct.Struct("<I")
DISH, NEEDLE = (
    _COUNT.pack(len(frame.encode()) + 1) + frame.encode() + b"\0"
    for frame in (interface.DISH_FRAME, interface.NEEDLE_FRAME)
)
LIFETIME = 500_000_000  # ns of a marker that is a text, an arrow or a forecast; poses come far more often
COLOURS: dict[str, Colour] = {
    "ink": (0.1, 0.13, 0.16),
    "alarm": (0.78, 0.06, 0.18),
    "deviation": (0.0, 0.6, 0.65),
    "predicted": (0.71, 0.09, 0.62),
    "forecast": (0.45, 0.3, 0.75),
    "rim": (0.45, 0.5, 0.55),
    "tissue": (0.85, 0.65, 0.6),
    "instrument": (0.55, 0.6, 0.66),
    "wall": (0.45, 0.42, 0.38),
}


def pack(layout: str, *values: Any) -> bytes:
    """Return the CDR bytes of a message.

    Args:
        layout: the kinds of its fields in their order, with those of nested messages in their place, separated by
            spaces. `header` is a stamp in the dish frame, `needle_header` one in the needle's, and `time` a stamp, all
            of type `Stamp`; `text` is a string; numbers have their names in ROS. `float64[]` is a sequence of numbers,
            `float64[9]` an array, whose numbers stand without a count; `points` is an array of shape (m, 2) as a
            sequence of points or vectors with z = 0; `{ ... }` is a sequence of what stands between the braces: of
            one field its values, of several a tuple of their values for each message.
        values: of the fields.
    """
    data = bytearray(BEGIN)
    _put_fields(data, _fields(layout), values)
    return bytes(data)


def _put_fields(data: bytearray, fields: Fields, values: Sequence[Any]) -> None:
    for (kind, number, size), value in zip(fields, values, strict=True):
        if kind == "number":
            data += bytes((4 - len(data)) % size)
            data += number.pack(value)
        elif kind in ("header", "needle_header", "time"):
            seconds = divmod(value, 10**9) if isinstance(value, int) else (value.sec, value.nanosec)
            data += bytes(-len(data) % 4) + struct.pack("<iI", *seconds)
            data += {"header": DISH, "needle_header": NEEDLE, "time": b""}[kind]
        elif kind == "text":
            content = value.encode() + b"\0"
            data += bytes(-len(data) % 4) + _COUNT.pack(len(content)) + content
        elif kind == "messages":
            data += bytes(-len(data) % 4) + _COUNT.pack(len(value))
            for part in value:
                _put_fields(data, number, part if len(number) > 1 else (part,))
        else:
            _put_numbers(data, kind, number, value)


@cache
def _fields(layout: str) -> Fields:
    """Return the fields of a layout."""
    levels: list[list[tuple[str, Any, int]]] = [[]]
    formats = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
    for word in layout.split():
        if word == "{":
            levels.append([])
        elif word == "}":
            inner = tuple(levels.pop())
            levels[-1].append(("messages", inner, 4))
        else:
            name, bracket, count = word.partition("[")
            number = struct.Struct("<" + formats.get(name, "d"))
            kind = name if name not in formats else "sequence" if count == "]" else "array" if bracket else "number"
            levels[-1].append((kind, number if kind == "number" else np.dtype(number.format), number.size))
    return tuple(levels[0])


def _put_numbers(data: bytearray, kind: str, dtype: np.dtype[Any], values: ArrayLike) -> None:
    numbers = np.asarray(values, dtype)
    if kind == "points":
        numbers = np.column_stack([numbers, np.zeros(len(numbers))]) if len(numbers) else numbers
    if kind != "array":
        data += bytes(-len(data) % 4) + _COUNT.pack(len(numbers))
    if numbers.size:  # an empty sequence is not aligned
        data += bytes((4 - len(data)) % dtype.itemsize) + numbers.tobytes()


def packed_header(stamp: Stamp) -> bytes:
    """Return a Header in the dish frame."""
    return pack("header", stamp)


def planar_pose_fields(point: Vector, angle: float) -> tuple[float, ...]:
    """Return position and quaternion of a pose in the dish plane: a point [m], and the angle from the x axis [rad]."""
    return (point[0], point[1], 0.0, 0.0, 0.0, *yaw_quaternion(angle))


def packed_pose(stamp: Stamp, tail: Vector, heading: Vector, covariance: Vector | None = None) -> bytes:
    """Return the needle's pose, a PoseWithCovarianceStamped: position of the tail, x axis along the needle there.

    Args:
        stamp: of the frame that it was measured in.
        tail: shape (2,) [m].
        heading: unit vector, shape (2,).
        covariance: of x, y [m] and the angle of the heading [rad], shape (3, 3); zeros, which say in ROS
            that it is not known, if None.
    """
    whole = np.zeros((6, 6))
    if covariance is not None:
        whole[np.ix_(IN_PLANE, IN_PLANE)] = covariance
    return pack("header float64[7] float64[36]", stamp, planar_pose_fields(tail, heading_angle(heading)), whole)


def packed_pose_stamped(stamp: Stamp, point: Vector, angle: float) -> bytes:
    """Return a PoseStamped in the dish plane: a point of shape (2,) [m] and an angle from the x axis [rad]."""
    return pack("header float64[7]", stamp, planar_pose_fields(point, angle))


PATH_BYTES, POSE_BYTES = len(pack("header uint32", 0, 0)), len(pack("header float64[7]", 0, np.zeros(7))) - len(BEGIN)
NUMBERS_BYTES = 7 * 8  # of a pose, at its end


def packed_path(stamp: Stamp, points: Points) -> bytes:
    """Return a polyline of shape (m, 2) [m], or x, y [m] and angle [rad] of poses, shape (m, 3), as a Path."""
    poses = np.zeros((len(points), 7))
    half = 0.5 * points[:, 2] if points.shape[1:] == (3,) else np.zeros(len(points))
    poses[:, :2], poses[:, 5], poses[:, 6] = points[:, :2], np.sin(half), np.cos(half)
    return packed_poses(stamp, poses)


def packed_poses(stamp: Stamp, poses: Vector) -> bytes:
    """Return positions [m] and quaternions, shape (m, 7), as a Path."""
    if not len(poses):
        return pack("header uint32", stamp, 0)
    head = pack("header uint32 header float64[7]", stamp, len(poses), stamp, poses[0])
    pose = pack("header float64[7]", stamp, poses[0])  # as all but the first lie: from a multiple of 8 to another
    rest = np.tile(np.frombuffer(pose, np.uint8, offset=len(BEGIN)), (len(poses) - 1, 1))
    rest[:, -NUMBERS_BYTES:] = np.ascontiguousarray(poses[1:], np.float64).view(np.uint8)
    return head + rest.tobytes()


def packed_point(stamp: Stamp, point: Vector) -> bytes:
    """Return a point in the dish plane, shape (2,) [m], as a PointStamped."""
    return pack("header float64[3]", stamp, (point[0], point[1], 0.0))


def packed_twist(stamp: Stamp, velocity: Vector) -> bytes:
    """Return a motion as a TwistStamped.

    Args:
        stamp: of the message.
        velocity: of the tip in the dish frame, shape (2,) [m/s]; or in the needle's frame along and to the left [m/s],
            and the turn rate [rad/s], shape (3,).
    """
    if len(velocity) == 3:
        return pack("needle_header float64[6]", stamp, (velocity[0], velocity[1], 0.0, 0.0, 0.0, velocity[2]))
    return pack("header float64[6]", stamp, (velocity[0], velocity[1], 0.0, 0.0, 0.0, 0.0))


def packed_wrench(stamp: Stamp, force: Vector, moment: float) -> bytes:
    """Return a WrenchStamped of a force in the dish plane, shape (2,) [N], and a counter-clockwise moment [N m]."""
    return pack("header float64[6]", stamp, (force[0], force[1], 0.0, 0.0, 0.0, moment))


def packed_compressed_image(stamp: Stamp, data: NDArray[np.uint8]) -> bytes:
    """Return a JPEG file's bytes, shape (bytes,), as a CompressedImage."""
    return pack("time text text uint8[]", stamp, interface.CAMERA_FRAME, "bgr8; jpeg compressed bgr8", data)


def packed_image(stamp: Stamp, pixels: NDArray[np.uint8]) -> bytes:
    """Return a BGR image of shape (height, width, 3) as an Image."""
    height, width = pixels.shape[:2]
    layout = "time text uint32 uint32 text uint8 uint32 uint8[]"
    return pack(layout, stamp, interface.CAMERA_FRAME, height, width, "bgr8", 0, 3 * width, pixels.ravel())


def packed_camera_info(stamp: Stamp, size: tuple[int, int], view: DishView, distance: float) -> bytes:
    """Return the intrinsics of a camera that looks straight down from a distance [m]; size is width and height."""
    matrix = view.intrinsics(distance)
    # Distortion, intrinsic, rectification, projection matrix; then binning and region of interest, which are not set.
    layout = "time text uint32 uint32 text float64[] float64[9] float64[9] float64[12] uint32[6] bool"
    projection = np.column_stack([matrix, np.zeros(3)])
    head = (stamp, interface.CAMERA_FRAME, size[1], size[0], "plumb_bob")
    return pack(layout, *head, np.zeros(5), matrix, np.eye(3), projection, np.zeros(6), False)


def packed_scene(stamp: Stamp, scene: Scene) -> bytes:
    """Return a scene as the CDR bytes of its message.

    A shape has a sequence of none or one disc, and one of none or one polygon.
    """
    dish, shapes = scene.dish, []
    for shape in scene.shapes:
        geometry, discs, polygons = shape.geometry, list[Any](), list[Any]()
        if isinstance(geometry, Disc):
            discs = [(*geometry.centre, geometry.radius)]
        else:
            polygons = [(geometry.outline, geometry.holes)]
        shapes.append((shape.name, shape.kind, discs, polygons, shape.friction))
    layout = "header text float64 float64 float64 uint8 { text text { float64[3] } { points { points } } float64 }"
    measures = (dish.diameter, dish.depth, dish.wall_friction, SELF_CONTACT[dish.self_contact])
    return pack(layout, stamp, scene.version, *measures, shapes)


def packed_tracker_state(stamp: Stamp, track: Track, processing_time: float = 0.0) -> bytes:
    """Return what the tracker makes of a frame as a TrackerState.

    Args:
        stamp: of the frame.
        track: of the frame.
        processing_time: wall-clock time it took [s]; offline it is no property of a frame, and 0.
    """
    confidence, curvature, view = 0.0, 0.0, track.view
    state = ("SEARCHING", "TRACKED", "LOST").index(track.state.name)  # as in TrackerState.msg
    if track.state.name == "TRACKED":
        confidence, curvature = track.confidence, track.curvature
    placed = ((), 0.0, 0.0) if view is None else (view.centre_px, view.metres_per_pixel, view.rotation)
    measured = (state, track.reason, confidence, curvature, processing_time)
    layout = "header uint8 text float64 float64 float64 float64[] float64 float64"
    return pack(layout, stamp, *measured, *placed)


def packed_observation(stamp: Stamp, observation: ThreadObservation) -> bytes:
    """Return what a frame shows of the thread as a ThreadObservation."""
    pieces = [
        (p.points, p.deviation, p.first_end, p.last_end, *p.arc_length, bool(p.direction_known), p.confidence)
        for p in observation.pieces
    ]
    layout = "header { points float64[] uint8 uint8 float64 float64 bool float64 } bool { points }"
    return pack(layout, stamp, pieces, bool(observation.complete), observation.hidden)


def packed_prediction(stamp: Stamp, prediction: Prediction, material: str, *, step_time: float = 0.0) -> bytes:
    """Return a PredictedThread.

    Args:
        stamp: of the pose.
        prediction: the thread.
        material: its name.
        step_time: wall-clock time that it took [s]; offline it is no property of a prediction, and 0.
    """
    tension, use, contact, pull = np.empty(0), np.empty(0), np.empty((0, 2)), (0.0, 0.0, 0.0, 0.0)
    states: tuple[FrictionState, ...] = ()
    forces = prediction.forces
    if forces is not None:
        tension, contact = forces.tension, forces.contact
        pull = (*forces.needle_force, 0.0, forces.needle_moment)
        if forces.friction_use.any():
            states, use = forces.friction_states, forces.friction_use
    nodes = np.flatnonzero(contact.any(axis=1))
    return pack(
        "header text text text points float64[] float64[] uint32[] points float64[4] uint8[] float64[] "
        "text text float64 float64 uint32 float64",
        *(stamp, prediction.formulation, prediction.scene_version, material),
        *(prediction.positions, prediction.strain, tension),
        *(nodes, contact[nodes], pull, states, use),
        *(prediction.solver, prediction.status, prediction.residual),
        *(prediction.interval, prediction.substeps, step_time),
    )


def packed_estimate(stamp: Stamp, estimate: ThreadEstimate) -> bytes:
    """Return an EstimatedThread.

    Args:
        stamp: of the frame.
        estimate: of the thread at the same time.
    """
    square, degrees = (0.0, 0) if estimate.innovations is None else estimate.innovations.total
    disturbances = []
    for force in estimate.disturbances:
        numbers = (force.arc_length, force.extent, *force.position, 0.0, *force.direction, 0.0)
        disturbances.append(((*numbers, force.force, force.significance), round(force.since * 1e9)))
    return pack(
        "header text points float64[] float64[] bool float64 float64 uint32 float64 uint32 { float64[10] time } "
        "{ text } bool float64",
        *(stamp, estimate.prediction.scene_version, estimate.positions, estimate.deviation),
        *(np.ravel(estimate.covariance), not estimate.corrected, estimate.unmeasured_for, estimate.hidden),
        *(estimate.points, square, degrees, disturbances),
        *(estimate.problems[:8], estimate.converged, estimate.residual),
    )


def packed_margins(
    stamp: Stamp, margins: Margins | None, reason: str = "", scene_version: str = "", *, of_estimate: bool = False
) -> bytes:
    """Return a SafetyMargins: every barrier, the minimum of each, and what is in contact; or why there are none.

    Args:
        stamp: of the pose.
        margins: of the thread; None where there are none.
        reason: why there are none.
        scene_version: of the scene in force where there are none.
        of_estimate: whether they are of the estimated thread; else of the predicted one.
    """
    known = Margins((), (), UNKNOWN, scene_version) if margins is None else margins
    barriers, friction = known.barriers, known.friction
    columns: list[ArrayLike] = [np.repeat(np.arange(len(barriers)), [len(barrier) for barrier in barriers])]
    for name in ("node", "obstacle", "value", "clearance", "bound"):
        columns.append(np.concatenate([getattr(barrier, name) for barrier in barriers]) if barriers else ())
    rows = [(m.barrier, m.node[0], m.obstacle[0], m.value[0], m.clearance[0], m.bound[0]) for m in known.minima]
    # As in SafetyMargins.msg.
    source, contact = (0, 0) if margins is None else (1 + of_estimate, 2 if margins.in_contact else 1)
    return pack(
        "header text bool text uint8 { text } uint8[] uint32[] int32[] float64[] float64[] float64[] "
        "{ text uint32 int32 float64 float64 float64 } uint8 uint32[] uint8 uint32[] float64",
        *(stamp, known.scene_version, margins is not None, "" if margins is not None else reason, source),
        *([barrier.barrier for barrier in barriers], *columns, rows, contact, known.in_contact),
        *(friction.state, friction.nodes, friction.slowdown),
    )


def packed_forecast(stamp: Stamp, forecast: Forecast) -> bytes:
    """Return a ThreadForecast.

    Args:
        stamp: of the needle's pose at the start.
        forecast: of a command that is held.
    """
    shown, contact, minima = forecast_instants(forecast, 11), forecast.first_contact, forecast.minima
    command = forecast.commanded[0] if len(forecast.times) > 1 else (0.0, 0.0)
    margins = list(minima.values())
    return pack(
        "header text float64[3] float64 bool text float64[] points points points { text } float64[] float64[] uint32[] "
        "{ text } float64 text uint32 float64 uint32[] float64 { text } float64 float64",
        *(stamp, forecast.scene_version, (*command, 0.0), forecast.horizon, forecast.converged, forecast.problem),
        *(forecast.times[shown], forecast.tails[shown], forecast.headings[shown]),
        *(forecast.vertices[shown].reshape(-1, 2), list(minima)),
        *([margin.value for margin in margins], [margin.time for margin in margins]),
        *([margin.node for margin in margins], [margin.shape for margin in margins]),
        *((math.nan, "", 0) if contact is None else (contact.time, contact.shape, contact.node)),
        *(time_or_nan(forecast.first_friction), forecast.friction_nodes, time_or_nan(forecast.rest_time)),
        *(forecast.stopped_by, forecast.peak_tension, forecast.peak_needle_force),
    )


def forecast_instants(forecast: Forecast, count: int) -> NDArray[np.intp]:
    """Return evenly spaced instants with the first and the last among them, at most `count`."""
    return np.unique(np.linspace(0, len(forecast.times) - 1, count).round().astype(np.intp))


def time_or_nan(value: float | None) -> float:
    """Return a time [s], NaN for never."""
    return math.nan if value is None else value


_CURRENTS = "header { text } float64[] time text bool"


def packed_currents(stamp: Stamp, command: Stamp | None, output: BridgeOutput) -> bytes:
    """Return coil currents with the stamp of the command that they follow, or why they are zero, as CoilCurrents."""
    allocation, stop = output.allocation, "; ".join(output.reasons)
    return pack(_CURRENTS, stamp, output.coils, allocation.currents, command or 0, stop, allocation.saturated)


def packed_rig_currents(stamp: Stamp, currents: Vector) -> bytes:
    """Return currents for the simulated coils, shape (m,) [A], as CoilCurrents."""
    return pack(_CURRENTS, stamp, (), currents, 0, "", False)


def _velocities(output: BridgeOutput) -> tuple[float, ...]:
    """Return the commanded, filtered and applied velocity as vectors in space [m/s]."""
    return (*output.commanded, 0.0, *output.filtered, 0.0, *output.applied, 0.0)


def packed_filter_state(stamp: Stamp, output: BridgeOutput) -> bytes:
    """Return what became of the command as a FilterState; the stamp is the command's, or the time now without one."""
    layout = "header text float64[9] float64 { text } text text"
    end = (output.slowdown, output.active, output.overridden, output.reason)
    return pack(layout, stamp, output.source, _velocities(output), *end)


def packed_bridge_state(stamp: Stamp, system: CoilSystem, driver: DriverState, refused: int) -> bytes:
    """Return what the bridge does and why as a CoilBridgeState.

    Args:
        stamp: of the message.
        system: bridge, driver and latch.
        driver: what its driver knows.
        refused: messages so far.
    """
    latch, output = system.latch, system.output
    velocities: tuple[float, ...] = (0.0,) * 9
    pull, saturated, currents, reasons = np.zeros(2), False, np.empty(0), system.closed_reasons
    if output is not None:
        velocities, pull, reasons = _velocities(output), output.pull, output.reasons
        currents, saturated = output.allocation.currents, output.allocation.saturated
    closed = output is None and not latch.latched_reason
    # As in CoilBridgeState.msg.
    state = 0 if closed else ("UNCONFIGURED", "INACTIVE", "ACTIVE", "FAULT").index(latch.state.name)
    layout = "header uint8 bool bool text { text } float64[12] bool text bool { text } float64[] float64[] float64[] "
    return pack(
        layout + "uint32",
        *(stamp, state, latch.armed, latch.emergency),
        *("" if system.bridge is None else system.bridge.scene_version, reasons, (*velocities, *pull, 0.0), saturated),
        *(system.driver_name, driver.ready, driver.warnings, currents),
        *(() if driver.currents is None else driver.currents, driver.voltages, refused),
    )


# What rig, tracker and model publish of a frame: by nodes, and into bags that are written without a graph.


def camera_outputs(
    stamp: Stamp, jpeg: NDArray[np.uint8], size: tuple[int, int], view: DishView, height: float
) -> Outputs:
    """Yield a frame and the intrinsics of a camera at a height above the dish [m]; size is width and height."""
    yield interface.COMPRESSED_IMAGE, packed_compressed_image(stamp, jpeg)
    yield interface.CAMERA_INFO, packed_camera_info(stamp, size, view, height)


def thread_outputs(stamp: Stamp, observation: ThreadObservation, centreline: Points | None) -> Outputs:
    """Yield what a frame shows of the thread; the centreline from the tail on has the shape (m, 2) [m]."""
    yield interface.THREAD_OBSERVATION, packed_observation(stamp, observation)
    if centreline is not None and len(centreline):
        yield interface.MEASURED_THREAD, packed_path(stamp, centreline)


def pose_outputs(stamp: Stamp, tail: Vector, heading: Vector, covariance: Vector) -> Outputs:
    """Yield the needle's pose; see `packed_pose`."""
    yield interface.NEEDLE_POSE, packed_pose(stamp, tail, heading, covariance)


def prediction_outputs(result: PredictionResult, material: str, step_time: float = 0.0) -> Outputs:
    """Yield the prediction of a pose, if there is one, with the time that it took [s]."""
    if result.prediction is not None:
        packed = packed_prediction(result.stamp, result.prediction, material, step_time=step_time)
        yield interface.PREDICTED_THREAD, packed


def estimate_outputs(result: PredictionResult) -> Outputs:
    """Yield the estimate of a pose, if there is one, and the margins or why there are none."""
    if result.estimate is not None:
        yield interface.ESTIMATED_THREAD, packed_estimate(result.stamp, result.estimate)
    if result.estimate is not None or not result.late:
        reason, of_estimate = "" if result.margins else result.reason, result.estimate is not None
        packed = packed_margins(result.stamp, result.margins, reason, result.scene_version, of_estimate=of_estimate)
        yield interface.MARGINS, packed


# Markers for RViz and Foxglove.


class MarkerType(IntEnum):
    """Types of markers, as in Marker.msg."""

    ARROW = 0
    CYLINDER = 3
    LINE_STRIP = 4
    SPHERE_LIST = 7
    TEXT_VIEW_FACING = 9
    TRIANGLE_LIST = 11


class Marker(NamedTuple):
    """A marker of visualization_msgs, as far as ours differ."""

    namespace: str
    number: int
    kind: int
    scale: tuple[float, float, float]
    colour: Colour
    opacity: float = 1.0
    place: Place = (0.0, 0.0, 0.0)
    points: Points = np.empty((0, 2))
    caption: str = ""
    lifetime: int = 0  # ns; 0 for ever
    action: int = 0  # as in Marker.msg: add


def _line(name: str, number: int, width: float, colour: Colour, points: Points, opacity: float = 1.0) -> Marker:
    return Marker(name, number, MarkerType.LINE_STRIP, (width, 0.0, 0.0), colour, opacity, points=points)


def _triangles(name: str, number: int, colour: Colour, corners: Points, opacity: float) -> Marker:
    return Marker(name, number, MarkerType.TRIANGLE_LIST, (1.0, 1.0, 1.0), colour, opacity, points=corners)


def _text(name: str, number: int, colour: str, place: Place, caption: str, size: float = 8e-4) -> Marker:
    kind, scale = MarkerType.TEXT_VIEW_FACING, (0.0, 0.0, size)
    return Marker(name, number, kind, scale, COLOURS[colour], place=place, caption=caption, lifetime=LIFETIME)


def packed_markers(stamp: Stamp, markers: Sequence[Marker]) -> bytes:
    """Return a MarkerArray."""
    # Header to points; then colours, a texture and its coordinates, the text, and a mesh, all empty but the text.
    layout = (
        "{ header text int32 int32 int32 float64[7] float64[3] float32[4] time bool points "
        "uint32 text time text text uint32 uint32 text text text uint32 bool }"
    )
    messages = []
    for marker in markers:
        pose = (*(*marker.place, 0.0)[:3], 0.0, 0.0, 0.0, 1.0)
        head = (stamp, marker.namespace, marker.number, marker.kind, marker.action, pose, marker.scale)
        body = ((*marker.colour, marker.opacity), marker.lifetime, False, marker.points)
        messages.append((*head, *body, 0, "", 0, "", "", 0, 0, marker.caption, "", "", 0, False))
    return pack(layout, messages)


def packed_thread_markers(
    stamp: Stamp,
    prediction: Prediction | None,
    margins: Margins | None,
    diameter: float,
    estimate: ThreadEstimate | None = None,
) -> bytes:
    """Return a MarkerArray: the thread, its nodes under friction, the minimum of each barrier; and what is estimated.

    The thread, in the namespace `thread`, is the one that the margins are of: the estimated one if there is one. The
    line has the colour of the friction, and the nodes under friction are spheres. A barrier's least clearance is
    written beside the node that has it, in the namespace `margins`, also for barriers that users added; those of
    single segments are not shown. The text disappears by its lifetime when its barrier has no row any more.

    Beside an estimate stand the predicted thread (`predicted`), the band in which the estimated one lies with a
    probability of 98 % (`deviation`), and an arrow and a text for each force that the model does not know of
    (`disturbances`).

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback": green where free, orange, darker
    with every node, where sliding under friction, blue where stuck. Deviation: grey where unknown.

    Args:
        stamp: of the pose.
        prediction: the thread; None where there is none.
        margins: of the thread; None where there are none.
        diameter: of the thread [m].
        estimate: the thread; None where there is none.
    """
    thread = prediction if estimate is None else estimate
    assert thread is not None
    width = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    friction = UNKNOWN if margins is None else margins.friction
    colour, nodes = friction_colour(friction), thread.positions
    spheres, squeezed = (2.0 * width, 2.0 * width, 2.0 * width), nodes[list(friction.nodes)]
    markers = [_line("thread", 0, width, colour, nodes)]
    markers.append(Marker("thread", 1, MarkerType.SPHERE_LIST, spheres, colour, points=squeezed))
    of_segments = (CONNECTIVITY, ENHANCED_CONNECTIVITY, COMPRESSION, STIFFNESS)
    minima = [] if margins is None else [minimum for minimum in margins.minima if minimum.barrier not in of_segments]
    for number, minimum in enumerate(minima):
        clearance = minimum.minimum_clearance
        x, y = nodes[minimum.node[0]]
        place = (x, y + (number + 1) * 1e-3)  # several may be closest at the same node
        caption = f"{minimum.barrier} {1e3 * clearance:.2f} mm"
        markers.append(_text("margins", number, "alarm" if clearance <= 0.0 else "ink", place, caption))
    if estimate is not None:
        markers.append(_triangles("deviation", 0, COLOURS["deviation"], deviation_band(estimate), 0.35))
        if prediction is not None:
            markers.append(_line("predicted", 0, 0.4 * width, COLOURS["predicted"], prediction.positions, 0.9))
        for number, force in enumerate(estimate.disturbances):  # an arrow of 2.5 mm whose head is where the force acts
            arrow = np.array([force.position - 2.5e-3 * force.direction, force.position])
            scale, name, red = (0.4 * width, 1.6 * width, 1.6 * width), "disturbances", COLOURS["alarm"]
            markers.append(Marker(name, 2 * number, MarkerType.ARROW, scale, red, points=arrow, lifetime=LIFETIME))
            behind = force.position - 3.25e-3 * force.direction
            markers.append(_text(name, 2 * number + 1, "alarm", behind, str(force)))
    return packed_markers(stamp, markers)


def deviation_band(estimate: ThreadEstimate) -> Points:
    """Return the triangles of the band within 2.33 standard deviations of the estimated thread, shape (6 n, 2) [m]."""
    # Only here: a scene server packs markers too, and needs no estimator.
    from magnetosuture_thread.estimator.estimator import ONE_SIDED_99

    nodes = estimate.positions
    along = np.gradient(nodes, axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]
    off = ONE_SIDED_99 * estimate.deviation[:, None] * across
    left, right = nodes + off, nodes - off
    corners = (left[:-1], right[:-1], left[1:], left[1:], right[:-1], right[1:])
    return np.stack(corners, axis=1).reshape(-1, 2)


def packed_forecast_markers(stamp: Stamp, forecast: Forecast) -> bytes:
    """Return a MarkerArray in the namespace `forecast`: the thread at three instants, and what happens when.

    The line is fainter the later the instant. The text stands beside the node of the first contact, else beside the
    needle's tail at the end. All disappear by themselves half a second after the last forecast.
    """
    markers = []
    for number, instant in enumerate(forecast_instants(forecast, 4)[1:]):
        ghost = _line("forecast", number, 1.5e-4, COLOURS["forecast"], forecast.vertices[instant], 0.8 - 0.2 * number)
        markers.append(ghost._replace(lifetime=LIFETIME))
    contact, caption = forecast.first_contact, forecast_text(forecast)
    if caption:
        place = forecast.tails[-1]
        if contact is not None:
            place = forecast.vertices[int(np.searchsorted(forecast.times, contact.time)), contact.node]
        markers.append(_text("forecast", 3, "alarm", place, caption))
    return packed_markers(stamp, markers)


def forecast_text(forecast: Forecast) -> str:
    """Return what will happen and when, for a person; empty where nothing does. See `forecast_events`."""
    contact = forecast.first_contact
    time, shape = (math.nan, "") if contact is None else (contact.time, contact.shape)
    friction, rest = time_or_nan(forecast.first_friction), time_or_nan(forecast.rest_time)
    return ", ".join(forecast_events(time, shape, friction, rest))


def forecast_events(contact: float, shape: str, friction: float, rest: float) -> list[str]:
    """Return what will happen and when, for a person, the first event first. What holds already is not announced.

    Args:
        contact: when the thread first touches something [s]; NaN for never, as for the other times.
        shape: that it touches, or "wall".
        friction: when its first node is under friction [s].
        rest: when the needle comes to rest although it is commanded to move [s].
    """
    events = []
    if contact > 0.0:
        events.append((contact, f"touches the {shape.replace('_', ' ')} in {contact:.1f} s"))
    if friction > 0.0:
        events.append((friction, f"friction in {friction:.1f} s"))
    if rest >= 0.0:
        events.append((rest, f"needle rests in {rest:.1f} s" if rest > 0.0 else "needle rests"))
    return [text for _, text in sorted(events)]


def packed_scene_markers(stamp: Stamp, scene: Scene) -> bytes:
    """Return a MarkerArray of a scene in place of the one before: the rim, each shape in its kind's colour, its name.

    A disc is a flat cylinder, a polygon the triangles that it is cut into.
    """
    diameter, thickness = scene.dish.diameter, 1e-3  # m; the latter of a disc's cylinder
    angles = np.linspace(0.0, 2.0 * math.pi, 181)
    rim = scene.dish.radius * np.column_stack([np.cos(angles), np.sin(angles)])
    delete_all = Marker("", 0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, action=3)
    markers = [delete_all, _line("dish", 0, 0.005 * diameter, COLOURS["rim"], rim, 0.8)]
    for index, shape in enumerate(scene.shapes):
        geometry, colour = shape.geometry, COLOURS[shape.kind]
        if isinstance(geometry, Disc):
            scale = (2.0 * geometry.radius, 2.0 * geometry.radius, thickness)
            markers.append(Marker("shapes", index, MarkerType.CYLINDER, scale, colour, 0.8, geometry.centre))
        else:
            markers.append(_triangles("shapes", index, colour, triangulate(geometry).reshape(-1, 2), 0.8))
        name = _text("names", index, "ink", (*shape.label_point, thickness), shape.name, 0.025 * diameter)
        markers.append(name._replace(lifetime=0))
    return packed_markers(stamp, markers)
