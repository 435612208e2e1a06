"""How the coil bridge ends and begins again: zeros and a last word, and an emergency stop that outlives the process."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from magnetosuture_msgs.msg import CoilBridgeState
from rclpy.parameter import Parameter

from magnetosuture_thread.coils.coil_system import UNCLEAN_END
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.processes import graph_environment
from magnetosuture_thread.nodes.rig_simulator import RigSimulatorNode
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.interface import Service
from test.nodes.bridge import (
    LONG,
    READY,
    applied,
    arm,
    armed,
    change,
    drive,
    drive_until,
    driven,
    press,
    reasons,
    stage,
)
from test.nodes.programs import TIMEOUT, Program

LAST = (topics.CURRENTS, topics.RIG_CURRENTS, topics.NEEDLE_SETPOINT, topics.BRIDGE_STATE)


def process(graph, programs, **parameters: Any) -> Program:
    """Start a bridge as a process in the test's graph, whose wires end at the test."""
    given = {"driver": "simulated", **READY, **LONG, **parameters}
    arguments = [part for name, value in given.items() for part in ("-p", f"{name}:={value}")]
    return programs.start("coil_bridge", *arguments, environment=graph_environment(graph.domain))


def last(graph) -> dict[str, list[Any]]:
    """Return the lists of messages of the topics that must end with zeros."""
    return {topic.name: graph.listen_later(topic) for topic in LAST}


def says(heard: dict[str, list[Any]], ending: str) -> bool:
    """Return whether the last of each topic is zero, and the state says why."""
    state = heard[topics.BRIDGE_STATE.name]
    return (
        bool(state)
        and ending in state[-1].reasons
        and not state[-1].armed
        and not any(state[-1].current)
        and all(heard[topic.name] and not np.any(heard[topic.name][-1].current) for topic in LAST[:2])
        and np.hypot((v := heard[topics.NEEDLE_SETPOINT.name][-1].twist.linear).x, v.y) == 0.0
        and heard[topics.CURRENTS.name][-1].stop == ending
    )


def moving(heard: dict[str, list[Any]]) -> bool:
    """Return whether the last currents on the wires are not zero."""
    wires = heard[topics.RIG_CURRENTS.name]
    return bool(wires) and bool(np.any(wires[-1].current))


def armed_and_driving(graph, heard: dict[str, list[Any]], moves: Callable[[], bool] | None = None) -> None:
    """Arm a bridge in another process and command it until something moves, by default the currents on the wires."""
    states = heard[topics.BRIDGE_STATE.name]
    graph.wait(lambda: bool(states) and states[-1].driver_ready, "the bridge", TIMEOUT)

    def drives() -> bool:
        if states[-1].state == CoilBridgeState.STATE_FAULT and "no valid answer to" in reasons(states):
            press(graph, Service.RESET)  # simulated boards answer late on a busy machine
        if not states[-1].armed:
            arm(graph)
        drive(graph)
        return moving(heard) if moves is None else moves()

    graph.wait(drives, "a current", TIMEOUT)


