"""The coil bridge in a graph: its lifecycle, arming and the emergency stop."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from magnetosuture_msgs.msg import CoilBridgeState

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.settings.interface import Service
from test.nodes.bridge import (
    LONG,
    READY,
    applied,
    arm,
    armed,
    change,
    command,
    drive,
    driven,
    press,
    reasons,
    stage,
)


def test_it_starts_active_but_disarmed_and_arming_lets_commands_pass(graph):
    node = graph.add(CoilBridgeNode, **LONG, **READY)
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
    assert press(graph, Service.EMERGENCY_STOP).success
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
    assert press(graph, Service.RESET).success
    assert stage(graph) == "active"
    drive(graph)
    graph.wait(lambda: reasons(states).startswith("disarmed"), "the reason")
    assert not any(a.any() for a in applied(node)[told:])
    assert arm(graph).success
    drive(graph)
    graph.wait(lambda: applied(node)[-1].any(), "a current again")


@pytest.mark.parametrize("how_far", ["unconfigured", "inactive"])
def test_inactive_passes_nothing(graph, how_far):
    node = graph.add(CoilBridgeNode, autostart=how_far, **LONG, **READY)
    states = graph.listen(topics.BRIDGE_STATE)
    assert stage(graph) == how_far
    drive(graph)
    assert not arm(graph).success
    graph.wait(lambda: reasons(states).startswith(how_far), "the reason")
    if node.system.driver is not None:
        assert not driven(node)
    assert press(graph, Service.EMERGENCY_STOP).success
    graph.wait(
        lambda: bool(states) and states[-1].state == CoilBridgeState.STATE_FAULT,
        "the stop to be latched here too",
    )
    assert press(graph, Service.RESET).success
    assert stage(graph) == how_far


def test_the_lifecycle_there_and_back(graph):
    node = graph.add(CoilBridgeNode, autostart="unconfigured", **LONG, **READY)
    assert change(graph, Transition.TRANSITION_CONFIGURE)
    assert change(graph, Transition.TRANSITION_ACTIVATE)
    assert arm(graph).success
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    assert change(graph, Transition.TRANSITION_DEACTIVATE)
    assert not applied(node)[-1].any()
    assert not change(graph, Transition.TRANSITION_DEACTIVATE)  # not possible now, and no end of the node
    assert not change(graph, 99)
    first = node.system.driver
    assert change(graph, Transition.TRANSITION_CLEANUP)
    assert not first.state().ready
    assert change(graph, Transition.TRANSITION_CONFIGURE)
    assert change(graph, Transition.TRANSITION_ACTIVATE)
    assert node.system.driver is not first
    assert not node.system.latch.armed
    assert change(graph, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert stage(graph) == "finalized"
    assert not node.system.driver.state().ready


def test_a_reset_never_arms_whatever_came_between(graph):
    """Armed by itself once, at its start, and never again."""
    node = armed(graph, **LONG)
    assert press(graph, Service.EMERGENCY_STOP).success
    graph.wait(lambda: stage(graph) == "inactive", "the lifecycle to say so")
    assert change(graph, Transition.TRANSITION_CLEANUP)
    assert change(graph, Transition.TRANSITION_CONFIGURE)
    assert press(graph, Service.RESET).success
    assert stage(graph) == "inactive"  # where the operator has left it
    assert change(graph, Transition.TRANSITION_ACTIVATE)
    drive(graph)
    told = len(applied(node))
    graph.wait(lambda: len(applied(node)) > told + 30, "some steps")
    assert not node.system.latch.armed
    assert not driven(node)


def test_a_stop_calls_off_what_would_arm_by_itself(graph):
    node = graph.add(CoilBridgeNode, driver="simulated", autostart="armed", **LONG, **READY)
    assert press(graph, Service.EMERGENCY_STOP).success
    graph.listen(topics.RIG_CURRENTS)
    graph.wait(lambda: node.system.driver.state().ready, "the rig to be found")
    assert press(graph, Service.RESET).success
    states = graph.listen(topics.BRIDGE_STATE)
    graph.wait(lambda: len(states) > 3, "some states")
    assert stage(graph) == "active"
    assert not states[-1].armed


def test_an_error_in_a_transition_leaves_the_coils_at_zero_and_the_driver_closed(graph, monkeypatch):
    node = armed(graph, **LONG)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")

    def broken() -> None:
        raise RuntimeError("nobody foresaw this")

    monkeypatch.setattr(node.system.latch, "deactivate", broken)
    change(graph, Transition.TRANSITION_DEACTIVATE)
    assert not node.system.driver.state().ready
    assert not applied(node)[-1].any()
    assert "nobody foresaw this" in str(node.problem)
    assert stage(graph) in ("unconfigured", "finalized")


def test_a_bad_message_does_not_hide_an_emergency_stop(graph):
    graph.add(CoilBridgeNode)
    diagnostics, states = graph.listen(topics.DIAGNOSTICS), graph.listen(topics.BRIDGE_STATE)
    assert press(graph, Service.EMERGENCY_STOP).success
    graph.wait(lambda: any(d.status[0].level == DiagnosticStatus.ERROR for d in diagnostics), "the fault")
    bad = command(graph)
    bad.header.frame_id = "map"
    graph.publish(topics.NEEDLE_COMMAND, bad)
    graph.wait(lambda: bool(states) and states[-1].refused == 1, "the refusal")
    heard = len(diagnostics)
    graph.wait(lambda: len(diagnostics) > heard, "another report")
    assert diagnostics[-1].status[0].level == DiagnosticStatus.ERROR
    assert diagnostics[-1].status[0].message == "fault: emergency stop"
