"""Two complete simulated rigs in two namespaces on one ROS domain: nothing of one reaches the other."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from magnetosuture_msgs.srv import EditShape

from magnetosuture_thread.interface import ADD_SHAPE, ALL_NODES, OPERATOR_COMMAND, PLANNER, PROCESSES, SCENE_SERVER
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import CoilClient
from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain
from test.jobs.test_console import Page, opened, tail
from test.nodes.conftest import Graph

pytestmark = pytest.mark.whole_graph

LEFT, RIGHT = "left", "right"
SETUP = """
/**: {ros__parameters: {scene: dish_35mm}}
/**/rig_simulator:
  ros__parameters: {needle_start: [0.003, -0.002, 0.0], thread_segments: 30, frame_rate: 20.0}
/**/coil_bridge: {ros__parameters: {driver: simulated, autostart: active, rate: 100.0}}
/**/console: {ros__parameters: {port: 0, token: only-for-this-test-0123}}
"""
OTHER_NAME = "joystick/servo_cv"  # of the operator's commands, for the rig on the right
REMAPPED = {LEFT: (), RIGHT: ("-r", f"{OPERATOR_COMMAND.name}:={OTHER_NAME}")}
DISC = "{disc: {center: [-0.006, 0.008], radius: 0.001}, kind: instrument}"


def within(space: str, topic: topics.Topic, name: str = "") -> topics.Topic:
    """Return a rig's own topic, under another name where it has one."""
    return replace(topic, channel=replace(topic.channel, name=f"/{space}/{name or topic.channel.name}"))


@dataclass
class Rigs:
    """Two rigs, and a node that listens to both."""

    urls: dict[str, str]
    environment: dict[str, str]
    graph: Graph
    currents: dict[str, list[Any]]
    scenes: dict[str, list[Any]]

    def currents_flow(self, space: str) -> bool:
        """Return whether any current has gone to the coils of a rig since what came before was dropped."""
        return any(any(message.current) for message in list(self.currents[space]))

    def stop(self, space: str) -> None:
        """Stop a bridge as `magnetosuture coils stop --namespace` does."""
        with environment_of(self.environment), CoilClient(space) as client:
            client.execute("stop")


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rigs]:
    """Start both, with a page each."""
    folder = tmp_path_factory.mktemp("rigs")
    setup = folder / "setup.yaml"
    setup.write_text(SETUP)
    names = (SCENE_SERVER, "rig_simulator", *PROCESSES, "console")
    with reserved_domain() as domain, ExitStack() as stack:
        environment = graph_environment(domain)
        for space in (LEFT, RIGHT):
            arguments = ("--params-file", str(setup), "-r", f"__ns:=/{space}", *REMAPPED[space])
            stack.enter_context(NodeProcesses(names, arguments, environment, folder / space))
        graph = Graph(domain)
        stack.callback(graph.close)
        currents = {space: graph.listen_later(within(space, topics.RIG_CURRENTS)) for space in (LEFT, RIGHT)}
        scenes = {space: graph.listen_later(within(space, topics.SCENE)) for space in (LEFT, RIGHT)}
        logs = {space: folder / space / "console.log" for space in (LEFT, RIGHT)}
        address = re.compile(r"the operator's page: (\S+)")
        graph.wait(lambda: all(address.search(log.read_text()) for log in logs.values()), "both pages", 240.0)
        urls = {space: address.findall(log.read_text())[0] for space, log in logs.items()}
        yield Rigs(urls, environment, graph, currents, scenes)


async def ready(page: Page) -> None:
    """Wait until a page's rig runs and its needle is tracked."""
    await page.until(
        lambda: page.graph["predicted"] and page.graph["needle"] and page.graph["bridge"]["driver_ready"], "the rig"
    )


async def jog(page: Page) -> None:
    """Take control, arm, and move the needle to the right by a millimetre; the key stays down."""
    assert await page.ask("acquire_control") == ""
    assert await page.ask("bridge_action", action="arm") == ""
    before = tail(page)
    page.hold((1.0, 0.0), 0.003)
    await page.until(lambda: tail(page)[0] - before[0] > 1e-3, "the needle to move")


