"""No request, time or message from outside ends a node, whichever it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Twist
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rosgraph_msgs.msg import Clock
from type_description_interfaces.srv import GetTypeDescription

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.node import MAX_REQUEST_ENTRIES
from magnetosuture_thread.nodes.rig_simulator import RigSimulatorNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from test.nodes import wire
from test.nodes.bridge import LONG, armed, drive, driven
from test.nodes.conftest import own_context

EVERY = (CoilBridgeNode, ThreadModelNode, RigSimulatorNode)  # two lifecycle nodes, and one without
HOSTILE_NAMES = ("", " ", "no_such_parameter", "a..b", "\x1b[2J", "x" * 10_000, "use_sim_time.deep")
HOSTILE_VALUES = (
    ParameterValue(type=200),
    ParameterValue(type=10),
    ParameterValue(),
    ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x" * 100_000),
    ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=math.nan),
    ParameterValue(type=ParameterType.PARAMETER_BYTE_ARRAY, byte_array_value=[b"\xff"]),
)


@pytest.fixture(params=EVERY, ids=lambda kind: kind.__name__)
def node(request, graph) -> Any:
    """Each node of the package."""
    return graph.add(request.param, scene="dish_35mm")


def test_requests_that_rclpy_cannot_answer_are_refused(graph, node):
    known = next(iter(node.get_parameters_by_prefix("")))
    hostile = [Parameter(name=name, value=value) for name in (*HOSTILE_NAMES, known) for value in HOSTILE_VALUES]
    results = graph.call(SetParameters, f"{node.get_name()}/set_parameters", parameters=hostile).results
    assert len(results) == len(hostile)
    accepted = [each for each, result in zip(hostile, results, strict=True) if result.successful and each.name != known]
    assert not accepted, [(each.name[:20], each.value.type) for each in accepted]
    assert not any(result.successful for result in results[-len(HOSTILE_VALUES) :][:2])
    assert all(result.reason and len(result.reason) <= 1000 for result in results if not result.successful)
    for each in hostile[::5]:
        refused = graph.call(
            SetParametersAtomically, f"{node.get_name()}/set_parameters_atomically", parameters=[each]
        ).result
        assert each.name == known or not refused.successful
    for kind, name in (
        (DescribeParameters, "describe_parameters"),
        (GetParameters, "get_parameters"),
        (GetParameterTypes, "get_parameter_types"),
    ):
        graph.call(kind, f"{node.get_name()}/{name}", names=list(HOSTILE_NAMES))
        graph.call(kind, f"{node.get_name()}/{name}", names=[known] * (MAX_REQUEST_ENTRIES + 1))
    graph.call(ListParameters, f"{node.get_name()}/list_parameters", prefixes=list(HOSTILE_NAMES), depth=2**64 - 1)
    graph.call(
        GetTypeDescription, f"{node.get_name()}/get_type_description", type_name="no/msg/Such", type_hash="RIHS01_0"
    )
    # Its clock stays the one that it was started with.
    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
    asked = [Parameter(name="use_sim_time", value=value)]
    for result in (
        graph.call(SetParameters, f"{node.get_name()}/set_parameters", parameters=asked).results[0],
        graph.call(SetParametersAtomically, f"{node.get_name()}/set_parameters_atomically", parameters=asked).result,
    ):
        assert not result.successful
        assert "use_sim_time" in result.reason
    assert not graph.probe.get_subscriptions_info_by_topic("/clock")


def test_an_armed_bridge_drives_on(graph):
    node = armed(graph, **LONG)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    graph.call(
        SetParameters, f"{node.get_name()}/set_parameters", parameters=[Parameter(name="x", value=HOSTILE_VALUES[0])]
    )
    assert not graph.call(ChangeState, f"{node.get_name()}/change_state", transition=Transition(id=200)).success
    assert node.system.latch.armed
    told = len(node.system.driver.applied)
    graph.wait(lambda: len(node.system.driver.applied) > told, "more steps")


@pytest.mark.parametrize("kind", [kind for kind in EVERY if kind is not RigSimulatorNode], ids=lambda k: k.__name__)
def test_an_impossible_time_is_reported_and_ignored(graph, kind):
    """The rig is left out, as it publishes the time itself."""
    node = graph.add(kind, scene="dish_35mm", use_sim_time=True)
    reports = graph.listen(topics.DIAGNOSTICS)
    for time in (Time(sec=-5), Time(sec=7, nanosec=4_000_000_000), Time(sec=-(2**31), nanosec=2**32 - 1)):
        graph.publish(topics.CLOCK, Clock(clock=time))
        field = f"/clock.clock.sec: got {time.sec}" if time.sec < 0 else f"/clock.clock.nanosec: got {time.nanosec}"
        graph.wait(lambda field=field: any(field in str(report) for report in reports), "the report")
    # A recording that is played again sets the time back.
    for seconds in (50, 2**31 - 1, 20):
        graph.publish(topics.CLOCK, Clock(clock=Time(sec=seconds)))
        graph.wait(lambda s=seconds: node.get_clock().now().nanoseconds == s * 10**9, "the time")


@pytest.mark.parametrize("stamp", [Time(sec=-1, nanosec=5), Time(sec=1, nanosec=2**32 - 1)])
def test_a_command_of_an_impossible_time_is_refused(graph, stamp):
    node = armed(graph, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    currents = graph.listen(topics.CURRENTS)
    message = wire.twist_message(graph.now(), np.array([0.001, 0.0]))
    message.header.stamp = stamp
    if stamp.nanosec >= 10**9:  # as late as now, if its nanoseconds counted
        whole, now = stamp.nanosec // 10**9, graph.now()
        message.header.stamp = Time(sec=now.sec - whole, nanosec=min(now.nanosec + whole * 10**9, 2**32 - 1))
    graph.publish(topics.OPERATOR_COMMAND, message)
    graph.wait(lambda: bool(states) and states[-1].refused == 1, "the refusal")
    assert not driven(node)
    assert all(current.command != message.header.stamp for current in currents)


def long_twist(graph) -> Any:
    """Return a command whose frame has a name of 10 MB."""
    message = wire.twist_message(graph.now(), np.array([0.001, 0.0]))
    message.header.frame_id = "map" + "x" * 10_000_000
    return message


def long_scene(graph) -> Any:
    """Return margins of a scene whose version has 10 MB."""
    message = topics.MARGINS.message(valid=True, slowdown=1.0, scene_version="v" * 10_000_000)
    message.header.stamp = graph.now()
    return message


@pytest.mark.parametrize(
    ("topic", "make"),
    [(topics.OPERATOR_COMMAND, long_twist), (topics.MARGINS, long_scene)],
)
def test_a_message_that_is_too_large_is_refused_unread(graph, topic: topics.Topic, make: Callable[[Any], Any]):
    graph.add(CoilBridgeNode, scene="dish_35mm")
    reports, states = graph.listen(topics.DIAGNOSTICS), graph.listen(topics.BRIDGE_STATE)
    graph.publish(topic, make(graph))
    graph.wait(lambda: bool(states) and states[-1].refused == 1, "the refusal")
    graph.wait(lambda: "expected at most" in str(reports[-1].status[0].values), "the reason")
    assert max(len(str(report)) for report in reports) < 5000


def test_a_publisher_of_another_type_is_named(graph):
    """As of a joystick that sends a Twist where a TwistStamped is expected: the middleware says nothing."""
    graph.add(CoilBridgeNode, scene="dish_35mm")
    reports = graph.listen(topics.DIAGNOSTICS)
    expected = "got geometry_msgs/msg/Twist from /joystick", "expected geometry_msgs/msg/TwistStamped"
    with own_context(graph.domain) as elsewhere:  # a participant refuses two types of one topic by itself
        joystick = rclpy.create_node("joystick", context=elsewhere)
        joystick.create_publisher(Twist, topics.OPERATOR_COMMAND.name, 10)
        graph.wait(lambda: any(all(text in str(report) for text in expected) for report in reports), "the type")
        joystick.destroy_node()
