"""The coil bridge in a graph."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped

from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode


def command(graph, x: float = 0.01, y: float = 0.0) -> TwistStamped:
    """Return a velocity command made now."""
    return messages.twist_message(graph.now(), np.array([x, y]))


def test_a_command_reaches_the_driver_and_the_topics(graph):
    bridge = graph.add(CoilBridgeNode)
    currents, setpoints = graph.listen(topics.CURRENTS), graph.listen(topics.NEEDLE_SETPOINT)
    asked = command(graph)
    graph.publish(topics.NEEDLE_COMMAND, asked)
    graph.wait(lambda: any(max(m.current) > 0 for m in currents), "a current")
    driven = next(m for m in currents if max(m.current) > 0)
    assert driven.header.stamp == asked.header.stamp
    assert list(driven.coil) == ["coil_0", "coil_1", "coil_2", "coil_3"]
    assert list(driven.current) == pytest.approx([2.0, 0.0, 0.0, 0.0], abs=1e-3)
    assert not driven.saturated
    graph.wait(lambda: any(m.twist.linear.x > 0 for m in setpoints), "a setpoint")
    assert any(applied[0] == pytest.approx(2.0, abs=1e-3) for applied in bridge.driver.applied)


def test_silence_stops_the_coils_and_the_next_command_starts_them(graph):
    bridge = graph.add(CoilBridgeNode, zero_hold=0.2)
    currents, diagnostics = graph.listen(topics.CURRENTS), graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any(max(m.current) > 0 for m in currents), "a current")
    graph.wait(lambda: max(currents[-1].current) == 0.0, "zero current")
    assert bridge.driver.applied[-1].tolist() == [0.0] * 4
    graph.wait(lambda: any("stopped: no command for" in d.status[0].message for d in diagnostics), "the reason")
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: max(currents[-1].current) > 0.0, "a current again")


def test_the_watchdog_does_not_depend_on_simulated_time(graph):
    """With /clock standing still the coils must stop all the same."""
    bridge = graph.add(CoilBridgeNode, use_sim_time=True)
    currents = graph.listen(topics.CURRENTS)
    still = messages.twist_message(Time(), np.array([0.01, 0.0]))  # time 0, as the clock that never came
    graph.publish(topics.NEEDLE_COMMAND, still)
    graph.wait(lambda: any(max(m.current) > 0 for m in currents), "a current")
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
    assert not any(applied.any() for applied in bridge.driver.applied)
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any(applied.any() for applied in bridge.driver.applied), "a good command")


def test_currents_stay_within_their_limit_and_saturation_is_said(graph):
    bridge = graph.add(CoilBridgeNode, max_current=1.5, max_speed=0.5)
    currents = graph.listen(topics.CURRENTS)
    graph.publish(topics.NEEDLE_COMMAND, command(graph, x=9.0))
    graph.wait(lambda: any(m.saturated for m in currents), "saturation")
    assert max(applied.max() for applied in bridge.driver.applied) <= 1.5


def test_the_coils_are_left_at_zero(graph):
    bridge = graph.add(CoilBridgeNode, command_timeout=1.0)
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any(applied.any() for applied in bridge.driver.applied), "a current")
    assert bridge.driver.applied[-1].any()
    graph.remove(bridge)
    assert bridge.driver.applied[-1].tolist() == [0.0] * 4


def test_zeros_say_why(graph):
    graph.add(CoilBridgeNode)
    currents = graph.listen(topics.CURRENTS)
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: any(not m.stop for m in currents), "a current")
    graph.wait(lambda: currents[-1].stop.startswith("no command for"), "the reason")
