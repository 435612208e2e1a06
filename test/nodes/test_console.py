"""The operator's page's side of a graph, with the real coil bridge, and what it is told of each message."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from magnetosuture_msgs.msg import BarrierMargin, SafetyMargins, ThreadForecast
from rclpy.node import Node

from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.nodes import console as console_graph
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import Participant
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.console import ConsoleGraph
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.interface import PRESS_TIMEOUT, Service
from test.nodes import wire


@pytest.fixture
def node(graph) -> Iterator[Node]:
    """The console's node, in the graph of the test."""
    with Participant("console", domain=graph.domain) as made:
        yield made.node


@pytest.fixture
def console(node: Node) -> ConsoleGraph:
    """The graph as the page has it."""
    return ConsoleGraph(node, ConsoleSettings())


def tell(graph, topic: topics.Topic, message, until: Callable[[], object], what: str) -> None:
    """Say something again and again until the page knows; what was said before it was found is lost."""

    def told() -> bool:
        graph.publish(topic, message)
        return bool(until())

    graph.wait(told, what)


def test_real_messages_are_told_and_forgotten_at_a_new_beginning(graph, console):
    stamp = graph.now()
    assert console.state()["needle"] is None
    assert console.state()["scene"] is None
    scene = wire.scene_message(stamp, read_scene("dish_35mm_post"))
    pose = wire.pose_message(stamp, np.array([0.003, -0.004]), np.array([0.0, 1.0]))
    path = wire.path_message(stamp, np.array([[0.0, 0.0], [0.001, 0.0]]))
    margins = wire.no_margins(stamp, "no pose")
    tell(graph, topics.SCENE, scene, lambda: console.state()["scene"], "the scene")
    tell(graph, topics.NEEDLE_POSE, pose, lambda: console.state()["needle"], "the pose")
    tell(graph, topics.MEASURED_THREAD, path, lambda: console.state()["measured"], "the seen thread")
    tell(graph, topics.MARGINS, margins, lambda: console.state()["margins"], "the margins")
    state = console.state()
    assert state["needle"]["tail"] == [0.003, -0.004]
    assert state["needle"]["heading"] == pytest.approx(np.pi / 2)
    assert 0.0 <= state["needle"]["age"] < 60.0
    assert state["measured"] == [[0.0, 0.0], [0.001, 0.0]]
    assert state["margins"]["reason"] == "no pose"
    assert state["scene"]["dish_diameter"] == 0.035
    assert [shape["disc"] for shape in state["scene"]["shapes"]] == [[0.0077, 0.0039, 0.0015]]
    console.begin(ConsoleSettings(scene="dish_150mm"))
    state = console.state()
    assert (state["needle"], state["measured"]) == (None, [])
    graph.wait(lambda: len(console.state()["scene"]["shapes"]) == 1, "what is said once and for all")


def report(names: list[str], text: str = "") -> DiagnosticArray:
    """Return a report of nodes, each with a text as name, message, key and value."""
    values = [KeyValue(key=f"{number}{text}", value=text) for number in range(50)] if text else []
    return DiagnosticArray(
        status=[DiagnosticStatus(name=f"{name}{text}: state", message=text or "ok", values=values) for name in names]
    )


def known_part(console: ConsoleGraph, name: str) -> object:
    """Return a part of what the page knows."""
    return console.state()[name]


def test_the_axis_of_a_needle_is_told_and_a_point_at_its_tip_is_published(graph, console):
    tips, tail = graph.listen(topics.NEEDLE_TIP), np.array([0.002, -0.001])
    for deviation, known, unknown in ((0.1, "needle", "axis"), (np.inf, "axis", "needle")):
        pose = wire.pose_message(graph.now(), tail, np.array([1.0, 0.0]), np.diag([1e-9, 1e-9, deviation**2]))
        tell(graph, topics.NEEDLE_POSE, pose, partial(known_part, console, known), known)
        assert console.state()[known]["tail"] == pytest.approx(tail)
        assert console.state()[unknown] is None

    def told() -> bool:
        assert asyncio.run(console.point_at_tip((0.004, -0.001))) == ""
        return bool(tips)

    graph.wait(told, "the point")
    assert (tips[0].point.x, tips[0].point.y) == (0.004, -0.001)
    console.blocked = "starting"
    assert asyncio.run(console.point_at_tip((0.0, 0.0))) == "starting"


