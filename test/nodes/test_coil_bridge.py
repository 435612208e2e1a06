"""The coil bridge in a graph."""

from __future__ import annotations

import gc
import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from magnetosuture_msgs.msg import CoilBridgeState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, RESET
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode

EAST = np.array([1.0, 0.0])
TAIL = np.array([-0.0035, 0.0])
LONG = {"command_timeout": 1.0, "pose_timeout": 1.0}  # one command and one pose last through a test


def armed(graph, **parameters: Any) -> Any:
    """Return a bridge that passes commands."""
    node = graph.add(CoilBridgeNode, autostart="armed", **parameters)
    graph.wait(lambda: node.station.latch.armed, "the bridge to be armed")
    return node


def command(graph, x: float = 0.01, y: float = 0.0) -> TwistStamped:
    """Return a velocity command made now."""
    return messages.twist_message(graph.now(), np.array([x, y]))


def drive(graph, x: float = 0.005, y: float = 0.0) -> TwistStamped:
    """Say where the needle is, then ask for a velocity; return that command."""
    graph.publish(topics.NEEDLE_POSE, messages.pose_message(graph.now(), TAIL, EAST))
    asked = command(graph, x, y)
    graph.publish(topics.NEEDLE_COMMAND, asked)
    return asked


def call(graph, kind: Any, name: str, request: Any) -> Any:
    """Call a service and return its answer."""
    client = graph.probe.create_client(kind, name)
    graph.wait(client.service_is_ready, f"the service {name}")
    future = client.call_async(request)
    graph.wait(future.done, f"an answer of {name}")
    graph.probe.destroy_client(client)
    return future.result()


def press(graph, name: str) -> Any:
    """Call emergency stop or reset."""
    return call(graph, Trigger, name, Trigger.Request())


def arm(graph, on: bool = True) -> Any:
    """Arm or disarm."""
    return call(graph, SetBool, ARM, SetBool.Request(data=on))


def change(graph, transition: int) -> bool:
    """Ask for a transition of the lifecycle."""
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(call(graph, ChangeState, "coil_bridge/change_state", request).success)


def stage(graph) -> str:
    """Return the lifecycle's state."""
    return str(call(graph, GetState, "coil_bridge/get_state", GetState.Request()).current_state.label)


def applied(node) -> list[np.ndarray]:
    """Return what the recording driver was told."""
    return list(node.station.driver.applied)


def driven(node) -> bool:
    """Return whether any current was on."""
    return any(currents.any() for currents in applied(node))


def reasons(states) -> str:
    """Return why the coils are at zero, by the last state."""
    return "; ".join(states[-1].reasons) if states else ""


def test_a_command_reaches_the_driver_and_the_topics(graph):
    node = armed(graph, **LONG)
    currents, setpoints = graph.listen(topics.CURRENTS), graph.listen(topics.NEEDLE_SETPOINT)
    states = graph.listen(topics.BRIDGE_STATE)
    asked = drive(graph)
    graph.wait(lambda: any(m.command == asked.header.stamp for m in currents), "currents for the command")
    expected = CoilBridgeSettings().allocation().allocate(np.array([0.005, 0.0]), TAIL, EAST).currents
    assert expected[0] > 2.0
    graph.wait(lambda: np.allclose(applied(node)[-1], expected, atol=0.05), "the full currents")
    last = next(m for m in reversed(currents) if not m.stop)
    assert list(last.coil) == ["coil_0", "coil_1", "coil_2", "coil_3"]
    assert not last.saturated
    graph.wait(lambda: bool(setpoints) and setpoints[-1].twist.linear.x == pytest.approx(0.005, rel=0.02), "setpoint")
    graph.wait(lambda: bool(states) and states[-1].armed and not states[-1].reasons, "the state")
    graph.wait(lambda: bool(states) and states[-1].reached.x == pytest.approx(0.005, rel=0.02), "the velocity reached")
    assert states[-1].state == CoilBridgeState.STATE_ACTIVE
    assert states[-1].commanded.x == states[-1].applied.x == 0.005
    assert (states[-1].driver, states[-1].driver_ready) == ("recording", True)


