"""Conversions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from hypothesis import given
from hypothesis import strategies as st
from magnetosuture_msgs.msg import CoilBridgeState, ThreadMaterial, TrackerState
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import Marker

from magnetosuture_thread.bags.message_types import MESSAGES as BAG_MESSAGES
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.coils.latch import ArmingState
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.messages import building, reading
from magnetosuture_thread.messages.building import MessageBuilder
from magnetosuture_thread.model.settings import parse_material
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.messages import MESSAGES, serialised_velocity
from magnetosuture_thread.scene import Dish, Scene, SceneShape
from magnetosuture_thread.vision.look import State, no_pose

STAMP = Time(sec=3, nanosec=500_000_000)
TAIL, HEADING = np.array([1e-3, -2e-3]), np.array([-0.6, 0.8])


@given(angle=st.floats(-math.pi, math.pi), x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1))
def test_a_pose_goes_there_and_back(angle: float, x: float, y: float):
    heading = np.array([math.cos(angle), math.sin(angle)])
    found = reading.needle_pose(MESSAGES.pose_message(STAMP, np.array([x, y]), heading))
    assert found.stamp == 3.5
    np.testing.assert_allclose(found.tail, [x, y])
    np.testing.assert_allclose(found.heading, heading, atol=1e-12)


def test_a_pose_whose_heading_is_unknown_by_its_covariance_is_refused():
    message = MESSAGES.pose_message(STAMP, np.zeros(2), np.array([1.0, 0.0]))
    message.pose.covariance[-1] = 0.9**2
    assert reading.needle_pose(message).stamp == 3.5
    message.pose.covariance[-1] = math.pi**2
    with pytest.raises(InvalidInputError, match="the heading is unknown"):
        reading.needle_pose(message)


def test_a_needle_that_stands_upright_has_no_heading():
    message = MESSAGES.pose_message(STAMP, np.zeros(2), np.array([1.0, 0.0]))
    message.pose.pose.orientation = Quaternion(y=math.sqrt(0.5), w=math.sqrt(0.5))
    with pytest.raises(InvalidInputError, match="an x axis in the dish plane"):
        reading.needle_pose(message)


@pytest.mark.parametrize("value", [0.5, 1e200, 1e308, -1e308, float("inf"), float("nan")])
@pytest.mark.parametrize("axis", ["x", "y", "z", "w"])
def test_an_orientation_that_is_none_is_refused_whatever_it_holds(value: float, axis: str):
    message = MESSAGES.pose_message(STAMP, np.zeros(2), np.array([0.6, 0.8]))
    setattr(message.pose.pose.orientation, axis, value)
    with pytest.raises(InvalidInputError, match="a unit quaternion"):
        reading.needle_pose(message)


@pytest.mark.parametrize("nanosec", [10**9, 2**32 - 1])
def test_a_stamp_of_more_than_a_second_of_nanoseconds_is_none(nanosec: int):
    message = MESSAGES.pose_message(Time(sec=2**31 - 1, nanosec=nanosec), np.zeros(2), np.array([1.0, 0.0]))
    with pytest.raises(InvalidInputError, match=r"header\.stamp\.nanosec"):
        reading.needle_pose(message)


@given(sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 10**9 - 1))
def test_a_stamp_goes_there_and_back(sec: int, nanosec: int):
    stamp = Time(sec=sec, nanosec=nanosec)
    assert MESSAGES.time(reading.nanoseconds(stamp)) == stamp


def test_a_material_becomes_parameters():
    """Plain numbers: of arrays, as messages have them, no parameter is made."""
    assert parse_material(ThreadMaterial()) == {}
    message = ThreadMaterial(name="silk_6_0", viscosity=0.9, attachment_offset=[1e-3, 0.0], rest_curvature=[0.0])
    values = parse_material(message)
    assert values == {
        "material": "silk_6_0",
        "diameter": 0.0,
        "elastic_modulus": 0.0,
        "paper_stiffness_weight": 0.0,
        "viscosity": 0.9,
        "rest_curvature": 0.0,
        "attachment_offset": [1e-3, 0.0],
    }
    assert {type(value) for value in values.values()} == {str, float, list}


def test_a_path_shares_nothing_with_the_one_made_before():
    points = np.random.default_rng(1).normal(size=(9, 2))
    first = MESSAGES.path_message(STAMP, points)
    shorter = MESSAGES.path_message(Time(sec=9), points[:3] + 1.0)
    np.testing.assert_array_equal(reading.path_points(shorter), points[:3] + 1.0)
    assert shorter.header.stamp.sec == shorter.poses[2].header.stamp.sec == 9
    np.testing.assert_array_equal(reading.path_points(first), points)


def test_the_numbers_of_states_and_markers_are_those_of_the_messages():
    for name, number in building.STATES.items():
        assert getattr(TrackerState, f"STATE_{name}") == number
    assert CoilBridgeState.STATE_UNCONFIGURED == building.UNCONFIGURED
    for name, number in building.CONDITIONS.items():
        assert getattr(CoilBridgeState, f"STATE_{name}") == number
    assert set(building.STATES) == {state.name for state in State}
    assert set(building.CONDITIONS) == {condition.name for condition in ArmingState}
    kinds = (Marker.LINE_STRIP, Marker.TRIANGLE_LIST, Marker.CYLINDER, Marker.TEXT_VIEW_FACING)
    assert kinds == (building.LINE_STRIP, building.TRIANGLE_LIST, building.CYLINDER, building.TEXT)
    assert (Marker.ADD, Marker.DELETEALL) == (building.ADD, building.DELETE_ALL)


DISH = Scene(Dish(0.035, 0.01), (SceneShape("post", "tissue", Disc((0.0, 0.009), 0.002)),))
VIEW = DishView((320.0, 240.0), 1e-4)


@pytest.mark.parametrize(
    ("type_name", "build"),
    [
        ("geometry_msgs/msg/PoseWithCovarianceStamped", lambda m: m.pose_message(7, TAIL, HEADING, np.eye(3))),
        ("geometry_msgs/msg/PoseStamped", lambda m: m.placed(7, TAIL, 0.3)),
        ("geometry_msgs/msg/TwistStamped", lambda m: m.twist_message(7, TAIL)),
        ("nav_msgs/msg/Path", lambda m: m.path_message(7, np.stack([TAIL, HEADING]))),
        ("sensor_msgs/msg/CompressedImage", lambda m: m.compressed_image(7, np.arange(9, dtype=np.uint8))),
        ("sensor_msgs/msg/Image", lambda m: m.image(7, np.arange(24, dtype=np.uint8).reshape(2, 4, 3))),
        ("sensor_msgs/msg/CameraInfo", lambda m: m.camera_info(7, (640, 480), VIEW, 0.3)),
        ("magnetosuture_msgs/msg/TrackerState", lambda m: m.tracker_state(7, no_pose(State.LOST, "glare", VIEW))),
        ("magnetosuture_msgs/msg/Scene", lambda m: m.scene_message(7, DISH)),
        ("visualization_msgs/msg/MarkerArray", lambda m: m.scene_markers(7, DISH)),
    ],
)
def test_rclpy_and_rosbags_get_the_same_message(type_name: str, build: Callable[[MessageBuilder], Any]):
    store = typestore()
    theirs = store.serialize_cdr(build(BAG_MESSAGES), type_name)
    kind = type(build(MESSAGES))
    assert deserialize_message(bytes(theirs), kind) == deserialize_message(serialize_message(build(MESSAGES)), kind)


def test_paths_and_velocities_go_there_and_back():
    points = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_array_equal(reading.path_points(MESSAGES.path_message(STAMP, points)), points)
    assert reading.path_points(MESSAGES.path_message(STAMP, np.empty((0, 2)))).shape == (0, 2)
    twist = MESSAGES.twist_message(STAMP, np.array([1.0, -2.0]))
    np.testing.assert_array_equal(reading.plane_velocity(twist, "needle/servo_cv"), [1.0, -2.0])
    np.testing.assert_array_equal(serialised_velocity(serialize_message(twist)), [1.0, -2.0])


@pytest.mark.parametrize("topic", [*topics.INPUTS, *topics.OUTPUTS, *topics.SETTINGS], ids=lambda topic: topic.name)
def test_every_topic_has_a_type_that_bags_know(topic: topics.Topic):
    assert topic.channel.type_name in typestore().fielddefs


def test_the_bags_and_the_graph_have_the_same_own_messages():
    """The same bytes mean the same in both: a type that was rebuilt in one place only would differ."""
    for topic in (
        topics.PREDICTED_THREAD,
        topics.MARGINS,
        topics.CURRENTS,
        topics.BRIDGE_STATE,
        topics.FILTER_STATE,
        topics.TRACKER_STATE,
        topics.THREAD_OBSERVATION,
        *topics.SETTINGS,
    ):
        fields = [name for name, _ in typestore().fielddefs[topic.channel.type_name][1]]
        assert fields == list(topic.message().get_fields_and_field_types())
