"""Between the thread model's messages and its core's own types."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from magnetosuture_msgs.msg import (
    BarrierMargin,
    PredictedThread,
    SafetyMargins,
    ThreadMaterial,
)
from rclpy.serialization import deserialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon, triangulate
from magnetosuture_thread.model import changes
from magnetosuture_thread.model.friction import Friction, friction_colour
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.nodes.messages import flat_pose, header, point_list
from magnetosuture_thread.nodes.topics import Topic


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
        scene_version=prediction.scene_version,
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
    message = SafetyMargins(
        header=header(stamp),
        scene_version=margins.scene_version,
        valid=True,
        contact_state=SafetyMargins.CONTACT_FREE,
    )
    for name in ("kind", "node", "obstacle", "value", "clearance"):
        setattr(message, name, getattr(margins, name))
    message.least = [BarrierMargin(**vars(least)) for least in margins.least]
    if margins.touching:
        message.contact_state = SafetyMargins.CONTACT_TOUCHING
        message.contact_nodes = list(margins.touching)
    friction = margins.friction
    message.friction_state, message.slowdown = int(friction.state), friction.slowdown
    message.friction_nodes = list(friction.nodes)
    return message


def invalid_margins(stamp: Time, reason: str, scene_version: str = "") -> SafetyMargins:
    """Return a margins message that says that there are none, and why, in the scene in force."""
    return SafetyMargins(
        header=header(stamp),
        scene_version=scene_version,
        valid=False,
        reason=reason,
        contact_state=SafetyMargins.CONTACT_UNKNOWN,
        friction_state=SafetyMargins.FRICTION_UNKNOWN,
        slowdown=1.0,
    )


def thread_markers(stamp: Time, prediction: Prediction, friction: Friction, diameter: float) -> MarkerArray:
    """Return the predicted thread as a line in the colour of its friction, and the nodes under friction as balls.

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback": green where free, orange, darker
    with every node, where pulled under friction, blue where it rests. Deviation: grey where nobody knows.
    """
    line = Marker(header=header(stamp), ns="thread", id=0, type=Marker.LINE_STRIP, action=Marker.ADD)
    line.pose = flat_pose(np.zeros(2), 0.0)
    line.scale.x = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    line.points = point_list(prediction.vertices)
    red, green, blue = friction_colour(friction)
    line.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    balls = Marker(header=header(stamp), ns="thread", id=1, type=Marker.SPHERE_LIST, action=Marker.ADD)
    balls.pose = flat_pose(np.zeros(2), 0.0)
    balls.scale = Vector3(x=2.0 * line.scale.x, y=2.0 * line.scale.x, z=2.0 * line.scale.x)
    balls.color = line.color
    balls.points = point_list(prediction.vertices[list(friction.nodes)])
    return MarkerArray(markers=[line, balls])


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


def material_values(message: ThreadMaterial) -> dict[str, Any]:
    """Return the settings, by name, that a material changes."""
    return changes.told_material(message)
