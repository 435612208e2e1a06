"""The coil bridge in a graph: its lifecycle, arming and the emergency stop."""

from __future__ import annotations

from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from magnetosuture_msgs.msg import CoilBridgeState
from magnetosuture_msgs.srv import GivePulse
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.bags import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.interface import Service
from test.nodes import wire
from test.nodes.bridge import (
    EAST,
    LONG,
    READY,
    TAIL,
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


def test_a_bridge_whose_driver_may_move_something_does_not_arm_itself(graph):
    boards = {"roboclaw_ports": ["/dev/a", "/dev/b"], "roboclaw_addresses": [128, 129]}
    with pytest.raises(ConfigurationError, match=r"coil_bridge\.autostart: got 'armed', expected active at most"):
        graph.add(CoilBridgeNode, driver="roboclaw", autostart="armed", **boards, **READY)


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


def test_a_late_arm_or_reset_is_refused_and_a_late_stop_or_disarm_is_not(graph):
    node = graph.add(CoilBridgeNode, **LONG, **READY)
    answer = graph.call_late(SetBool, Service.ARM, data=True)
    assert not answer.success
    assert "coils/arm: got a request 1." in answer.message
    assert not node.system.latch.armed
    assert arm(graph).success
    assert graph.call_late(SetBool, Service.ARM, data=False).success
    assert not node.system.latch.armed
    assert graph.call_late(Trigger, Service.EMERGENCY_STOP).success
    assert not graph.call_late(Trigger, Service.RESET).success
    assert node.system.latch.emergency
    assert press(graph, Service.RESET).success


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


def pulse(graph, duration: float = 0.5, currents: tuple[float, ...] = (0.1, 0.0, 0.0, 0.0)) -> Any:
    """Ask for a pulse, of a needle that was just measured."""
    graph.publish(topics.NEEDLE_POSE, wire.pose_message(graph.now(), TAIL, EAST))
    return graph.call(GivePulse, Service.PULSE, current=currents, duration=duration)


def rests_by(graph, states, reason: str) -> bool:
    """Measure the needle, and say whether the coils are at zero for this reason alone."""
    graph.publish(topics.NEEDLE_POSE, wire.pose_message(graph.now(), TAIL, EAST))
    return reasons(states) == reason


def pulsed(graph, node) -> None:
    """Let a pulse begin; on a busy machine one pose may come too late."""
    graph.wait(lambda: pulse(graph).success, "a pulse")
    assert driven(node)


def test_a_pulse_is_refused_unless_the_bridge_commissions(graph):
    node = armed(graph, **LONG)
    answer = pulse(graph)
    assert not answer.success
    assert answer.message.endswith("a bridge that does not commission, expected coil_bridge.commissioning true")
    assert not driven(node)


def test_a_bridge_that_commissions_gives_pulses_and_follows_no_command(graph):
    node = armed(graph, commissioning=True, **LONG)
    states, currents = graph.listen(topics.BRIDGE_STATE), graph.listen(topics.CURRENTS)
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: rests_by(graph, states, "needle/servo_cv commands the needle"), "the reason")
    assert "needle/servo_cv commands the needle" in pulse(graph).message
    assert not driven(node)
    graph.wait(lambda: rests_by(graph, states, "no pulse"), "the command to be old")
    assert "expected 4 numbers of at most 10 A" in pulse(graph, currents=(11.0, 0.0, 0.0, 0.0)).message
    assert "at most 0.5 s" in pulse(graph, 0.6).message
    assert not driven(node)
    pulsed(graph, node)
    graph.wait(lambda: bool(currents) and currents[-1].stop == "the pulse is over", "its end")
    flowing = [1e-9 * reading.nanoseconds(given.header.stamp) for given in currents if any(given.current)]
    assert 0.1 < flowing[-1] - flowing[0] < 0.55  # s; a step reads two clocks, between which a busy machine may wait
    assert arm(graph, on=False).success
    assert "disarmed" in pulse(graph).message


def test_a_stop_ends_a_pulse_at_once(graph):
    node = armed(graph, commissioning=True, **LONG)
    messages = graph.listen(topics.CURRENTS)
    pulsed(graph, node)
    assert press(graph, Service.EMERGENCY_STOP).success
    answered = reading.nanoseconds(graph.now())
    assert not applied(node)[-1].any()
    graph.wait(lambda: bool(messages) and "emergency stop" in messages[-1].stop, "the reason")
    flowing = [reading.nanoseconds(message.header.stamp) for message in messages if any(message.current)]
    assert flowing[-1] < answered
    count = sum(currents.any() for currents in applied(node))
    assert "emergency stop" in pulse(graph).message
    assert sum(currents.any() for currents in applied(node)) == count


def test_a_late_pulse_is_refused(graph):
    node = armed(graph, commissioning=True, **LONG)
    graph.publish(topics.NEEDLE_POSE, wire.pose_message(graph.now(), TAIL, EAST))
    answer = graph.call_late(GivePulse, Service.PULSE, current=(0.1, 0.0, 0.0, 0.0), duration=0.1)
    assert "coils/pulse: got a request 1." in answer.message
    assert not driven(node)
