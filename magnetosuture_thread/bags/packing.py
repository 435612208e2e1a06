"""Packs the messages of the graph as CDR bytes, which nodes publish and bags store as they are.

Each layout has the fields of the message's definition in their order; stamps are nanoseconds or time messages.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magnetosuture_thread.bags.cdr import BEGIN, DISH_END, Stamp, aligned, pack
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import heading_angle, yaw_quaternion
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.settings import interface
from magnetosuture_thread.thread.margins import UNKNOWN, FrictionState, Margins
from magnetosuture_thread.thread.prediction import Prediction

if TYPE_CHECKING:
    from magnetosuture_thread.coils.bridge import BridgeOutput
    from magnetosuture_thread.coils.coil_system import CoilSystem
    from magnetosuture_thread.coils.drivers import DriverState
    from magnetosuture_thread.estimator import ThreadEstimate
    from magnetosuture_thread.estimator.thread_session import PredictionResult
    from magnetosuture_thread.forecast import Forecast
    from magnetosuture_thread.vision.tracker import Track

Vector = NDArray[np.float64]
Outputs = Iterator[tuple[interface.Channel, bytes]]

IN_PLANE = (0, 1, 5)  # x, y and the turn about z among ROS's six coordinates of a pose


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


PATH_AT = aligned(DISH_END, 4) + 4  # where the poses of a path begin, behind their count
_POSITION_AT = aligned(DISH_END, 8) - len(BEGIN)  # in a pose that begins at a multiple of 8
PATH_POSES = np.dtype(  # all but the first begin there
    {
        "names": ["time", "frame", "x", "y", "z", "w"],  # z and w of the quaternion
        "formats": ["V8", f"V{DISH_END - len(BEGIN) - 8}", "<f8", "<f8", "<f8", "<f8"],
        "offsets": [0, 8, *(_POSITION_AT + np.array([0, 8, 40, 48])).tolist()],
        "itemsize": _POSITION_AT + 56,
    }
)
PATH_GAP = aligned(PATH_AT, 8) - PATH_AT  # bytes more before the first position, by the length of the frame's name


def packed_path(stamp: Stamp, points: Points) -> bytes:
    """Return a polyline of shape (m, 2) [m], or x, y [m] and angle [rad] of poses, shape (m, 3), as a Path."""
    poses = np.zeros(len(points), PATH_POSES)
    header = packed_header(stamp)[len(BEGIN) :]
    poses["time"], poses["frame"] = np.void(header[:8]), np.void(header[8:])
    half = 0.5 * points[:, 2] if points.shape[1:] == (3,) else np.zeros(len(points))
    poses["x"], poses["y"], poses["z"], poses["w"] = points[:, 0], points[:, 1], np.sin(half), np.cos(half)
    data = poses.tobytes()
    data = data[:_POSITION_AT] + bytes(PATH_GAP if len(points) else 0) + data[_POSITION_AT:]
    return pack("header uint32 raw", stamp, len(points), data)


def packed_point(stamp: Stamp, point: Vector) -> bytes:
    """Return a point in the dish plane, shape (2,) [m], as a PointStamped."""
    return pack("header float64[3]", stamp, (point[0], point[1], 0.0))


def packed_twist(stamp: Stamp, velocity: Vector) -> bytes:
    """Return a velocity of shape (2,) [m/s] as a TwistStamped."""
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
    layout, values = ["header uint32"], [stamp, len(observation.pieces)]
    for piece in observation.pieces:
        layout.append("points float64[] uint8 uint8 float64 float64 bool float64")
        values += [piece.points, piece.deviation, piece.first_end, piece.last_end]
        values += [*piece.arc_length, bool(piece.direction_known), piece.confidence]
    layout += ["bool uint32", *["points"] * len(observation.hidden)]
    values += [bool(observation.complete), len(observation.hidden), *observation.hidden]
    return pack(" ".join(layout), *values)


def packed_prediction(stamp: Stamp, prediction: Prediction, material: str, *, step_time: float = 0.0) -> bytes:
    """Return a PredictedThread.

    Args:
        stamp: of the pose.
        prediction: the thread.
        material: its name.
        step_time: wall-clock time that it took [s]; offline it is no property of a prediction, and told as 0.
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
    disturbances: list[Any] = []
    for found in estimate.disturbances:
        numbers = (found.arc_length, found.extent, *found.position, 0.0, *found.direction, 0.0)
        disturbances += [(*numbers, found.force, found.significance), round(found.since * 1e9)]
    layout = "header text points float64[] float64[] bool float64 float64 uint32 float64 uint32 uint32 "
    return pack(
        layout + "float64[10] time " * len(estimate.disturbances) + "texts bool float64",
        *(stamp, estimate.prediction.scene_version, estimate.positions, estimate.deviation),
        *(np.ravel(estimate.covariance), not estimate.corrected, estimate.unmeasured_for, estimate.hidden),
        *(estimate.points, square, degrees, len(estimate.disturbances), *disturbances),
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
    rows: list[Any] = []
    for row in known.minima:
        rows += [row.barrier, row.node[0], row.obstacle[0], row.value[0], row.clearance[0], row.bound[0]]
    # As in SafetyMargins.msg.
    source, contact = (0, 0) if margins is None else (1 + of_estimate, 2 if margins.in_contact else 1)
    return pack(
        "header text bool text uint8 texts uint8[] uint32[] int32[] float64[] float64[] float64[] uint32 "
        + "text uint32 int32 float64 float64 float64 " * len(known.minima)
        + "uint8 uint32[] uint8 uint32[] float64",
        *(stamp, known.scene_version, margins is not None, "" if margins is not None else reason, source),
        *([barrier.barrier for barrier in barriers], *columns, len(known.minima), *rows, contact, known.in_contact),
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
        "header text float64[3] float64 bool text float64[] points points points texts float64[] float64[] uint32[] "
        "texts float64 text uint32 float64 uint32[] float64 texts float64 float64",
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


_CURRENTS = "header texts float64[] time text bool"


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
    layout = "header text float64[9] float64 texts text text"
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
    drift, saturated, currents, reasons = 0.0, False, np.empty(0), system.closed_reasons
    if output is not None:
        velocities, drift, reasons = _velocities(output), output.drift, output.reasons
        currents, saturated = output.allocation.currents, output.allocation.saturated
    closed = output is None and not latch.latched_reason
    # As in CoilBridgeState.msg.
    state = 0 if closed else ("UNCONFIGURED", "INACTIVE", "ACTIVE", "FAULT").index(latch.state.name)
    layout = "header uint8 bool bool text texts float64[9] float64 bool text bool texts float64[] float64[] float64[] "
    return pack(
        layout + "uint32",
        *(stamp, state, latch.armed, latch.emergency),
        *("" if system.bridge is None else system.bridge.scene_version, reasons, velocities, drift, saturated),
        *(system.driver_name, driver.ready, driver.warnings, currents),
        *(() if driver.currents is None else driver.currents, driver.voltages, refused),
    )


# What rig, tracker and model publish of a frame: by nodes, and into bags that are written without a graph.


def camera_outputs(
    stamp: Stamp, jpeg: NDArray[np.uint8], size: tuple[int, int], view: DishView, height: float
) -> Outputs:
    """Give a frame and the intrinsics of a camera at a height above the dish [m]; size is width and height."""
    yield interface.COMPRESSED_IMAGE, packed_compressed_image(stamp, jpeg)
    yield interface.CAMERA_INFO, packed_camera_info(stamp, size, view, height)


def thread_outputs(stamp: Stamp, observation: ThreadObservation, centreline: Points | None) -> Outputs:
    """Give what a frame shows of the thread; the centreline from the tail on has the shape (m, 2) [m]."""
    yield interface.THREAD_OBSERVATION, packed_observation(stamp, observation)
    if centreline is not None and len(centreline):
        yield interface.MEASURED_THREAD, packed_path(stamp, centreline)


def pose_outputs(
    stamp: Stamp, tail: NDArray[np.float64], heading: NDArray[np.float64], covariance: NDArray[np.float64]
) -> Outputs:
    """Give the needle's pose; see `packed_pose`."""
    yield interface.NEEDLE_POSE, packed_pose(stamp, tail, heading, covariance)


def prediction_outputs(result: PredictionResult, material: str, step_time: float = 0.0) -> Outputs:
    """Give the prediction of a pose, if there is one, with the time that it took [s]."""
    if result.prediction is not None:
        yield (
            interface.PREDICTED_THREAD,
            packed_prediction(result.stamp, result.prediction, material, step_time=step_time),
        )


def estimate_outputs(result: PredictionResult) -> Outputs:
    """Give the estimate of a pose, if there is one, and the margins or why there are none."""
    if result.estimate is not None:
        yield interface.ESTIMATED_THREAD, packed_estimate(result.stamp, result.estimate)
    if result.estimate is not None or not result.late:
        reason, of_estimate = "" if result.margins else result.reason, result.estimate is not None
        packed = packed_margins(result.stamp, result.margins, reason, result.scene_version, of_estimate=of_estimate)
        yield interface.MARGINS, packed
