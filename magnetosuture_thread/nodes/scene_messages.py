"""Scenes as messages of the graph: the scene itself, and markers that viewers draw."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from magnetosuture_msgs.msg import Scene as SceneMessage
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from magnetosuture_thread.geometry.obstacles import Disc, triangulate
from magnetosuture_thread.nodes.messages import flat_pose, header, point_list
from magnetosuture_thread.scene import Scene, SceneShape, messages

COLOURS = {"tissue": (0.85, 0.65, 0.6), "instrument": (0.55, 0.6, 0.66), "wall": (0.45, 0.42, 0.38)}
RIM = (0.45, 0.5, 0.55)
INK = (0.13, 0.19, 0.24)
THICKNESS = 1e-3  # m; of a disc's cylinder
RIM_POINTS = 180
NAME_SIZE = 0.025  # of the dish's diameter


def scene_message(stamp: Time, scene: Scene) -> SceneMessage:
    """Return a scene as a message."""
    return messages.build_scene_message(scene, header(stamp), _make)


def scene_markers(stamp: Time, scene: Scene) -> MarkerArray:
    """Return a scene in place of the one before: the dish's rim, each shape in the colour of its kind, and its name.

    A disc is a flat cylinder, a polygon the triangles that it is cut into.
    """
    angles = np.linspace(0.0, 2.0 * math.pi, RIM_POINTS + 1)
    rim = _marker(stamp, "dish", 0, Marker.LINE_STRIP, RIM)
    rim.scale.x = 0.005 * scene.dish.diameter
    rim.points = point_list(scene.dish.radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    markers = [Marker(header=header(stamp), action=Marker.DELETEALL), rim]
    for index, shape in enumerate(scene.shapes):
        markers += [_shape(stamp, index, shape), _name(stamp, index, shape, NAME_SIZE * scene.dish.diameter)]
    return MarkerArray(markers=markers)


def _make(type_name: str, **fields: Any) -> Any:
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)(**fields)


def _marker(stamp: Time, namespace: str, index: int, kind: int, colour: tuple[float, float, float]) -> Marker:
    marker = Marker(header=header(stamp), ns=namespace, id=index, type=kind, action=Marker.ADD)
    marker.pose = flat_pose(np.zeros(2), 0.0)
    red, green, blue = colour
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=0.8)
    return marker


def _shape(stamp: Time, index: int, shape: SceneShape) -> Marker:
    geometry = shape.geometry
    if isinstance(geometry, Disc):
        marker = _marker(stamp, "shapes", index, Marker.CYLINDER, COLOURS[shape.kind])
        marker.pose = flat_pose(np.asarray(geometry.centre), 0.0)
        marker.scale = Vector3(x=2.0 * geometry.radius, y=2.0 * geometry.radius, z=THICKNESS)
        return marker
    marker = _marker(stamp, "shapes", index, Marker.TRIANGLE_LIST, COLOURS[shape.kind])
    marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
    cut = triangulate(geometry)
    marker.points = point_list(cut.vertices[cut.triangles].reshape(-1, 2))
    return marker


def _name(stamp: Time, index: int, shape: SceneShape, size: float) -> Marker:
    marker = _marker(stamp, "names", index, Marker.TEXT_VIEW_FACING, INK)
    marker.color.a = 1.0
    marker.text, marker.scale.z = shape.name, size
    marker.pose = flat_pose(np.asarray(shape.label_point), 0.0)
    marker.pose.position.z = THICKNESS
    return marker
