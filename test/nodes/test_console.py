"""The operator's page's side of a graph, with the real coil bridge."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from magnetosuture_msgs.msg import CoilBridgeState, CoilCurrents
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node

from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.jobs.console_hosts import SimulatedHost
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.console import graph as console_graph
from magnetosuture_thread.nodes.console.graph import ConsoleGraph
from magnetosuture_thread.nodes.console.inbox import ConsoleTap, Latest
from magnetosuture_thread.nodes.console.node import GraphHost, joined
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.nodes.processes import graph_environment
from magnetosuture_thread.nodes.rig_simulator import RigSimulatorNode
from magnetosuture_thread.scene import read_scene
from test.nodes import wire
from test.nodes.margins import no_margins

SMALL = {"scene": "dish_35mm", "thread_segments": 12, "needle_start": [0.003, 0.0, 0.0]}


@pytest.fixture
def node(graph) -> Iterator[Node]:
    """The console's node, in the graph of the test."""
    with joined(domain=graph.domain) as made:
        yield made


@pytest.fixture
def console(node: Node) -> ConsoleGraph:
    """The graph as the page has it."""
    return ConsoleGraph(node, ConsoleSettings())


def act(console: ConsoleGraph, action: str) -> str:
    """Press a switch."""
    return asyncio.run(console.execute_action(action))


def bridge(console: ConsoleGraph) -> dict:
    """Return what the page knows of the bridge, or nothing."""
    return console.state()["bridge"] or {}


def tell(graph, topic: topics.Topic, message, until: Callable[[], object], what: str) -> None:
    """Say something again and again until the page knows; what was said before it was found is lost."""

    def told() -> bool:
        graph.publish(topic, message)
        return bool(until())

    graph.wait(told, what)


def test_a_wish_is_published_at_once_with_a_stamp_of_now(graph, console):
    wishes = graph.listen(topics.OPERATOR_COMMAND)
    before = graph.probe.get_clock().now().nanoseconds

    def heard() -> bool:
        console.publish_velocity((0.003, -0.001))
        return bool(wishes)

    graph.wait(heard, "the wish")
    wish = wishes[0]
    assert (wish.twist.linear.x, wish.twist.linear.y) == (0.003, -0.001)
    assert wish.header.frame_id == "dish"
    assert before <= reading.nanoseconds(wish.header.stamp) <= graph.probe.get_clock().now().nanoseconds


def test_the_switches_of_the_real_bridge_are_pressed(graph, console):
    graph.add(CoilBridgeNode, autostart="active", scene="dish_35mm")
    graph.wait(lambda: bridge(console).get("state") == "active", "the bridge")
    assert not bridge(console)["armed"]
    assert act(console, "arm") == ""
    graph.wait(lambda: bridge(console)["armed"], "the bridge to be armed")
    assert act(console, "disarm") == ""
    graph.wait(lambda: not bridge(console)["armed"], "the bridge to be disarmed")
    assert act(console, "arm") == ""
    assert act(console, "stop") == ""
    graph.wait(lambda: bridge(console)["emergency_stopped"], "the emergency stop")
    assert bridge(console)["state"] == "fault"
    assert "emergency stop" in act(console, "arm")
    assert act(console, "reset") == ""
    graph.wait(lambda: bridge(console)["state"] == "active", "the bridge to be active again")
    assert not bridge(console)["armed"]
    assert "expected one of arm, disarm, stop, reset" in act(console, "dance")


def test_a_stop_waits_for_no_other_action_and_ends_one_that_waits(graph, console):
    async def both() -> tuple[str, str]:
        arming = asyncio.create_task(console.execute_action("arm"))  # nobody is there to answer
        await asyncio.sleep(0)
        stopping = asyncio.create_task(console.execute_action("stop"))
        await asyncio.sleep(0.05)
        assert arming.done()
        assert not stopping.done()
        graph.add(CoilBridgeNode, autostart="active", scene="dish_35mm")
        return await arming, await stopping

    armed, stopped = asyncio.run(both())
    assert "later action" in armed
    assert stopped == ""
    graph.wait(lambda: bridge(console).get("emergency_stopped", False), "the emergency stop")
    assert not bridge(console)["armed"]


