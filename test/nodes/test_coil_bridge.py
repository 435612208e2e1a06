"""The coil bridge in a graph: commands and poses in, currents out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped
from magnetosuture_msgs.msg import CoilBridgeState
from rosgraph_msgs.msg import Clock

from magnetosuture_thread.coils.needle_motion import NeedleTwist
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.nodes import topics
from test.nodes import wire
from test.nodes.bridge import (
    EAST,
    LONG,
    SCENE,
    TAIL,
    applied,
    armed,
    command,
    drive,
    drive_until,
    driven,
    reasons,
)


def test_a_command_reaches_the_driver_and_the_topics(graph):
    node = armed(graph, **LONG)
    currents, setpoints = graph.listen(topics.CURRENTS), graph.listen(topics.NEEDLE_SETPOINT)
    states = graph.listen(topics.BRIDGE_STATE)
    asked = drive(graph)
    graph.wait(lambda: any(m.command == asked.header.stamp for m in currents), "currents for the command")
    expected = CoilBridgeSettings().allocation().allocate(NeedleTwist(0.005), TAIL, EAST, at_tip=True).currents
    assert expected[0] > 2.0
    drive_until(
        graph, lambda: any(np.allclose(told, expected, atol=0.05) for told in applied(node)), "the full currents"
    )
    last = next(m for m in reversed(currents) if not m.stop)
    assert list(last.coil) == ["coil_0", "coil_1", "coil_2", "coil_3"]
    assert not last.saturated
    full = pytest.approx(0.005, rel=0.02)
    drive_until(graph, lambda: any(setpoint.twist.linear.x == full for setpoint in setpoints), "setpoint")

    def following() -> list[Any]:
        return [state for state in states if state.armed and not state.reasons and state.applied.x == full]

    drive_until(graph, following, "the state, with the velocity applied")
    state = following()[-1]
    assert state.state == CoilBridgeState.STATE_ACTIVE
    assert state.commanded.x == state.filtered.x == 0.005
    assert (state.driver, state.driver_ready) == ("recording", True)


def test_a_pose_that_grows_old_stops_the_coils_while_commands_go_on(graph):
    node = armed(graph, pose_timeout=0.05, command_timeout=1.0)
    currents = graph.listen(topics.CURRENTS)
    drive_until(graph, lambda: driven(node), "a current")

    def is_stopped() -> bool:
        """Tell by both at once: poses that are still under way may make it drive once more."""
        stopped = bool(currents) and currents[-1].stop == "no needle pose for 0.05 s"
        return stopped and not applied(node)[-1].any()

    graph.wait(is_stopped, "the stop")


def test_a_bad_pose_is_not_used(graph):
    node = armed(graph, **LONG)
    states, diagnostics = graph.listen(topics.BRIDGE_STATE), graph.listen(topics.DIAGNOSTICS)
    pose = wire.pose_message(graph.now(), np.zeros(2), EAST)
    pose.header.frame_id = "map"
    graph.publish(topics.NEEDLE_POSE, pose)
    graph.wait(lambda: any("needle/measured_cp" in str(d.status[0].values) for d in diagnostics), "a refusal")
    graph.publish(topics.NEEDLE_COMMAND, command(graph))
    graph.wait(lambda: reasons(states) == "no needle pose yet", "the reason")
    assert states[-1].refused >= 1
    assert not driven(node)


def test_silence_stops_the_coils_and_the_next_command_starts_them(graph):
    node = armed(graph, zero_hold=0.2, pose_timeout=1.0)
    currents, diagnostics = graph.listen(topics.CURRENTS), graph.listen(topics.DIAGNOSTICS)
    drive_until(graph, lambda: driven(node), "a current")
    graph.wait(lambda: not applied(node)[-1].any(), "zero current")
    graph.wait(lambda: any("no command for 0.1 s" in d.status[0].message for d in diagnostics), "the reason")
    # On a busy machine another reason may come after it.
    graph.wait(lambda: "no command for 0.1 s" in [each.stop for each in currents], "the reason with the currents")
    drive_until(graph, lambda: np.any(currents[-1].current), "a current again")


def test_the_watchdog_does_not_depend_on_simulated_time(graph):
    """With /clock standing still the coils must stop all the same; before it runs nothing is good."""
    node = armed(graph, use_sim_time=True)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_COMMAND, wire.twist_message(Time(), np.array([0.01, 0.0])))
    graph.wait(lambda: any("0 is none in ROS" in str(d.status[0].values) for d in diagnostics), "a refusal")
    now = Time(sec=50)
    clock = graph.probe.create_publisher(Clock, "/clock", topics.CLOCK.qos)
    graph.wait(lambda: clock.get_subscription_count() > 0, "who wants the time")

    def running() -> bool:
        clock.publish(Clock(clock=now))
        return bool(node.get_clock().now().nanoseconds == 50 * 10**9)

    graph.wait(running, "the time")
    graph.publish(topics.NEEDLE_POSE, wire.pose_message(now, TAIL, EAST))
    graph.publish(topics.NEEDLE_COMMAND, wire.twist_message(now, np.array([0.01, 0.0])))
    graph.wait(lambda: driven(node), "a current")
    graph.wait(lambda: not applied(node)[-1].any(), "zero current")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: setattr(m.twist.linear, "x", math.nan), "finite numbers"),
        (lambda m: setattr(m.header, "frame_id", "base_link"), "'dish'"),
        (lambda m: setattr(m.header, "stamp", Time(sec=5)), "at most 0.1 s"),
        (lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec + 60), "at most 0.05 s"),
    ],
)
def test_a_bad_command_never_reaches_the_driver(graph, spoil, words):
    node = armed(graph, pose_timeout=1.0)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, wire.pose_message(graph.now(), TAIL, EAST))
    bad = command(graph)
    spoil(bad)
    graph.publish(topics.NEEDLE_COMMAND, bad)
    graph.wait(lambda: any(words in str(d.status[0].values) for d in diagnostics), "a refusal")
    assert not driven(node)
    drive_until(graph, lambda: driven(node), "a good command")


@pytest.mark.parametrize("offset_ms", [-300, 300])
def test_the_offset_of_another_hosts_clock_is_measured_and_its_commands_refused(graph, offset_ms):
    node = armed(graph, pose_timeout=1.0)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, wire.pose_message(graph.now(), TAIL, EAST))

    def age_of(topic: str) -> float:
        values = {each.key: each.value for each in diagnostics[-1].status[0].values} if diagnostics else {}
        return float(values.get(f"minimum age of {topic} [ms]", "inf"))

    def minimum_age() -> float:
        graph.publish(topics.NEEDLE_COMMAND, wire.twist_message(shifted(graph.now(), offset_ms), EAST))
        return age_of("needle/servo_cv")

    # The age has the transport in it, which on a busy machine takes its time.
    graph.wait(lambda: -offset_ms <= minimum_age() < 250 - offset_ms, "the offset")
    assert math.isnan(age_of("operator/servo_cv"))  # nobody commands there
    assert not driven(node)


def shifted(stamp: Time, milliseconds: int) -> Time:
    """Return a stamp of a clock that is ahead."""
    nanoseconds = stamp.sec * 10**9 + stamp.nanosec + milliseconds * 10**6
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


@pytest.mark.parametrize("damaged", [True, False], ids=["damaged", "no room"])
def test_a_scene_that_is_refused_stops_the_needle_until_a_good_one_comes(graph, damaged: bool):
    """The setup's scene goes on to be in force, but nobody knows whether it still is what stands in the dish."""
    node, states = armed(graph, **LONG), graph.listen(topics.BRIDGE_STATE)
    drive_until(graph, lambda: driven(node), "the needle to be driven")
    refused = wire.scene_message(graph.now(), Scene() if damaged else Scene(Dish(0.006)))
    refused.wall_friction = 0.1 if damaged else 0.0
    graph.publish(topics.SCENE, refused)
    words = "scene.version: got" if damaged else "room for the needle"
    graph.wait(lambda: "scene refused: " in reasons(states) and words in reasons(states), "the reason")
    stopped = len(applied(node))
    drive(graph)
    graph.wait(lambda: len(applied(node)) > stopped + 10, "steps")
    assert not any(currents.any() for currents in applied(node)[stopped:])
    graph.publish(topics.SCENE, wire.scene_message(graph.now(), read_scene(SCENE)))
    drive_until(graph, lambda: applied(node)[-1].any(), "the needle to be driven again")


def test_two_publishers_at_once_stop_the_needle(graph):
    node = armed(graph, **LONG)
    states = graph.listen(topics.BRIDGE_STATE)
    drive(graph)
    graph.wait(lambda: driven(node), "a current")
    other = graph.probe.create_publisher(TwistStamped, topics.NEEDLE_COMMAND.name, 10)
    graph.wait(lambda: other.get_subscription_count() > 0, "the bridge")
    own = next(s for s in node.subscriptions if s.topic_name == "/needle/servo_cv")
    graph.wait(lambda: own.get_publisher_count() == 2, "the other to be found")
    other.publish(command(graph, -0.01))
    graph.wait(lambda: "several publishers" in reasons(states), "the stop")
    assert not applied(node)[-1].any()
    assert min(a[0] for a in applied(node)) > -1.0  # the other was not followed for a moment
    graph.wait(lambda: "several publishers" not in reasons(states), "one of them to be silent")
