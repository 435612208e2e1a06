"""Between the thread model's messages and its core's own types."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from magnetosuture_msgs.msg import (
    ObstacleSet,
    SteeringState,
    ThreadMaterial,
)
from rclpy.serialization import deserialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon, triangulate
from magnetosuture_thread.interface import OBSTACLE_SET
from magnetosuture_thread.model import changes
from magnetosuture_thread.model.steering import Steered
from magnetosuture_thread.nodes.messages import flat_pose, header, point_list, require_dish_frame, vector
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


def steering_state(stamp: Time, what: Steered) -> SteeringState:
    """Return what became of a velocity that was asked for; `stamp` is that of the asking."""
    return SteeringState(
        header=header(stamp),
        asked=vector(what.asked),
        passed=vector(what.passed),
        slowdown=what.slowdown,
        held_off=what.held_off,
        reason=what.reason,
    )


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
