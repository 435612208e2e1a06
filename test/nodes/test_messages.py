"""Conversions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from hypothesis import given
from hypothesis import strategies as st
from magnetosuture_msgs.msg import BarrierMargin, ThreadMaterial
from rclpy.serialization import serialize_message

from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.model.barriers import BarrierKind
from magnetosuture_thread.nodes import messages, thread_messages, topics
from magnetosuture_thread.resources import share_directory
from magnetosuture_thread.study.replayed import KINDS

STAMP = Time(sec=3, nanosec=500_000_000)


@given(angle=st.floats(-math.pi, math.pi), x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1))
def test_a_pose_goes_there_and_back(angle: float, x: float, y: float):
    heading = np.array([math.cos(angle), math.sin(angle)])
    found = messages.needle_pose(messages.pose_message(STAMP, np.array([x, y]), heading))
    assert found.stamp == 3.5
    np.testing.assert_allclose(found.tail, [x, y])
    np.testing.assert_allclose(found.heading, heading, atol=1e-12)


def test_a_needle_that_stands_upright_has_no_heading():
    message = messages.pose_message(STAMP, np.zeros(2), np.array([1.0, 0.0]))
    message.pose.pose.orientation = Quaternion(y=math.sqrt(0.5), w=math.sqrt(0.5))
    with pytest.raises(InvalidInputError, match="an x axis in the dish plane"):
        messages.needle_pose(message)


@pytest.mark.parametrize("value", [0.5, 1e200, 1e308, -1e308, float("inf"), float("nan")])
@pytest.mark.parametrize("axis", ["x", "y", "z", "w"])
def test_an_orientation_that_is_none_is_refused_whatever_it_holds(value: float, axis: str):
    message = messages.pose_message(STAMP, np.zeros(2), np.array([0.6, 0.8]))
    setattr(message.pose.pose.orientation, axis, value)
    with pytest.raises(InvalidInputError, match="a unit quaternion"):
        messages.needle_pose(message)


@pytest.mark.parametrize("nanosec", [10**9, 2**32 - 1])
def test_a_stamp_of_more_than_a_second_of_nanoseconds_is_none(nanosec: int):
    message = messages.pose_message(Time(sec=2**31 - 1, nanosec=nanosec), np.zeros(2), np.array([1.0, 0.0]))
    with pytest.raises(InvalidInputError, match=r"header\.stamp\.nanosec"):
        messages.needle_pose(message)


@given(sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 10**9 - 1))
def test_a_stamp_goes_there_and_back(sec: int, nanosec: int):
    stamp = Time(sec=sec, nanosec=nanosec)
    assert messages.stamp_of(messages.nanoseconds(stamp)) == stamp


def test_a_material_becomes_parameters():
    """Plain numbers: of arrays, as messages have them, no parameter is made."""
    assert thread_messages.material_values(ThreadMaterial()) == {}
    message = ThreadMaterial(name="silk_6_0", viscosity=0.9, attachment_offset=[1e-3, 0.0], rest_curvature=[0.0])
    values = thread_messages.material_values(message)
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


def test_a_path_is_made_anew_in_the_message_of_the_last():
    maker, points = messages.PathMaker(), np.random.default_rng(1).normal(size=(9, 2))
    maker.message(STAMP, points)
    shorter = maker.message(Time(sec=9), points[:3] + 1.0)
    np.testing.assert_array_equal(messages.path_points(shorter), points[:3] + 1.0)
    assert shorter.header.stamp.sec == shorter.poses[2].header.stamp.sec == 9
    np.testing.assert_array_equal(messages.path_points(maker.message(STAMP, points)), points)


def test_paths_and_velocities_go_there_and_back():
    points = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_array_equal(messages.path_points(messages.PathMaker().message(STAMP, points)), points)
    assert messages.path_points(messages.PathMaker().message(STAMP, np.empty((0, 2)))).shape == (0, 2)
    twist = messages.twist_message(STAMP, np.array([1.0, -2.0]))
    np.testing.assert_array_equal(messages.plane_velocity(twist, "needle/servo_cv"), [1.0, -2.0])
    np.testing.assert_array_equal(messages.serialised_velocity(serialize_message(twist)), [1.0, -2.0])


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
        *topics.SETTINGS,
    ):
        fields = [name for name, _ in typestore().fielddefs[topic.channel.type_name][1]]
        assert fields == list(topic.message().get_fields_and_field_types())


def test_the_kinds_of_barrier_have_the_same_numbers_everywhere():
    constants = {
        name.removeprefix("KIND_").lower(): getattr(BarrierMargin, name)
        for name in (f"KIND_{kind.name}" for kind in BarrierKind)
    }
    assert constants == {kind.name.lower(): int(kind) for kind in BarrierKind}
    assert constants == {name: number for number, name in enumerate(KINDS)}
    text = (share_directory("magnetosuture_msgs") / "msg" / "BarrierMargin.msg").read_text()
    assert text.count("uint8 KIND_") == len(BarrierKind)