@pytest.mark.parametrize("tail", [(1e200, 0.0), (0.05, 0.025), (-1e-320, 1e308)])
def test_a_pose_that_cannot_be_does_not_end_the_bridge(graph, tail):
    node = armed(graph)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, messages.pose_message(graph.now(), np.array(tail), EAST))
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any("of the dish's centre" in str(d.status[0].values) for d in diagnostics), "a refusal")
    assert not driven(node)
    drive(graph)
    graph.wait(lambda: driven(node), "a good pose")


def test_between_commands_the_currents_follow_the_needle(graph):
    """The bridge lays the field along the needle as it turns, at its own rate."""
    node = armed(graph, **LONG)
    drive(graph, 0.0, 0.003)
    graph.wait(lambda: sum(a.any() for a in applied(node)) > 20, "currents without another command")
    assert len({tuple(a) for a in applied(node) if a.any()}) > 10


def test_without_a_pose_there_is_no_current(graph):
    node = armed(graph, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: reasons(states) == "no needle pose yet", "the reason")
    assert not driven(node)


def test_a_pose_that_grows_old_stops_the_coils_while_commands_go_on(graph):
    node = armed(graph, pose_timeout=0.05, command_timeout=1.0)
    currents = graph.listen(topics.CURRENTS)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    graph.wait(lambda: bool(currents) and currents[-1].stop == "no needle pose for 0.05 s", "the stop")
    assert not applied(node)[-1].any()


@pytest.mark.parametrize(
    "spoil", [lambda m: setattr(m.header, "stamp", Time(sec=5)), lambda m: setattr(m.header, "frame_id", "map")]
)
def test_a_bad_pose_is_not_used(graph, spoil):
    node = armed(graph, **LONG)
    states, diagnostics = graph.listen(topics.BRIDGE_STATE), graph.listen(topics.DIAGNOSTICS)
    pose = messages.pose_message(graph.now(), np.zeros(2), EAST)
    spoil(pose)
    graph.publish(topics.NEEDLE_POSE, pose)
    graph.wait(lambda: any("needle/measured_cp" in str(d.status[0].values) for d in diagnostics), "a refusal")
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: reasons(states) == "no needle pose yet", "the reason")
    assert states[-1].refused >= 1
    assert not driven(node)


def test_silence_stops_the_coils_and_the_next_command_starts_them(graph):
    node = armed(graph, zero_hold=0.2, pose_timeout=1.0)
    currents, diagnostics = graph.listen(topics.CURRENTS), graph.listen(topics.DIAGNOSTICS)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    graph.wait(lambda: not applied(node)[-1].any(), "zero current")
    graph.wait(lambda: any("no command for 0.1 s" in d.status[0].message for d in diagnostics), "the reason")
    graph.wait(lambda: bool(currents) and currents[-1].stop == "no command for 0.1 s", "the reason with the currents")
    drive(graph)
    graph.wait(lambda: np.any(currents[-1].current), "a current again")


def test_cease_after_stop(graph):
    """Zeros are published for a while; then the topic is silent, and the driver still told zero."""
    node = armed(graph, zero_hold=0.1)
    currents = graph.listen(topics.CURRENTS)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    graph.wait(lambda: bool(currents) and currents[-1].stop != "", "zeros")
    told = len(applied(node))
    graph.wait(lambda: len(applied(node)) > told + 60, "more zeros to the driver")
    heard, told = len(currents), len(applied(node))
    graph.wait(lambda: len(applied(node)) > told + 60, "still more")
    assert len(currents) <= heard + 1
    assert not any(a.any() for a in applied(node)[told:])


