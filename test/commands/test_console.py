"""The command `magnetosuture console` as a person runs it, with a page that is a program."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from magnetosuture_msgs.msg import CoilCurrents

from benchmarks.page import running_console
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import Inbox, Participant
from magnetosuture_thread.nodes.processes import NodeProcesses, graph_environment, reserved_domain
from test.console.visitor import Page, opened, until

EXAMPLE = Path(__file__).parents[2] / "examples" / "post_wrap"
OTHER = "petri_35mm_polyamide_post"
WAIT = 300.0  # s; the first start on a machine compiles


running = partial(running_console, MAGNETOSUTURE_TOKEN="only-for-this-test-0123")


@contextmanager
def wire(domain: int) -> Iterator[Callable[[], list[CoilCurrents]]]:
    """Give a function that returns what has gone to the simulated coils since it was last called."""
    with Participant("wire", domain=domain) as made:
        inbox = Inbox(made.node, topics.RIG_CURRENTS, 10)

        def taken() -> list[CoilCurrents]:
            made.spin_some()
            return [message for message, _ in inbox.read()]

        yield taken


def tail(page: Page) -> np.ndarray:
    """Return where the needle's tail is seen."""
    return np.array(page.graph["needle"]["tail"])


async def wait(page: Page, condition: Callable[[], Any], what: str) -> None:
    """Wait until the page shows something of a whole graph."""
    await until(lambda: page.graph and condition(), f"{what}; {page.of('error')[-3:]}", WAIT)


async def record_a_second(page: Page) -> None:
    """Begin a recording, and let it run for a second of the graph's time."""
    assert await page.ask(type="record", recording=True) == ""
    began = page.graph["time"]
    await wait(page, lambda: page.host["recording"] and page.graph["time"] > began + 1.0, "a second")


async def steer_and_stop(page: Page, currents: Callable[[], list[CoilCurrents]]) -> None:
    """Arm, steer, record, pause, stop in an emergency, and choose another setup."""
    await wait(page, lambda: not page.host["busy"] and page.graph["predicted"] and page.frames, "the graph")
    assert (page.host["mode"], page.host["simulated"]) == ("simulated", True)
    assert not page.graph["bridge"]["armed"]
    assert await page.ask(type="acquire_control") == ""
    await record_a_second(page)
    assert await page.ask(type="bridge_action", action="arm") == ""
    before = tail(page)
    page.hold(1.0, 0.0, 0.005)
    await wait(page, lambda: tail(page)[0] - before[0] > 1e-3, "the needle to move")
    assert abs(tail(page)[1] - before[1]) < 1e-3
    await wait(page, lambda: page.graph["filter"]["commanded"] == [0.005, 0.0], "the held velocity")
    assert await page.ask(type="pause", paused=True) == ""
    await wait(page, lambda: page.host["paused"] and page.graph["needle"]["age"] > 0.5, "no poses any more")
    await wait(page, lambda: not any(page.graph["bridge"]["current"]), "no currents without poses")
    assert await page.ask(type="pause", paused=False) == ""
    await wait(page, lambda: page.graph["needle"]["age"] < 0.5, "poses again")
    await page.release()  # what was held before counts no more
    page.hold(1.0, 0.0)
    await wait(page, lambda: any(page.graph["bridge"]["current"]), "currents again")
    assert await page.ask(type="bridge_action", action="stop") == ""
    await wait(page, lambda: page.graph["bridge"]["emergency_stopped"], "the emergency stop")
    currents()
    heard: list[CoilCurrents] = []

    def enough() -> bool:
        heard.extend(currents())
        return len(heard) > 10

    await wait(page, enough, "currents on the wire")
    assert not any(any(message.current) for message in heard)
    await page.release()
    assert "expected one of" in await page.ask(type="select_setup", setup="../../etc/passwd.yaml")
    assert await page.ask(type="select_setup", setup=OTHER) == ""
    await wait(page, lambda: page.host["setup"] == OTHER and not page.host["recording"], "the other setup to begin")
    await wait(page, lambda: not page.host["busy"] and page.graph["predicted"], "the other setup")
    assert len(page.graph["scene"]["shapes"]) == 1
    assert not page.graph["bridge"]["emergency_stopped"]
    await record_a_second(page)