@pytest.mark.parametrize(
    "signals",
    [(), (signal.SIGHUP,), (signal.SIGINT, signal.SIGTERM, signal.SIGINT)],
)
def test_the_last_messages_of_a_bridge_that_is_ended_are_zeros_and_why(
    graph, programs, signals: tuple[signal.Signals, ...]
):
    heard = last(graph)
    bridge = process(graph, programs)
    armed_and_driving(graph, heard)
    if not signals:
        assert change(graph, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    for which in signals:
        bridge.send_signal(which)
    assert bridge.wait() == 0
    graph.wait(lambda: says(heard, "finalized"), f"zeros: {[heard[topic.name][-1] for topic in LAST]}")


@pytest.mark.parametrize(
    ("transitions", "ending"),
    [
        ([Transition.TRANSITION_DEACTIVATE], "inactive"),
        ([Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP], "unconfigured"),
    ],
)
def test_every_transition_out_of_work_says_so_with_zeros(graph, transitions: list[int], ending: str):
    heard = last(graph)
    armed(graph, driver="simulated", **LONG)
    drive(graph)
    graph.wait(lambda: moving(heard), "a current")
    for transition in transitions:
        assert change(graph, transition)
    graph.wait(lambda: says(heard, ending), "zeros and the reason")


def test_a_bridge_that_was_killed_while_armed_waits_for_a_reset(graph, programs):
    heard = last(graph)
    states = heard[topics.BRIDGE_STATE.name]
    bridge = process(graph, programs, autostart="armed")
    armed_and_driving(graph, heard)
    bridge.kill()
    states.clear()
    bridge = process(graph, programs, autostart="armed")
    # The last message of the one before may still be on its way.
    graph.wait(lambda: bool(states) and UNCLEAN_END in reasons(states), "the fault", TIMEOUT)
    graph.wait(lambda: bool(states[-1].driver_ready), "the driver", TIMEOUT)
    assert states[-1].state == CoilBridgeState.STATE_FAULT
    assert not arm(graph).success
    assert press(graph, Service.EMERGENCY_STOP).success
    bridge.kill()  # at once after the answer
    states.clear()
    bridge = process(graph, programs, autostart="armed")
    graph.wait(lambda: bool(states) and states[-1].driver_ready, "the bridge", TIMEOUT)
    assert states[-1].emergency_stopped
    way_out = "fault: emergency stop, kept over a restart; call coils/reset, then coils/arm"
    assert re.search(rf"\[ERROR\] .*{way_out}", bridge.output)
    assert stage(graph) == "inactive"
    assert not any(state.armed for state in states)
    assert press(graph, Service.RESET).success
    assert stage(graph) == "active"
    graph.wait(lambda: not states[-1].emergency_stopped, "the reset")
    assert not states[-1].armed  # not by itself
    armed_and_driving(graph, heard)


def test_a_bridge_that_was_frozen_while_it_drove_is_in_fault(graph, programs, tmp_path: Path):
    """Its boards, on pseudo-terminals, stop by themselves meanwhile; a person has to look where the needle is."""
    heard, ports = last(graph), [str(tmp_path / "a"), str(tmp_path / "b")]
    states = heard[topics.BRIDGE_STATE.name]
    boards = {"power_stage": "roboclaw", "power_stage_ports": ports, "scene": READY["scene"], "frame_rate": 5.0}
    rig = graph.add(RigSimulatorNode, **boards).rig
    given = {"roboclaw_ports": f"[{', '.join(ports)}]", "roboclaw_addresses": "[128, 129]"}
    bridge = process(graph, programs, driver="roboclaw", **given)
    armed_and_driving(graph, heard, lambda: bool(np.abs(rig.currents).max() > 0.1))
    bridge.send_signal(signal.SIGSTOP)
    graph.wait(lambda: bool(np.abs(rig.currents).max() < 1e-3), "the boards to stop")
    states.clear()
    bridge.send_signal(signal.SIGCONT)

    def is_in_fault() -> bool:
        assert np.abs(rig.currents).max() < 1e-3  # from the first moment on
        return bool(states) and states[-1].state == CoilBridgeState.STATE_FAULT

    graph.wait(is_in_fault, "the fault", TIMEOUT)


def test_a_scene_that_waited_while_the_bridge_was_frozen_hides_no_fault(graph, monkeypatch: pytest.MonkeyPatch):
    node = armed(graph, **LONG)
    drive_until(graph, lambda: driven(node), "a current")
    real = node.system.driver.state
    with graph.between_callbacks():
        monkeypatch.setattr(node.system.driver, "state", lambda: replace(real(), timeout=0.2))
        now, arrival = node._times()
        monkeypatch.setattr(node, "_times", lambda: (now + 0.5, arrival + 0.5))
        node.on_scene(read_scene("hernia_ring"))
        found = re.search(r"the bridge stood still for ([0-9.]+) s", node.system.latch.fault)
        assert found
        assert float(found[1]) >= 0.5  # and what the machine takes
        assert not node.system.output.allocation.currents.any()


def test_a_barrier_is_imported_when_the_bridge_starts_or_not_at_all(
    graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """An import takes any time, in which no emergency stop would be answered."""
    for name in ("early_barriers", "late_barriers"):
        source = "from magnetosuture_thread import Barrier\n\n\nclass KeepIn(Barrier):\n    pass\n"
        (tmp_path / f"{name}.py").write_text(source)
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    node = graph.add(CoilBridgeNode, autostart="unconfigured", barriers=["early_barriers:KeepIn"], **READY)
    assert "early_barriers" in sys.modules
    with graph.between_callbacks():
        (result,) = node.set_parameters([Parameter("barriers", value=["late_barriers:KeepIn"])])
    assert result.successful
    assert not change(graph, Transition.TRANSITION_CONFIGURE)
    assert "named when the node started" in str(node.problem)
    assert "late_barriers" not in sys.modules


def test_a_stop_that_cannot_be_kept_is_an_error_at_configure(graph):
    with pytest.raises(InvalidInputError, match=r"coil_bridge\.stop_file: got .*, expected a file that can"):
        graph.add(CoilBridgeNode, stop_file="/dev/full", **READY)


def test_a_full_disk_holds_up_no_stop(graph, monkeypatch: pytest.MonkeyPatch):
    node = armed(graph, **LONG)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    seen: list[bool] = []

    def full(**_: bool) -> None:
        seen.append(bool(applied(node)[-1].any()))
        raise InvalidInputError("stop_file", "No space left on device", "a file that can be written")

    monkeypatch.setattr(node.system, "remember", full)
    answer = press(graph, Service.EMERGENCY_STOP)
    assert answer.success
    assert "No space left" in answer.message
    assert seen[0] is False  # the coils were at zero before the disk was asked