def test_the_watchdog_does_not_depend_on_simulated_time(graph):
    """With /clock standing still the coils must stop all the same; before it runs nothing is good."""
    node = armed(graph, use_sim_time=True)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_COMMAND, messages.twist_message(Time(), np.array([0.01, 0.0])))
    graph.wait(lambda: any("0 is none in ROS" in str(d.status[0].values) for d in diagnostics), "a refusal")
    now = Time(sec=50)
    clock = graph.probe.create_publisher(Clock, "/clock", topics.CLOCK.qos)
    graph.wait(lambda: clock.get_subscription_count() > 0, "who wants the time")

    def running() -> bool:
        clock.publish(Clock(clock=now))
        return bool(node.get_clock().now().nanoseconds == 50 * 10**9)

    graph.wait(running, "the time")
    graph.publish(topics.NEEDLE_POSE, messages.pose_message(now, TAIL, EAST))
    graph.publish(topics.NEEDLE_COMMAND, messages.twist_message(now, np.array([0.01, 0.0])))
    graph.wait(lambda: driven(node), "a current")
    graph.wait(lambda: not applied(node)[-1].any(), "zero current")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: setattr(m.twist.linear, "x", math.nan), "finite numbers"),
        (lambda m: setattr(m.twist.linear, "y", -math.inf), "finite numbers"),
        (lambda m: setattr(m.twist.linear, "z", 0.001), "x and y alone count"),
        (lambda m: setattr(m.twist.angular, "z", math.nan), "x and y alone count"),
        (lambda m: setattr(m.header, "frame_id", "base_link"), "'dish'"),
        (lambda m: setattr(m.header, "stamp", Time(sec=5)), "at most 0.1 s"),
        (lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec + 60), "at most 0.05 s"),
    ],
)
def test_a_bad_command_never_reaches_the_driver(graph, spoil, words):
    node = armed(graph, pose_timeout=1.0)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, messages.pose_message(graph.now(), TAIL, EAST))
    bad = command(graph)
    spoil(bad)
    graph.publish(topics.NEEDLE_COMMAND, bad)
    graph.wait(lambda: any(words in str(d.status[0].values) for d in diagnostics), "a refusal")
    assert not driven(node)
    drive(graph)
    graph.wait(lambda: driven(node), "a good command")