def test_arming_and_commands_of_one_page_reach_its_own_rig_alone(rigs: Rigs):
    async def use() -> None:
        async with opened(rigs.urls[LEFT]) as left, opened(rigs.urls[RIGHT]) as right:
            await ready(left)
            await ready(right)
            for received in rigs.currents.values():
                received.clear()
            still = tail(right)
            await jog(left)
            assert rigs.currents_flow(LEFT)
            assert not right.graph["bridge"]["armed"]
            assert not rigs.currents_flow(RIGHT)
            assert len(rigs.currents[RIGHT]) > 10
            assert np.linalg.norm(tail(right) - still) < 5e-4  # it may still be drawn by its thread
            await left.let_go()

    asyncio.run(use())


def test_a_page_shows_its_own_rig_alone(rigs: Rigs):
    async def use(space: str) -> None:
        async with opened(rigs.urls[space]) as page:
            await ready(page)
            own = {*ALL_NODES, "console"} - {PLANNER, "path_follower"}
            await page.until(lambda: set(page.graph["nodes"]) == own, "the nodes of its rig")
            assert page.host["simulated"]
            assert page.host["mode"] == "graph"

    for space in (LEFT, RIGHT):
        asyncio.run(use(space))


def test_an_emergency_stop_and_a_reset_reach_one_bridge_alone(rigs: Rigs):
    async def use() -> None:
        async with opened(rigs.urls[LEFT]) as left, opened(rigs.urls[RIGHT]) as right:
            await ready(left)
            assert await left.ask("acquire_control") == ""
            assert await left.ask("bridge_action", action="arm") == ""
            await asyncio.to_thread(rigs.stop, RIGHT)
            await right.until(lambda: right.graph["bridge"]["emergency_stopped"], "the emergency stop")
            await left.until(lambda: left.graph["bridge"]["armed"], "the other rig to be armed still")
            assert not left.graph["bridge"]["emergency_stopped"]
            assert await left.ask("bridge_action", action="stop") == ""
            await left.until(lambda: left.graph["bridge"]["emergency_stopped"], "its own emergency stop")
            assert await right.ask("acquire_control") == ""
            assert await right.ask("bridge_action", action="reset") == ""
            await right.until(lambda: not right.graph["bridge"]["emergency_stopped"], "the reset")
            assert left.graph["bridge"]["emergency_stopped"]
            assert await left.ask("bridge_action", action="reset") == ""

    asyncio.run(use())


def test_commands_on_a_remapped_topic_reach_the_rig_that_has_the_remap(rigs: Rigs):
    """The rig on the right takes its operator's commands from another topic, as its page publishes them there."""
    commands = rigs.graph.listen(within(RIGHT, topics.OPERATOR_COMMAND, OTHER_NAME))
    unused = rigs.graph.listen_later(within(RIGHT, topics.OPERATOR_COMMAND))

    async def use() -> None:
        async with opened(rigs.urls[RIGHT]) as right:
            await ready(right)
            for received in rigs.currents.values():
                received.clear()
            await jog(right)
            assert rigs.currents_flow(RIGHT)
            await right.let_go()

    asyncio.run(use())
    assert any(message.twist.linear.x == 0.003 for message in commands)
    assert unused == []
    assert not rigs.graph.matched(within(RIGHT, topics.OPERATOR_COMMAND))
    assert not rigs.currents_flow(LEFT)


def test_a_shape_that_is_added_to_one_scene_is_not_in_the_other(rigs: Rigs):
    graph = rigs.graph
    client = graph.probe.create_client(EditShape, f"/{RIGHT}/{ADD_SHAPE}")
    graph.wait(client.service_is_ready, "the scene server")
    graph.wait(lambda: all(rigs.scenes.values()), "both scenes")

    async def use() -> None:
        async with opened(rigs.urls[LEFT]) as left, opened(rigs.urls[RIGHT]) as right:
            await ready(left)
            answer = client.call_async(EditShape.Request(name="hook", shape=DISC))
            await right.until(lambda: answer.done() and right.graph["scene"]["shapes"], "the shape")
            assert answer.result().success
            since = time.monotonic()
            await left.until(lambda: time.monotonic() - since > 1.0, "a second")
            assert left.graph["scene"]["shapes"] == []

    asyncio.run(use())
    assert [len(rigs.scenes[space]) for space in (LEFT, RIGHT)] == [1, 2]