@pytest.mark.whole_graph
def test_a_person_steers_the_simulated_rig(tmp_path: Path):
    recordings = tmp_path / "recordings"

    async def use(url: str, currents: Callable[[], list[CoilCurrents]]) -> None:
        async with opened(url) as page:
            await steer_and_stop(page, currents)

    with running("petri_35mm_polyamide", "--record", str(recordings)) as console:
        domain = int(console.find(r"ROS domain (\d+)"))
        url = console.find(r"open (http://127\.0\.0\.1:\d+/#token=only-for-this-test-0123)$")
        with wire(domain) as currents:
            asyncio.run(use(url, currents))
        assert console.end() == 0
        assert console.output.read_text().endswith("ended\n")
        assert console.errors.read_text() == ""
    first, second = map(Bag, sorted(recordings.iterdir()))  # ended by the choice of a setup, and by Ctrl-C
    assert first.damage is second.damage is None
    assert second.notes["setup"] == OTHER
    assert "control was with a script when the recording began" in first.notes["simulated"]
    assert "thread_model" in first.notes["scenario"]
    for name in ("/needle/filter_state", "/camera/image_raw/compressed", "/scene"):
        assert first.counts[name] > 0, name
    assert 0.005 in [record.decode().twist.linear.x for record in first.records({"/operator/servo_cv"})]


@pytest.mark.whole_graph
def test_a_person_watches_a_bag():
    async def use(url: str) -> None:
        async with opened(url) as page:
            await wait(page, lambda: not page.host["busy"] and page.graph["predicted"] and page.frames, "a prediction")
            assert (page.host["mode"], page.host["can_pause"], page.host["can_record"]) == ("replay", True, False)
            assert await page.ask(type="acquire_control") == ""
            assert "nothing can be jogged" in await page.ask(type="bridge_action", action="arm")
            assert "nothing can be jogged" in page.graph["filter"]["reason"]
            assert await page.ask(type="pause", paused=True) == ""
            await wait(page, lambda: page.graph["predicted"]["age"] > 0.5, "time to stand still")
            still = page.graph["time"]
            await wait(page, lambda: page.graph["predicted"]["age"] > 1.0, "time to stand still for longer")
            assert page.graph["time"] == still
            assert await page.ask(type="pause", paused=False) == ""
            await wait(page, lambda: page.graph["time"] > still, "time to go on again")

    with running("--replay", str(EXAMPLE)) as console:
        asyncio.run(use(console.find(r"open (http://\S+)$")))
        assert console.end() == 0


@pytest.mark.whole_graph
def test_a_graph_that_runs_is_joined_and_recorded(tmp_path: Path):
    async def use(url: str) -> None:
        async with opened(url) as page:
            await wait(page, lambda: page.graph["bridge"] is not None, "the bridge")
            assert (page.host["mode"], page.host["simulated"], page.host["can_pause"]) == ("graph", False, False)
            assert await page.ask(type="acquire_control") == ""
            assert "not started from the page" in await page.ask(type="select_setup", setup=OTHER)
            assert await page.ask(type="record", recording=True) == ""
            assert await page.ask(type="bridge_action", action="arm") == ""
            await wait(page, lambda: page.graph["bridge"]["armed"], "the bridge to be armed")
            assert await page.ask(type="bridge_action", action="stop") == ""
            await wait(page, lambda: page.graph["bridge"]["emergency_stopped"], "the emergency stop")

    with reserved_domain() as domain:
        environment = graph_environment(domain)
        arguments = ("-p", "coil_bridge:autostart:=active", "-p", "scene:=dish_35mm")
        with (
            NodeProcesses(("coil_bridge",), arguments, environment, tmp_path / "logs") as nodes,
            running("--graph", "--record", str(tmp_path / "recordings"), ROS_DOMAIN_ID=str(domain)) as console,
        ):
            asyncio.run(use(console.find(r"open (http://\S+)$")))
            nodes.check()
            assert console.end() == 0
            nodes.check()  # it is not ours to end
    states = [record.decode() for record in Bag(next((tmp_path / "recordings").iterdir())).records({"/coils/state"})]
    assert any(state.armed for state in states)
    assert states[-1].emergency_stopped