def test_a_flood_of_diagnostics_keeps_the_state_small_and_our_own_nodes_in_it(graph, console, monkeypatch):
    graph.add(CoilBridgeNode)
    graph.wait(lambda: "coil_bridge" in console.nodes(), "the bridge's report")
    tell(graph, topics.DIAGNOSTICS, report(["hello"]), lambda: "hello" in console.nodes(), "another node")
    for number in range(200):
        graph.publish(topics.DIAGNOSTICS, report([f"stranger {number}-{part}" for part in range(40)]))
        graph.publish(topics.DIAGNOSTICS, report([f"long {number}"], "x" * 600))
        assert len(console.nodes()) <= 32
        assert len(json.dumps(console.state())) < 300_000
    tell(graph, topics.DIAGNOSTICS, report(["last"]), lambda: "last" in console.nodes(), "another node")
    graph.publish(topics.DIAGNOSTICS, report(["huge"], "x" * 100_000))
    tell(graph, topics.DIAGNOSTICS, report(["after"]), lambda: "after" in console.nodes(), "another node")
    nodes = console.nodes()
    assert "coil_bridge" in nodes
    assert not any(name.startswith("huge") for name in nodes)
    assert max(len(name) for name in nodes) <= 100
    monkeypatch.setattr(console_graph, "DROP_TIMEOUT", 0.1)
    graph.wait(lambda: set(console.nodes()) == {"coil_bridge"}, "the silent nodes to be dropped")


