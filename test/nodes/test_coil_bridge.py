"""The coil bridge in a graph."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode

EAST = np.array([1.0, 0.0])


def command(graph, x: float = 0.01, y: float = 0.0) -> TwistStamped:
    """Return a velocity command made now."""
    return messages.twist_message(graph.now(), np.array([x, y]))


def drive(graph, x: float = 0.005, y: float = 0.0) -> TwistStamped:
    """Say where the needle is, then ask for a velocity; return that command."""
    pose = messages.pose_message(graph.now(), np.array([-0.0035, 0.0]), np.array([1.0, 0.0]))
    graph.publish(topics.NEEDLE_POSE, pose)
    asked = command(graph, x, y)
    graph.publish(topics.NEEDLE_COMMAND, asked)
    return asked


def driven(currents) -> bool:
    """Return whether any current was on."""
    return any(np.any(m.current) for m in currents)


def test_a_command_reaches_the_driver_and_the_topics(graph):
    bridge = graph.add(CoilBridgeNode)
    currents, setpoints = graph.listen(topics.CURRENTS), graph.listen(topics.NEEDLE_SETPOINT)
    asked = drive(graph)
    graph.wait(lambda: any(m.header.stamp == asked.header.stamp for m in currents), "currents for the command")
    first = next(m for m in currents if m.header.stamp == asked.header.stamp)
    assert list(first.coil) == ["coil_0", "coil_1", "coil_2", "coil_3"]
    expected = CoilBridgeSettings().allocation().allocate(np.array([0.005, 0.0]), np.array([-0.0035, 0.0]), EAST)
    assert list(first.current) == pytest.approx(expected.currents.tolist(), abs=0.05)
    assert expected.currents[0] > 2.0
    assert not first.saturated
    graph.wait(lambda: any(m.twist.linear.x > 0 for m in setpoints), "a setpoint")
    assert next(m for m in setpoints if m.twist.linear.x > 0).twist.linear.x == pytest.approx(0.005, rel=0.02)
    assert any(applied[0] == first.current[0] for applied in list(bridge.driver.applied))


@pytest.mark.parametrize("tail", [(1e200, 0.0), (0.05, 0.025), (-1e-320, 1e308)])
def test_a_pose_that_cannot_be_does_not_end_the_bridge(graph, tail):
    bridge = graph.add(CoilBridgeNode)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, messages.pose_message(graph.now(), np.array(tail), EAST))
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any("of the dish's centre" in str(d.status[0].values) for d in diagnostics), "a refusal")
    assert not any(applied.any() for applied in list(bridge.driver.applied))
    drive(graph)
    graph.wait(lambda: any(applied.any() for applied in list(bridge.driver.applied)), "a good pose")


def test_between_commands_the_currents_follow_the_needle(graph):
    """The bridge lays the field along the needle as it turns, at its own rate."""
    graph.add(CoilBridgeNode, command_timeout=0.3, pose_timeout=0.3)
    currents = graph.listen(topics.CURRENTS)
    drive(graph, 0.0, 0.003)
    graph.wait(lambda: sum(np.any(m.current) for m in currents) > 10, "currents without another command")
    on = [m.current for m in currents if np.any(m.current)]
    assert len({tuple(current) for current in on}) > 5


def test_without_a_pose_there_is_no_current(graph):
    bridge = graph.add(CoilBridgeNode)
    currents = graph.listen(topics.CURRENTS)
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any(m.stop == "no needle pose" for m in currents), "the reason")
    assert not any(applied.any() for applied in list(bridge.driver.applied))


def test_a_pose_that_grows_old_stops_the_coils_while_commands_go_on(graph):
    bridge = graph.add(CoilBridgeNode, pose_timeout=0.05, command_timeout=1.0)
    currents = graph.listen(topics.CURRENTS)
    drive(graph)
    graph.wait(lambda: driven(currents), "a current")
    graph.wait(lambda: currents[-1].stop == "no needle pose", "the stop")
    assert bridge.driver.applied[-1].tolist() == [0.0] * 4


@pytest.mark.parametrize(
    "spoil", [lambda m: setattr(m.header, "stamp", Time(sec=5)), lambda m: setattr(m.header, "frame_id", "map")]
)
def test_a_bad_pose_is_not_used(graph, spoil):
    bridge = graph.add(CoilBridgeNode)
    currents, diagnostics = graph.listen(topics.CURRENTS), graph.listen(topics.DIAGNOSTICS)
    pose = messages.pose_message(graph.now(), np.zeros(2), EAST)
    spoil(pose)
    graph.publish(topics.NEEDLE_POSE, pose)
    graph.wait(lambda: any("refused: needle/measured_cp" in d.status[0].message for d in diagnostics), "a refusal")
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any(m.stop == "no needle pose" for m in currents), "the reason")
    assert not any(applied.any() for applied in list(bridge.driver.applied))


def test_silence_stops_the_coils_and_the_next_command_starts_them(graph):
    bridge = graph.add(CoilBridgeNode, zero_hold=0.2)
    currents, diagnostics = graph.listen(topics.CURRENTS), graph.listen(topics.DIAGNOSTICS)
    drive(graph)
    graph.wait(lambda: driven(currents), "a current")
    graph.wait(lambda: not np.any(currents[-1].current), "zero current")
    assert bridge.driver.applied[-1].tolist() == [0.0] * 4
    graph.wait(lambda: any("stopped: no command for" in d.status[0].message for d in diagnostics), "the reason")
    drive(graph)
    graph.wait(lambda: np.any(currents[-1].current), "a current again")


def test_the_watchdog_does_not_depend_on_simulated_time(graph):
    """With /clock standing still the coils must stop all the same."""
    bridge = graph.add(CoilBridgeNode, use_sim_time=True)
    currents = graph.listen(topics.CURRENTS)
    graph.publish(topics.NEEDLE_POSE, messages.pose_message(Time(), np.array([-0.0035, 0.0]), EAST))
    still = messages.twist_message(Time(), np.array([0.01, 0.0]))  # time 0, as the clock that never came
    graph.publish(topics.NEEDLE_COMMAND, still)
    graph.wait(lambda: driven(currents), "a current")
    graph.wait(lambda: bridge.driver.applied[-1].tolist() == [0.0] * 4, "zero current")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: setattr(m.twist.linear, "x", math.nan), "finite numbers"),
        (lambda m: setattr(m.twist.linear, "y", -math.inf), "finite numbers"),
        (lambda m: setattr(m.header, "frame_id", "base_link"), "'dish'"),
        (lambda m: setattr(m.header, "stamp", Time(sec=5)), "at most 0.1 s"),
        (lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec + 60), "at most 0.05 s"),
    ],
)
def test_a_bad_command_never_reaches_the_driver(graph, spoil, words):
    bridge = graph.add(CoilBridgeNode)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    bad = command(graph)
    spoil(bad)
    graph.publish(topics.NEEDLE_COMMAND, bad)
    graph.wait(lambda: any(words in d.status[0].message for d in diagnostics), "a refusal")
    assert not any(applied.any() for applied in list(bridge.driver.applied))
    drive(graph)
    graph.wait(lambda: any(applied.any() for applied in list(bridge.driver.applied)), "a good command")


def test_currents_stay_within_their_limit_and_saturation_is_said(graph):
    bridge = graph.add(CoilBridgeNode, max_current=1.5, max_speed=0.5)
    currents = graph.listen(topics.CURRENTS)
    drive(graph, x=9.0)
    graph.wait(lambda: any(m.saturated for m in currents), "saturation")
    assert max(np.abs(applied).max() for applied in list(bridge.driver.applied)) <= 1.5


def test_the_coils_are_left_at_zero(graph):
    bridge = graph.add(CoilBridgeNode, command_timeout=1.0)
    drive(graph)
    graph.wait(lambda: any(applied.any() for applied in list(bridge.driver.applied)), "a current")
    assert bridge.driver.applied[-1].any()
    graph.remove(bridge)
    assert bridge.driver.applied[-1].tolist() == [0.0] * 4


def test_zeros_say_why(graph):
    graph.add(CoilBridgeNode)
    currents = graph.listen(topics.CURRENTS)
    drive(graph)
    graph.wait(lambda: any(not m.stop for m in currents), "a current")
    graph.wait(lambda: currents[-1].stop.startswith("no command for"), "the reason")