def test_a_stop_that_is_not_kept_over_a_restart_says_so_on_page_and_terminal(graph, console, monkeypatch):
    node = graph.add(CoilBridgeNode, autostart="active", scene="dish_35mm")
    graph.wait(lambda: bridge(console).get("state") == "active", "the bridge")

    def full() -> None:
        raise InvalidInputError("stop_file", "No space left on device", "a file that can be written")

    monkeypatch.setattr(node.system, "remember", full)
    assert "No space left" in act(console, "stop")
    graph.wait(lambda: bridge(console)["emergency_stopped"], "the emergency stop")
    command = [sys.executable, "-m", "magnetosuture_thread.cli", "coils", "stop"]
    with subprocess.Popen(command, env=graph_environment(graph.domain), stdout=subprocess.PIPE, text=True) as process:
        graph.wait(lambda: process.poll() is not None, "the command to end", timeout=60.0)
        assert process.stdout is not None
        assert "warning: stop_file: got No space left" in process.stdout.read()


def test_a_switch_that_nobody_offers_is_refused_in_words(console, monkeypatch):
    monkeypatch.setattr(console_graph, "TIMEOUT", 0.1)
    assert act(console, "arm") == "no service coils/arm within 0.1 s"


def test_blocked_graph_accepts_only_a_stop(graph, console):
    graph.add(CoilBridgeNode, autostart="active", scene="dish_35mm")
    wishes = graph.listen(topics.OPERATOR_COMMAND)

    def heard(speed: float) -> bool:
        console.publish_velocity((speed, 0.0))
        return bool(wishes) and wishes[-1].twist.linear.x == speed

    graph.wait(lambda: heard(0.001), "a wish")
    console.blocked = "starting petri"
    assert act(console, "arm") == "starting petri"
    console.publish_velocity((0.003, 0.0))
    assert console.state()["filter"]["reason"] == "starting petri"
    console.blocked = ""
    graph.wait(lambda: heard(0.002), "another wish")
    assert {wish.twist.linear.x for wish in wishes} == {0.001, 0.002}
    console.blocked = "starting petri"
    assert act(console, "stop") == ""
    graph.wait(lambda: bridge(console).get("emergency_stopped", False), "the emergency stop")


def test_real_messages_are_told_and_forgotten_at_a_new_beginning(graph, console):
    stamp = graph.now()
    assert console.state()["needle"] is None
    assert console.state()["scene"] is None
    scene = wire.scene_message(stamp, read_scene("dish_35mm_post"))
    pose = wire.pose_message(stamp, np.array([0.003, -0.004]), np.array([0.0, 1.0]))
    path = wire.path_message(stamp, np.array([[0.0, 0.0], [0.001, 0.0]]))
    margins = no_margins(stamp, "no pose")
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


def test_until_a_scene_is_heard_that_of_the_settings_is_shown(graph, node):
    console = ConsoleGraph(node, ConsoleSettings(scene="dish_150mm"))
    assert console.state()["scene"]["dish_diameter"] == 0.15
    damaged = wire.scene_message(graph.now(), read_scene("hernia_ring"))
    damaged.dish_depth *= 1.5
    graph.publish(topics.SCENE, damaged)
    good = wire.scene_message(graph.now(), read_scene("dish_35mm_post"))
    tell(graph, topics.SCENE, good, lambda: console.state()["scene"]["dish_diameter"] == 0.035, "the scene")
    with pytest.raises(ConfigurationError, match="scene: got 'nowhere'"):
        console.begin(ConsoleSettings(scene="nowhere"))
    assert console.state()["scene"]["dish_diameter"] == 0.035