@pytest.mark.parametrize("transport", ["compressed", "raw"])
def test_camera_frames_are_numbered_pictures(graph, node, transport: str):
    console = ConsoleGraph(node, ConsoleSettings(image_transport=transport))
    assert console.frame() is None
    pixels = np.full((120, 160, 3), (200, 60, 30), np.uint8)
    done, jpeg = cv2.imencode(".jpg", pixels)
    assert done
    if transport == "raw":
        topic, message = topics.IMAGE, wire.image(graph.now(), pixels)
    else:
        topic, message = topics.COMPRESSED_IMAGE, wire.compressed_image(graph.now(), jpeg.ravel())
    tell(graph, topic, message, console.frame, "a frame")
    first = console.frame()
    assert first is not None
    tell(graph, topic, message, lambda: (console.frame() or first)[0] > first[0], "another")
    newest = console.frame()
    assert newest is not None
    shown = cv2.imdecode(np.frombuffer(newest[1], np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert np.abs(shown.astype(int) - pixels).max() < 12


def test_an_arm_that_waited_for_the_bridge_does_not_arm_it(graph, console):
    assert asyncio.run(console.execute_action("arm")) == "no service coils/arm within 1 s"
    node = graph.add(CoilBridgeNode, scene="dish_35mm")
    graph.wait(lambda: console.state() and console.services.ready(Service.ARM), "the bridge")
    assert not node.system.latch.armed
    with ThreadPoolExecutor(1) as page:
        with graph.between_callbacks():
            answer = page.submit(lambda: asyncio.run(console.execute_action("arm")))
            time.sleep(2.0 * PRESS_TIMEOUT + 0.1)  # after the last repetition of the call too
        assert "s old" in answer.result()
    assert not node.system.latch.armed
    assert asyncio.run(console.execute_action("arm")) == ""
    assert node.system.latch.armed


def test_procedures_are_planned_begun_paused_and_given_up_by_the_page(graph, console):
    """With the real needle planner, and somebody who shows a needle."""
    assert console.state()["procedure"] is None
    assert console.state()["procedures"] == ["square"]  # the others need shapes
    told = wire.scene_message(1, read_scene("five_posts"))
    allowed = ["slalom", "square"]
    tell(graph, topics.SCENE, told, lambda: console.state()["procedures"] == allowed, "what the scene allows")
    graph.add(NeedlePlannerNode, scene="dish_35mm", needle_length=0.0025, settle=0.0, pose_timeout=5.0)
    commands, holds = graph.listen(topics.NEEDLE_COMMAND), graph.listen(topics.PROCEDURE_HOLD)
    later = int(1e9 * (time.time() + 3600.0))  # ns; late poses are refused, however slowly the test runs
    pose = wire.pose_message(later, np.zeros(2), np.array([1.0, 0.0]))
    near = "goals: [{go_to: {position: [0.008, 0.0]}}]"
    graph.wait(lambda: console.state() and console.services.ready(Service.RESUME_PROCEDURE), "the planner")
    refusal = asyncio.run(console.execute_procedure("resume", "", False))
    assert "no procedure" in refusal

    def planned() -> bool:
        graph.publish(topics.NEEDLE_POSE, pose)
        return not asyncio.run(console.execute_procedure("plan", near, True))

    graph.wait(planned, "the plan", timeout=60.0)

    def is_shown() -> bool:
        graph.publish(topics.NEEDLE_POSE, pose)  # without poses a plan is given up
        state = console.state()
        return (state["procedure"] or {}).get("state") == "ready" and len(state["plan"]) > 10

    graph.wait(is_shown, "state and plan")
    assert asyncio.run(console.execute_procedure("resume", "", False)) == ""

    def is_in(state: str, reason: str) -> bool:
        graph.publish(topics.NEEDLE_POSE, pose)
        shown = console.state()["procedure"]
        return bool(shown["state"] == state and reason in shown["reason"])

    graph.wait(lambda: is_in("paused", "no thread yet"), "it to wait for the thread")
    console.publish_hold()
    graph.wait(lambda: bool(holds), "the hold")
    assert asyncio.run(console.execute_procedure("pause", "", False)) == ""
    graph.wait(lambda: is_in("paused", "by a person"), "the pause")
    assert asyncio.run(console.execute_procedure("abort", "", False)) == ""
    graph.wait(lambda: is_in("failed", "by a person"), "the end")
    assert commands == []
    console.blocked = "starting"
    assert asyncio.run(console.execute_procedure("plan", near, False)) == "starting"


def plain(shown: Any) -> Any:
    """Return what a page gets; a value that JSON does not know is an error."""
    return json.loads(json.dumps(shown, allow_nan=False))


def test_the_forecast_has_ghosts_and_what_happens_first():
    """Eleven instants of two nodes, which move by 1 mm in each."""
    positions = [Point(x=1e-3 * k, y=0.1 * node) for k in range(11) for node in range(2)]
    message = ThreadForecast(time=[0.3 * k for k in range(11)], horizon=3.0, positions=positions)
    message.contact_time, message.contact_shape = 1.44, "left_tissue"
    message.friction_time, message.rest_time = 0.81, math.nan
    shown = plain(console_graph.forecast(message))
    assert shown["events"] == ["friction in 0.8 s", "touches the left tissue in 1.4 s"]
    assert [ghost["time"] for ghost in shown["ghosts"]] == pytest.approx([0.9, 2.1, 3.0])
    assert shown["ghosts"][-1]["vertices"] == [[0.01, 0.0], [0.01, 0.1]]
    # What holds already is not announced; a needle that rests is.
    message.contact_time, message.friction_time, message.rest_time = 0.0, 0.0, 0.0
    assert plain(console_graph.forecast(message))["events"] == ["needle rests"]
    message.positions = positions[:-1]
    with pytest.raises(InvalidInputError, match="as many positions at each instant"):
        console_graph.forecast(message)


def test_of_each_node_the_least_clearance_of_wall_and_shapes():
    message = SafetyMargins(
        valid=True,
        barrier_names=["connectivity", "obstacle", "wall"],
        barrier=[0, 1, 1, 1, 2],
        node=[3, 1, 1, 2, 4],
        obstacle=[-1, 0, 1, 1, -1],
        value=[0.0] * 5,
        clearance=[0.0, 5e-4, 2e-4, 0.0, 3e-4],
        minimum=[
            BarrierMargin(barrier="obstacle", node=2, clearance=0.0),
            BarrierMargin(barrier="connectivity", clearance=1e-6),
        ],
        contact_nodes=[2],
        friction_state=SafetyMargins.FRICTION_SLIDING,
        friction_nodes=[1, 2],
        slowdown=0.81,
    )
    shown = plain(console_graph.margins(message))
    assert shown["clearance"] == [None, 2e-4, 0.0, None, 3e-4]
    assert shown["least"] == {"obstacle": 0.0, "connectivity": 1e-6}
    assert shown["contact"] == [2]
    assert shown["friction"] == {"state": "sliding", "nodes": [1, 2], "slowdown": 0.81}
    assert (shown["valid"], shown["reason"]) == (True, "")


def test_margins_of_a_node_that_no_thread_has_are_refused():
    with pytest.raises(InvalidInputError, match="less than 2001"):
        console_graph.margins(SafetyMargins(valid=True, node=[4294967295], barrier=[0], clearance=[0.0]))