def test_currents_stay_within_their_limit_and_saturation_is_said(graph):
    node = armed(graph, max_current=1.5, max_speed=0.5, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    drive(graph, x=9.0)
    graph.wait(lambda: any(m.saturated for m in states), "saturation")
    assert max(np.abs(a).max() for a in applied(node)) <= 1.5
    reached = next(m for m in states if m.saturated)
    assert 0.0 < reached.reached.x < reached.applied.x


def test_two_publishers_at_once_stop_the_needle(graph):
    node = armed(graph, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    other = graph.probe.create_publisher(TwistStamped, topics.NEEDLE_COMMAND.name, 10)
    graph.wait(lambda: other.get_subscription_count() > 0, "the bridge")
    own = next(s for s in node.subscriptions if s.topic_name.endswith("servo_cv"))
    graph.wait(lambda: own.get_publisher_count() == 2, "the other to be found")
    other.publish(command(graph, -0.01))
    graph.wait(lambda: "several publishers" in reasons(states), "the stop")
    assert not applied(node)[-1].any()
    assert min(a[0] for a in applied(node)) > -1.0  # the other was not followed for a moment
    graph.wait(lambda: "several publishers" not in reasons(states), "one of them to be silent")


def test_the_coils_are_left_at_zero(graph):
    node = armed(graph, **LONG)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    assert applied(node)[-1].any()
    graph.remove(node)
    assert not applied(node)[-1].any()


def test_a_bridge_that_is_destroyed_leaves_the_graph_at_once(graph):
    gc.disable()
    try:
        node = graph.add(CoilBridgeNode)
        graph.wait(lambda: "coil_bridge" in graph.probe.get_node_names(), "the bridge")
        graph.remove(node)
        graph.wait(lambda: graph.probe.get_node_names() == ["probe"], "the bridge to leave")
    finally:
        gc.enable()


def test_it_starts_active_but_disarmed_and_arming_lets_commands_pass(graph):
    node = graph.add(CoilBridgeNode, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    drive(graph)
    graph.wait(lambda: reasons(states).startswith("disarmed"), "the reason")
    assert not driven(node)
    assert arm(graph).success
    graph.wait(lambda: reasons(states) == "no command yet", "what came before not to count")
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    assert arm(graph, on=False).success
    assert not applied(node)[-1].any()
    graph.wait(lambda: reasons(states).startswith("disarmed"), "the reason")


def test_an_emergency_stop_is_latched_and_a_reset_leaves_it_disarmed(graph):
    node = armed(graph, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    assert press(graph, EMERGENCY_STOP).success
    assert not applied(node)[-1].any()
    graph.wait(lambda: stage(graph) == "inactive", "the lifecycle to say so")
    assert states[-1].state == CoilBridgeState.STATE_FAULT
    assert states[-1].emergency_stopped
    told = len(applied(node))
    drive(graph)
    refusal = arm(graph)
    assert not refusal.success
    assert "emergency stop" in refusal.message
    assert not change(graph, Transition.TRANSITION_ACTIVATE)
    assert press(graph, RESET).success
    assert stage(graph) == "active"
    drive(graph)
    graph.wait(lambda: reasons(states).startswith("disarmed"), "the reason")
    assert not any(a.any() for a in applied(node)[told:])
    assert arm(graph).success
    drive(graph)
    graph.wait(lambda: applied(node)[-1].any(), "a current again")


@pytest.mark.parametrize("how_far", ["unconfigured", "inactive"])
def test_inactive_passes_nothing(graph, how_far):
    node = graph.add(CoilBridgeNode, autostart=how_far, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    assert stage(graph) == how_far
    drive(graph)
    assert not arm(graph).success
    graph.wait(lambda: reasons(states).startswith(how_far), "the reason")
    if node.station.driver is not None:
        assert not driven(node)
    assert press(graph, EMERGENCY_STOP).success
    graph.wait(
        lambda: bool(states) and states[-1].state == CoilBridgeState.STATE_FAULT, "the stop to be latched here too"
    )
    assert press(graph, RESET).success
    assert stage(graph) == how_far


def test_the_lifecycle_there_and_back(graph):
    node = graph.add(CoilBridgeNode, autostart="unconfigured", **LONG)
    assert change(graph, Transition.TRANSITION_CONFIGURE)
    assert change(graph, Transition.TRANSITION_ACTIVATE)
    assert arm(graph).success
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    assert change(graph, Transition.TRANSITION_DEACTIVATE)
    assert not applied(node)[-1].any()
    assert not change(graph, Transition.TRANSITION_DEACTIVATE)  # not possible now, and no end of the node
    assert not change(graph, 99)
    first = node.station.driver
    assert change(graph, Transition.TRANSITION_CLEANUP)
    assert not first.state().ready
    assert change(graph, Transition.TRANSITION_CONFIGURE)
    assert change(graph, Transition.TRANSITION_ACTIVATE)
    assert node.station.driver is not first
    assert not node.station.latch.armed
    assert change(graph, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert stage(graph) == "finalized"
    assert not node.station.driver.state().ready


def test_a_reset_never_arms_whatever_came_between(graph):
    """Armed by itself once, at its start, and never again."""
    node = armed(graph, **LONG)
    assert press(graph, EMERGENCY_STOP).success
    graph.wait(lambda: stage(graph) == "inactive", "the lifecycle to say so")
    assert change(graph, Transition.TRANSITION_CLEANUP)
    assert change(graph, Transition.TRANSITION_CONFIGURE)
    assert press(graph, RESET).success
    assert stage(graph) == "inactive"  # where the operator has left it
    assert change(graph, Transition.TRANSITION_ACTIVATE)
    drive(graph)
    told = len(applied(node))
    graph.wait(lambda: len(applied(node)) > told + 30, "some steps")
    assert not node.station.latch.armed
    assert not driven(node)


def test_a_stop_calls_off_what_would_arm_by_itself(graph):
    node = graph.add(CoilBridgeNode, driver="simulated", autostart="armed", **LONG)
    assert press(graph, EMERGENCY_STOP).success
    graph.listen(topics.RIG_CURRENTS)
    graph.wait(lambda: node.station.driver.state().ready, "the rig to be found")
    assert press(graph, RESET).success
    states = graph.listen(topics.BRIDGE_STATE)
    graph.wait(lambda: len(states) > 3, "some states")
    assert stage(graph) == "active"
    assert not states[-1].armed


def test_a_bad_message_does_not_hide_an_emergency_stop(graph):
    graph.add(CoilBridgeNode)
    diagnostics, states = graph.listen(topics.DIAGNOSTICS), graph.listen(topics.BRIDGE_STATE)
    assert press(graph, EMERGENCY_STOP).success
    graph.wait(lambda: any(d.status[0].level == DiagnosticStatus.ERROR for d in diagnostics), "the fault")
    bad = command(graph)
    bad.header.frame_id = "map"
    graph.publish(topics.NEEDLE_COMMAND, bad)
    graph.wait(lambda: bool(states) and states[-1].refused == 1, "the refusal")
    heard = len(diagnostics)
    graph.wait(lambda: len(diagnostics) > heard, "another report")
    assert diagnostics[-1].status[0].level == DiagnosticStatus.ERROR
    assert diagnostics[-1].status[0].message == "fault: emergency stop"


@pytest.mark.parametrize("transition", [Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVE_SHUTDOWN])
def test_an_error_in_a_transition_leaves_the_coils_at_zero_and_the_driver_closed(graph, monkeypatch, transition):
    node = armed(graph, **LONG)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")

    def broken() -> None:
        raise RuntimeError("nobody foresaw this")

    monkeypatch.setattr(node.station.latch, "deactivate", broken)
    change(graph, transition)
    assert not node.station.driver.state().ready
    assert not applied(node)[-1].any()
    assert "nobody foresaw this" in str(node.problem)
    assert stage(graph) in ("unconfigured", "finalized")


def test_what_was_taken_is_given_back_where_configuring_fails(graph, monkeypatch):
    node = graph.add(CoilBridgeNode, autostart="unconfigured")

    def broken(*_: Any, **__: Any) -> None:
        raise RuntimeError("no timer")

    monkeypatch.setattr(node, "create_timer", broken)
    assert not change(graph, Transition.TRANSITION_CONFIGURE)
    assert node.station.bridge is None
    assert not node.station.driver.state().ready
    monkeypatch.undo()
    assert change(graph, Transition.TRANSITION_CONFIGURE)


def test_a_message_that_breaks_arithmetic_does_not_end_the_node(graph, monkeypatch):
    node = armed(graph, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)

    def broken(*_: Any) -> None:
        raise OverflowError("a check that was forgotten")

    monkeypatch.setattr(node.station.bridge.gate, "accept", broken)
    monkeypatch.setattr(node.station.bridge.needle, "see", broken)
    drive(graph)
    graph.wait(lambda: bool(states) and states[-1].refused == 2, "both refused")


def set_parameter(graph, name: str, value: float) -> Any:
    """Set a number among the bridge's parameters."""
    parameter = Parameter(name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value))
    request = SetParameters.Request(parameters=[parameter])
    return call(graph, SetParameters, "coil_bridge/set_parameters", request).results[0]


def test_bad_parameters_refuse_to_configure_until_they_are_mended(graph):
    graph.add(CoilBridgeNode, autostart="unconfigured", command_timeout=0.0)
    assert not change(graph, Transition.TRANSITION_CONFIGURE)
    assert stage(graph) == "unconfigured"
    assert set_parameter(graph, "command_timeout", 0.2).successful
    assert change(graph, Transition.TRANSITION_CONFIGURE)
    refused = set_parameter(graph, "max_current", 50.0)
    assert not refused.successful
    assert "a cleaned-up node" in refused.reason
    assert change(graph, Transition.TRANSITION_CLEANUP)
    assert set_parameter(graph, "max_current", 5.0).successful
    assert change(graph, Transition.TRANSITION_CONFIGURE)


@pytest.mark.parametrize(
    "bad", [{"command_timeout": 0.0}, {"autostart": "armed", "driver": "roboclaw"}, {"autostart": "everything"}]
)
def test_with_bad_parameters_it_does_not_start(graph, bad):
    with pytest.raises(ConfigurationError, match="coil_bridge\\."):
        graph.add(CoilBridgeNode, **bad)


def test_without_a_rig_the_simulated_driver_is_not_armed(graph):
    graph.add(CoilBridgeNode, driver="simulated", **LONG)
    refusal = arm(graph)
    assert not refusal.success
    assert "no rig_simulator listens" in refusal.message
    wires = graph.listen(topics.RIG_CURRENTS)
    graph.wait(lambda: arm(graph).success, "the rig to be found")
    drive(graph)
    graph.wait(lambda: any(np.any(m.current) for m in wires), "currents on the wires")