def report(names: list[str], text: str = "") -> DiagnosticArray:
    """Return a report of nodes, each with a text as name, message, key and value."""
    values = [KeyValue(key=f"{number}{text}", value=text) for number in range(50)] if text else []
    return DiagnosticArray(
        status=[DiagnosticStatus(name=f"{name}{text}: state", message=text or "ok", values=values) for name in names]
    )


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


def test_texts_and_lists_of_states_are_cut(graph, console):
    long = CoilBridgeState(reasons=["x" * 500] * 80, driver="y" * 2000, current=[1.0] * 100)
    tell(graph, topics.BRIDGE_STATE, long, lambda: bridge(console), "the state")
    assert len(json.dumps(bridge(console))) < 10_000
    path = wire.path_message(graph.now(), np.zeros((100, 2)))
    endless = wire.path_message(graph.now(), np.zeros((6000, 2)))
    graph.publish(topics.MEASURED_THREAD, endless)
    tell(graph, topics.MEASURED_THREAD, path, lambda: len(console.state()["measured"]) == 100, "the path")


def test_the_age_of_the_camera_image_is_sent(graph, console):
    assert console.state()["camera"] is None
    graph.add(RigSimulatorNode, **SMALL)
    graph.wait(lambda: console.frame() is not None, "a frame")
    assert 0.0 <= console.state()["camera"]["age"] < 60.0


def test_in_a_namespace_nodes_of_other_rigs_are_not_shown(graph):
    names = ("left/coil_bridge", "left/rig_simulator", "right/thread_model", "right/console", "scene_server", "usb_cam")
    with joined(domain=graph.domain, namespace="left") as node:
        console = ConsoleGraph(node, ConsoleSettings())
        report = DiagnosticArray(status=[DiagnosticStatus(name=f"{name}: state", message="x") for name in names])
        tell(graph, topics.DIAGNOSTICS, report, lambda: "usb_cam" in console.nodes(), "the report")
        assert set(console.nodes()) == {"coil_bridge", "rig_simulator", "usb_cam"}
        assert GraphHost(console).state()["simulated"]


def test_a_node_that_says_no_more_is_silent(graph, console, monkeypatch):
    node = graph.add(CoilBridgeNode)
    graph.wait(lambda: "coil_bridge" in console.nodes(), "the bridge's report")
    graph.wait(lambda: console.nodes()["coil_bridge"]["level"] == "ok", "a bridge in order")
    assert console.nodes()["coil_bridge"]["values"]["driver"] == "recording"
    assert console.is_active("coil_bridge")
    monkeypatch.setattr(console_graph, "NODE_TIMEOUT", 0.3)
    graph.remove(node)
    graph.wait(lambda: console.nodes()["coil_bridge"]["level"] == "silent", "silence")
    assert not console.is_active("coil_bridge")


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


def test_with_a_simulated_clock_wishes_are_stamped_by_it(graph):
    rig = graph.add(RigSimulatorNode, use_sim_time=True, **SMALL)
    wishes = graph.listen_later(topics.OPERATOR_COMMAND)
    with joined(domain=graph.domain, simulated_clock=True) as node:
        assert not list(node.services)  # which nobody would answer
        console = ConsoleGraph(node, ConsoleSettings())
        graph.wait(lambda: console.state()["time"] > 1.0, "/clock")

        def heard() -> bool:
            console.publish_velocity((0.001, 0.0))
            return bool(wishes)

        graph.wait(heard, "a wish")
        assert reading.nanoseconds(wishes[0].header.stamp) <= rig.time.stamp(rig.time.elapsed()) < 1000e9


def test_a_rig_is_paused_where_there_is_one(graph, console):
    host = GraphHost(console)
    assert not host.state()["can_pause"]
    assert "no node of this graph" in asyncio.run(host.set_paused(True))
    rig = graph.add(RigSimulatorNode, **SMALL)
    graph.wait(lambda: host.state()["can_pause"] and host.state()["simulated"], "the rig")
    assert asyncio.run(host.set_paused(True)) == ""
    assert host.state()["paused"]
    assert rig.time.paused
    assert asyncio.run(host.set_paused(False)) == ""
    assert not host.state()["paused"]
    assert not rig.time.paused
    assert "not started from the page" in asyncio.run(host.select_setup("petri_150mm_silk"))
    assert "--graph" in asyncio.run(host.set_recording(True, "an operator"))


