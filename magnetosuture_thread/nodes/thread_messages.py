"""Between the thread model's messages and its core's own types."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from magnetosuture_msgs.msg import (
    BarrierMargin,
    ObstacleSet,
    PredictedThread,
    SafetyMargins,
    ThreadMaterial,
)
from rclpy.serialization import deserialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon, triangulate
from magnetosuture_thread.interface import OBSTACLE_SET
from magnetosuture_thread.model import changes
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.nodes.messages import flat_pose, header, point_list, require_dish_frame
from magnetosuture_thread.nodes.topics import Topic

FULL_COLOUR_CLEARANCE = 1e-3  # m; markers turn from green to red over this


def decoded(topic: Topic, data: bytes) -> Any:
    """Return a message that came as bytes.

    Raises:
        InvalidInputError: they are cut off, or those of another definition of the type.
    """
    try:
        return deserialize_message(data, topic.message)
    except RuntimeError:  # rclpy's own kind of it is private
        wanted = f"a {topic.channel.type_name} of our definition"
        raise InvalidInputError(topic.channel.name, f"{len(data)} bytes", wanted) from None


def prediction_message(stamp: Time, prediction: Prediction, material: str, step_time: float) -> PredictedThread:
    """Return a predicted thread; `step_time` is the wall-clock time it took [s]."""
    return PredictedThread(
        header=header(stamp),
        formulation=prediction.formulation,
        material=material,
        vertices=point_list(prediction.vertices),
        stretch=prediction.stretch.tolist(),
        solver=prediction.solver,
        solver_status=prediction.status,
        residual=prediction.residual,
        interval=prediction.interval,
        substeps=prediction.substeps,
        step_time=step_time,
    )


def margins_message(stamp: Time, margins: Margins) -> SafetyMargins:
    """Return every barrier of a prediction, the least of each kind, and what touches."""
    message = SafetyMargins(header=header(stamp), valid=True, contact_state=SafetyMargins.CONTACT_FREE)
    for name in ("kind", "node", "obstacle", "value", "clearance"):
        setattr(message, name, getattr(margins, name))
    message.least = [BarrierMargin(**vars(least)) for least in margins.least]
    if margins.touching:
        message.contact_state = SafetyMargins.CONTACT_TOUCHING
        message.contact_nodes = list(margins.touching)
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
    line.pose = flat_pose(np.zeros(2), 0.0)
    line.scale.x = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    line.points = point_list(prediction.vertices)
    safe = np.clip(clearance / FULL_COLOUR_CLEARANCE, 0.0, 1.0)
    line.colors = [ColorRGBA(r=float(1.0 - s), g=float(0.75 * s), b=0.1, a=1.0) for s in safe]
    return MarkerArray(markers=[line])


def obstacle_markers(stamp: Time, obstacles: Sequence[Obstacle]) -> MarkerArray:
    """Return the obstacles, in place of those before: discs as flat cylinders, polygons as their triangles."""
    markers = [Marker(header=header(stamp), ns="obstacles", action=Marker.DELETEALL)]
    for index, obstacle in enumerate(obstacles):
        marker = Marker(header=header(stamp), ns="obstacles", id=index, action=Marker.ADD)
        marker.color = ColorRGBA(r=0.85, g=0.65, b=0.6, a=0.8)
        if isinstance(obstacle, Disc):
            marker.type = Marker.CYLINDER
            marker.pose = flat_pose(np.asarray(obstacle.centre), 0.0)
            marker.scale = Vector3(x=2.0 * obstacle.radius, y=2.0 * obstacle.radius, z=1e-3)
        elif isinstance(obstacle, Polygon):
            shape = triangulate(obstacle)
            marker.type = Marker.TRIANGLE_LIST
            marker.pose = flat_pose(np.zeros(2), 0.0)
            marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
            marker.points = point_list(shape.vertices[shape.triangles].reshape(-1, 2))
        markers.append(marker)
    return MarkerArray(markers=markers)


def obstacle_values(message: ObstacleSet) -> dict[str, Any]:
    """Return the settings, by name, that a set of obstacles changes.

    Raises:
        InvalidInputError: wrong frame.
    """
    require_dish_frame(message.header.frame_id, OBSTACLE_SET.name)
    return changes.told_obstacles(message)


def material_values(message: ThreadMaterial) -> dict[str, Any]:
    """Return the settings, by name, that a material changes."""
    return changes.told_material(message)
