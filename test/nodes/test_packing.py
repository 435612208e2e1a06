"""Packed messages are those that rclpy itself would make."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Vector3
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from magnetosuture_thread.messages import reading
from magnetosuture_thread.messages.packing import packed_markers, packed_path, packed_pose
from magnetosuture_thread.model.margins import UNKNOWN, Friction, FrictionState, friction_colour
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.nodes.messages import MESSAGES

WHEN, STAMP = (12, 345), Time(sec=12, nanosec=345)


def same(data: bytes, expected: Any) -> None:
    """Compare bytes with a message; what fills the places between fields is nobody's."""
    assert len(data) == len(serialize_message(expected))
    kind = type(expected)
    assert deserialize_message(data, kind) == deserialize_message(serialize_message(expected), kind)


@pytest.mark.parametrize("when", [WHEN, (-3, 999_999_999), (0, 4_000_000_000)])
@pytest.mark.parametrize("known", [True, False])
def test_a_pose_is_packed_as_rclpy_makes_it(when: tuple[int, int], known: bool):
    covariance = np.arange(1.0, 10.0).reshape(3, 3) if known else None
    tail, heading = np.array([1e-3, -2e-3]), np.array([-0.6, 0.8])
    expected = MESSAGES.pose_message(Time(sec=when[0], nanosec=when[1]), tail, heading, covariance)
    data = packed_pose(when, tail, heading, covariance)
    same(data, expected)


@pytest.mark.parametrize("count", [0, 1, 2, 64])
def test_a_path_is_packed_as_rclpy_makes_it(count: int):
    points = np.random.default_rng(count).normal(size=(count, 2))
    expected = MESSAGES.path_message(STAMP, points)
    data = packed_path(WHEN, points)
    same(data, expected)


def marker(number: int, kind: int, scale: Vector3, friction: Friction, points: np.ndarray) -> Marker:
    """Return what rclpy makes of a marker."""
    made = Marker(header=MESSAGES.header(STAMP), ns="thread", id=number, type=kind, action=Marker.ADD, scale=scale)
    made.pose = MESSAGES.flat_pose(np.zeros(2), 0.0)
    red, green, blue = friction_colour(friction)
    made.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    made.points = [Point(x=x, y=y) for x, y in points.tolist()]
    return made


@pytest.mark.parametrize("segments", [3, 4, 25])
@pytest.mark.parametrize(
    "friction", [UNKNOWN, Friction(FrictionState.FREE, (), 1.0), Friction(FrictionState.SLIDING, (1, 3), 0.81)]
)
@pytest.mark.parametrize("diameter", [1e-5, 1e-3])
def test_markers_are_packed_as_rclpy_makes_them(segments: int, friction: Friction, diameter: float):
    vertices = np.random.default_rng(segments).normal(size=(segments + 1, 2))
    none: Any = None
    prediction = Prediction(1.0, "rod", "", vertices, np.zeros(segments), 0.0, 0, "", "", 0.0, True, none)
    width = max(4.0 * diameter, 2e-4)
    balls = Vector3(x=2.0 * width, y=2.0 * width, z=2.0 * width)
    expected = MarkerArray(
        markers=[
            marker(0, Marker.LINE_STRIP, Vector3(x=width), friction, vertices),
            marker(1, Marker.SPHERE_LIST, balls, friction, vertices[list(friction.nodes)]),
        ]
    )
    same(packed_markers(WHEN, prediction, friction, diameter), expected)


def test_a_pose_that_is_handed_over_is_that_of_its_message():
    for angle in np.random.default_rng(1).uniform(-np.pi, np.pi, 1000):
        tail, heading = np.array([angle * 1e-3, -angle]), np.array([np.cos(angle), np.sin(angle)])
        told = reading.needle_pose(deserialize_message(packed_pose(WHEN, tail, heading), PoseWithCovarianceStamped))
        handed = reading.tracked_pose(STAMP, tail, heading)
        assert told.stamp == handed.stamp
        assert told.tail.tobytes() == handed.tail.tobytes()
        assert told.heading.tobytes() == handed.heading.tobytes()