def test_scenario_that_cannot_be_used_leaves_the_nodes_alone(console, tmp_path: Path):
    unusable = {
        "no_scene": ("/**/thread_model: {ros__parameters: {segments: 25}}", "expected a scene file"),
        "lost_scene": ("/**: {ros__parameters: {scene: nowhere.yaml}}", "nowhere.yaml"),
        "wrong_key": ("/**/thread_model: {ros__parameters: {segmants: 25}}", "segmants"),
    }
    for name, (text, _) in unusable.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    paths = {name: str(tmp_path / f"{name}.yaml") for name in unusable}
    host = SimulatedHost(console, "hernia_ring", list(paths.values()), {}, tmp_path, tmp_path, lambda words: None)
    host._block("")  # as once all its nodes are there
    for name, (_, words) in unusable.items():
        assert words in asyncio.run(host.select_setup(paths[name]))
        assert host.state()["setup"] == "hernia_ring"
        assert host.busy == ""


def test_a_recording_gets_what_was_said_once_and_for_all_and_what_is_said_from_then_on(graph, node):
    graph.listen_later(topics.SCENE)
    graph.publish(topics.SCENE, wire.scene_message(graph.now(), read_scene("dish_35mm_post")))
    taken: list[tuple[str, int, bytes]] = []
    tap = ConsoleTap(node, [topics.SCENE, topics.CURRENTS], None, lambda *message: taken.append(message))

    def taken_both() -> bool:
        tap.poll()
        return {topic for topic, _, _ in taken} == {"/scene", "/coils/currents"}

    try:
        tell(graph, topics.CURRENTS, CoilCurrents(current=[1.0, 2.0]), taken_both, "both")
    finally:
        tap.close()
    said = {topic: (arrival, data) for topic, arrival, data in taken}
    arrival, data = said["/coils/currents"]
    assert abs(arrival * 1e-9 - time.time()) < 60.0
    assert list(topics.CURRENTS.decode(data).current) == [1.0, 2.0]


def test_a_bridge_that_is_heard_says_all_that_the_page_shows(graph, console):
    message = CoilBridgeState(state=CoilBridgeState.STATE_ACTIVE, armed=True, driver="roboclaw", current=[1.5, -2.0])
    message.applied.x = 0.002
    tell(graph, topics.BRIDGE_STATE, message, lambda: bridge(console), "the state")
    told = bridge(console)
    assert (told["state"], told["armed"], told["driver"]) == ("active", True, "roboclaw")
    assert (told["current"], told["applied"]) == ([1.5, -2.0], [0.002, 0.0])


def program(domain: int, *parameters: str) -> subprocess.Popen[str]:
    """Run the node as a program."""
    given = [part for parameter in parameters for part in ("-p", parameter)]
    command = [sys.executable, "-m", "magnetosuture_thread.nodes.console", "--ros-args", *given]
    environment = graph_environment(domain)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_the_node_serves_the_page_says_so_and_ends_when_it_is_asked_to(graph, which: signal.Signals):
    reports = graph.listen_later(topics.DIAGNOSTICS)
    with program(graph.domain, "port:=0", "scene:=dish_150mm") as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
            assert found is not None
            with urllib.request.urlopen(found[0], timeout=10.0) as page:
                assert page.status == 200
            graph.wait(lambda: any("console: state" in r.status[0].name for r in reports), "its report", timeout=30.0)
            process.send_signal(which)
            assert process.wait(20.0) == 0
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("parameter", "words"),
    [
        ("scene:=nowhere", "scene: got 'nowhere', expected a YAML or GeoJSON file, or one of dead_end"),
        ("needle_length:=35.0", "console.needle_length: got 35.0"),
        ("dish:=0.035", "console.dish: got 0.035"),
        ("address:=0.0.0.0", "a token, as 0.0.0.0 can be reached"),
    ],
)
def test_the_node_refuses_parameters_in_one_line(graph, parameter: str, words: str):
    with program(graph.domain, parameter) as process:
        _, errors = process.communicate(timeout=30.0)
    assert process.returncode == 1
    assert words in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize("failure", [MemoryError(), OverflowError("too large"), InvalidInputError("a", "b", "c")])
