"""Two complete simulated rigs in two namespaces on one ROS domain: nothing of one reaches the other."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from magnetosuture_msgs.msg import Disc, SceneShape
from magnetosuture_msgs.srv import EditShape

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import CoilClient
from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain
from magnetosuture_thread.settings.interface import (
    ALL_NODES,
    OPERATOR_COMMAND,
    PLANNER,
    PROCESSES,
    SCENE_SERVER,
    Service,
)
from test.commands.test_console import tail, wait
from test.console.visitor import Page, opened
from test.nodes.conftest import Graph, own_context

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
HOOK = SceneShape(name="hook", kind=SceneShape.KIND_INSTRUMENT, disc=[Disc(x=-0.006, y=0.008, radius=0.001)])


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
        graph = Graph(stack.enter_context(own_context(domain)), domain)
        stack.callback(graph.close)
        currents = {space: graph.listen_later(within(space, topics.RIG_CURRENTS)) for space in (LEFT, RIGHT)}
        logs = {space: folder / space / "console.log" for space in (LEFT, RIGHT)}
        address = re.compile(r"the operator's page: (\S+)")
        graph.wait(lambda: all(address.search(log.read_text()) for log in logs.values()), "both pages", 240.0)
        urls = {space: address.findall(log.read_text())[0] for space, log in logs.items()}
        yield Rigs(urls, environment, graph, currents)


async def ready(page: Page) -> None:
    """Wait until a page's rig runs, its needle is tracked, and only its own nodes are shown."""
    await wait(page, lambda: page.graph["predicted"] and page.graph["needle"], "the rig")
    await wait(page, lambda: (page.graph["bridge"] or {}).get("driver_ready"), "the bridge")
    own = {*ALL_NODES, "console"} - {PLANNER, "path_follower"}
    await wait(page, lambda: set(page.graph["nodes"]) == own, "the nodes of its rig")
    assert await page.ask(type="acquire_control") == ""


def is_disarmed(page: Page) -> bool:
    """Return whether a page shows its bridge disarmed."""
    return not page.graph["bridge"]["armed"]


def _is_later(page: Page, time: float) -> bool:
    return bool(page.graph["time"] > time)


async def at_rest(page: Page) -> None:
    """Wait until the thread no longer draws the needle: by 50 um in half a second of the rig's time."""
    moved = math.inf
    while moved > 5e-5:
        before, until = tail(page), page.graph["time"] + 0.5
        await wait(page, partial(_is_later, page, until), "half a second")
        moved = math.dist(tail(page), before)


async def jog(page: Page) -> None:
    """Arm, and move the needle to the right by a millimetre; the key stays down."""
    assert await page.ask(type="bridge_action", action="arm") == ""
    before = tail(page)
    page.hold(1.0, 0.0)
    await wait(page, lambda: tail(page)[0] - before[0] > 1e-3, "the needle to move")


def test_commands_of_one_page_reach_its_own_rig_alone_also_on_a_remapped_topic(rigs: Rigs):
    """The rig on the right takes its operator's commands from another topic, as its page publishes them there."""
    commands = rigs.graph.listen(within(RIGHT, topics.OPERATOR_COMMAND, OTHER_NAME))

    async def use() -> None:
        async with opened(rigs.urls[LEFT]) as left, opened(rigs.urls[RIGHT]) as right:
            await ready(left)
            await ready(right)
            for page, other, space, other_space in ((left, right, LEFT, RIGHT), (right, left, RIGHT, LEFT)):
                await at_rest(other)
                for received in rigs.currents.values():
                    received.clear()
                still = tail(other)
                await jog(page)
                assert rigs.currents_flow(space)
                assert not other.graph["bridge"]["armed"]
                assert not rigs.currents_flow(other_space)
                assert np.linalg.norm(tail(other) - still) < 5e-4  # it may still be drawn by its thread
                await page.release()
                assert await page.ask(type="bridge_action", action="disarm") == ""
                await wait(page, partial(is_disarmed, page), "the bridge to be disarmed")

    asyncio.run(use())
    assert any(message.twist.linear.x == 0.003 for message in commands)


def test_an_emergency_stop_a_reset_and_a_new_shape_reach_one_rig_alone(rigs: Rigs):
    graph = rigs.graph
    client = graph.probe.create_client(EditShape, f"/{RIGHT}/{Service.ADD_SHAPE}")
    graph.wait(client.service_is_ready, "the scene server")

    async def use() -> None:
        async with opened(rigs.urls[LEFT]) as left, opened(rigs.urls[RIGHT]) as right:
            await ready(left)
            await ready(right)
            assert await left.ask(type="bridge_action", action="arm") == ""
            await asyncio.to_thread(rigs.stop, RIGHT)
            await wait(right, lambda: right.graph["bridge"]["emergency_stopped"], "the emergency stop")
            await wait(left, lambda: left.graph["bridge"]["armed"], "the other rig to be armed still")
            assert not left.graph["bridge"]["emergency_stopped"]
            assert await left.ask(type="bridge_action", action="stop") == ""
            await wait(left, lambda: left.graph["bridge"]["emergency_stopped"], "its own emergency stop")
            assert await right.ask(type="bridge_action", action="reset") == ""
            await wait(right, lambda: not right.graph["bridge"]["emergency_stopped"], "the reset")
            assert left.graph["bridge"]["emergency_stopped"]
            answer = client.call_async(EditShape.Request(shape=HOOK))
            await wait(right, lambda: answer.done() and right.graph["scene"]["shapes"], "the shape")
            assert answer.result().success
            since = left.graph["time"]
            await wait(left, lambda: left.graph["time"] > since + 1.0, "a second")
            assert left.graph["scene"]["shapes"] == []

    asyncio.run(use())