def test_a_message_that_cannot_be_read_ends_no_page(graph, node: Node, failure: Exception):
    """Whatever goes wrong in it, the page keeps the one before."""
    asked: list[float] = []

    def read(message: CoilCurrents) -> float:
        asked.append(message.current[0])
        if message.current[0] < 0.0:
            raise failure
        return float(message.current[0])

    latest = Latest(node, topics.RIG_CURRENTS, read)

    def polled() -> int:
        latest.poll()
        return len(asked)

    tell(graph, topics.RIG_CURRENTS, CoilCurrents(current=[1.0]), polled, "the first")
    tell(graph, topics.RIG_CURRENTS, CoilCurrents(current=[-1.0]), lambda: polled() and asked[-1] < 0.0, "the bad one")
    assert latest.value == 1.0


def test_procedures_are_planned_begun_paused_and_given_up_by_the_page(graph, console):
    """With the real needle planner, and somebody who shows a needle."""
    assert console.state()["procedure"] is None
    assert console.state()["procedures"] == []  # the scene has no shape that one needs
    told = wire.scene_message(1, read_scene("five_posts"))
    tell(graph, topics.SCENE, told, lambda: console.state()["procedures"] == ["slalom"], "what the scene allows")
    graph.add(NeedlePlannerNode, scene="dish_35mm", needle_length=0.0025, settle=0.0, pose_timeout=5.0)
    commands, holds = graph.listen(topics.NEEDLE_COMMAND), graph.listen(topics.PROCEDURE_HOLD)
    later = int(1e9 * (time.time() + 3600.0))  # ns; late poses are refused, however slowly the test runs
    pose = wire.pose_message(later, np.zeros(2), np.array([1.0, 0.0]))
    near = "goals: [{go_to: {position: [0.008, 0.0]}}]"
    refusal = asyncio.run(console.execute_procedure("resume", "", False))
    assert "no procedure" in refusal

    def planned() -> bool:
        graph.publish(topics.NEEDLE_POSE, pose)
        return not asyncio.run(console.execute_procedure("plan", near, True))

    graph.wait(planned, "the plan", timeout=60.0)
    graph.wait(lambda: (console.state()["procedure"] or {}).get("state") == "ready", "its state")
    graph.wait(lambda: len(console.state()["plan"]) > 10, "its plan")
    assert console.state()["procedure"]["goals"] == ["go_to"]
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


def test_the_node_answers_the_services_of_its_parameters(graph):
    with joined(domain=graph.domain) as other:
        client = other.create_client(GetParameters, "console/get_parameters")
        command = [sys.executable, "-m", "magnetosuture_thread.nodes.console", "--ros-args", "-p", "port:=0"]
        process = subprocess.Popen(command, env=graph_environment(graph.domain))
        answers = []

        def answered() -> bool:
            if client.service_is_ready():
                with client.handle:
                    client.handle.send_request(GetParameters.Request(names=["port"]))
                    answers.append(client.handle.take_response(GetParameters.Response)[1])
            return any(answer is not None for answer in answers)

        try:
            graph.wait(answered, "an answer", 30.0)
            process.send_signal(signal.SIGINT)
            assert process.wait(30.0) == 0
        finally:
            process.kill()
    (values, *_) = (answer.values for answer in answers if answer is not None)
    assert [value.integer_value for value in values] == [0]
