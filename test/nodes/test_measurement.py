"""What the operator's page measures, by the real commands: the host of a graph that runs, tracker and bridge in it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.commands import measurement
from magnetosuture_thread.commands.console import RecordingHost
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import Participant
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.console import ConsoleGraph
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.rig.setups import read_setup
from test.nodes import bridge
from test.nodes.test_vision_tracker import TAIL, compressed, frame

pytestmark = pytest.mark.slow

WAIT = 120.0  # s; a command imports most of the package, and a busy machine takes its time
HEADING, LENGTH = 0.4, 7e-3  # rad and m; of the needle in `frame`


@pytest.fixture
def host(graph: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RecordingHost]:
    """Return the host of the graph of the test, whose commands are on the graph's domain."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))
    with Participant("console", domain=graph.domain) as page:
        yield RecordingHost(
            ConsoleGraph(page.node, ConsoleSettings()), read_setup("petri_35mm_polyamide"), tmp_path, print
        )


async def ended(host: RecordingHost, meanwhile: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Wait for the end of a measurement, and return what the page shows of it."""
    deadline = time.monotonic() + WAIT
    while (shown := host.state()["measurement"])["state"] == "running":
        assert time.monotonic() < deadline, shown
        meanwhile()
        host.graph.spin()
        await asyncio.sleep(0.03)
    await host.close()
    return dict(shown)


def test_a_needle_is_taught_by_its_marked_ends_and_the_tracker_goes_on_with_what_was_learnt(
    graph: Any, host: RecordingHost, camera: Any, thread_arc: Any, tmp_path: Path
):
    tracker = graph.add(VisionTrackerNode, scene="dish_35mm", needle_width=6e-4, max_needle_brightness=0.9)
    poses, image = graph.listen(topics.NEEDLE_POSE), frame(camera, thread_arc)
    tip = TAIL + LENGTH * np.array([np.cos(HEADING), np.sin(HEADING)])
    marks = camera.view.to_pixels(np.array([TAIL, tip])).ravel().tolist()

    def show() -> None:
        graph.publish(topics.COMPRESSED_IMAGE, compressed(image, graph.now()))

    async def teach() -> dict[str, Any]:
        assert await host.measure("teach", tuple(marks)) == ""
        assert await host.measure("commission", ()) == "teach is running; cancel it first"
        return await ended(host, show)

    shown = asyncio.run(teach())
    assert shown["state"] == "done", shown["lines"]
    assert shown["lines"][-1] == "the tracker that runs knows how the needle looks until it ends"
    assert not tracker.configured_settings.metres_per_pixel  # so that a dish that is moved is noticed
    assert host.picture().startswith(b"\x89PNG")
    assert len(list(tmp_path.glob("*_petri_35mm_polyamide_taught/tracker.yaml"))) == 1
    settings = tracker.configured_settings
    assert settings.needle_width == pytest.approx(4e-4, rel=0.2)
    assert settings.max_needle_brightness < 0.9
    assert settings.needle_length == LENGTH  # as the other nodes have it
    poses.clear()

    def seen() -> bool:
        show()
        time.sleep(0.03)
        return bool(poses)

    graph.wait(seen, "a pose of the needle that was taught")


def test_a_needle_of_another_length_is_told_to_no_node_alone(
    graph: Any, host: RecordingHost, camera: Any, thread_arc: Any
):
    """The bridge would keep another needle off the shapes than the tracker sees."""
    tracker, image = graph.add(VisionTrackerNode, scene="dish_35mm"), frame(camera, thread_arc)
    host.setup = replace(host.setup, vision=replace(host.setup.vision, needle_length=6e-3))
    tip = TAIL + LENGTH * np.array([np.cos(HEADING), np.sin(HEADING)])
    marks = camera.view.to_pixels(np.array([TAIL, tip])).ravel().tolist()
    before = tracker.configured_settings

    async def teach() -> dict[str, Any]:
        assert await host.measure("teach", tuple(marks)) == ""
        return await ended(host, lambda: graph.publish(topics.COMPRESSED_IMAGE, compressed(image, graph.now())))

    shown = asyncio.run(teach())
    assert shown["state"] == "failed"
    assert "and 6.00 mm in the setup: copy the parameters into it" in shown["lines"][-1]
    assert tracker.configured_settings is before


def test_a_commissioning_that_the_bridge_refuses_says_the_way_out(graph: Any, host: RecordingHost):
    graph.add(CoilBridgeNode, driver="simulated", scene="dish_35mm")

    async def commission() -> dict[str, Any]:
        assert await host.measure("commission", ()) == ""
        return await ended(host)

    shown = asyncio.run(commission())
    assert shown["state"] == "failed"
    assert any("start the bridge by -p coil_bridge:commissioning:=true" in line for line in shown["lines"])


def test_a_measurement_is_interrupted_by_cancel_and_with_the_page(
    graph: Any, host: RecordingHost, monkeypatch: pytest.MonkeyPatch
):
    """No bridge is there: by itself the command would wait for one, and then say so."""
    monkeypatch.setattr(measurement, "END_TIMEOUT", WAIT)

    async def cancel(end: Callable[[], Any]) -> dict[str, Any]:
        assert await host.measure("commission", ()) == ""
        while host._measurement is None or host._measurement._process is None:
            await asyncio.sleep(0.01)
        await asyncio.sleep(1.0)  # while it imports what it needs, or waits for the bridge
        await end()
        return await ended(host)

    async def press() -> None:
        host.cancel()
        host.cancel()  # a second time, which must not disturb its end

    for end in (press, host.close):
        shown = asyncio.run(cancel(end))
        assert shown["state"] == "failed"
        assert shown["lines"][-1] == "not commissioned"
        assert not any("no coil_bridge" in line for line in shown["lines"])


def test_nothing_is_taught_while_the_coils_are_armed(graph: Any, host: RecordingHost):
    bridge.armed(graph)
    graph.wait(lambda: (host.graph.state()["bridge"] or {}).get("armed"), "an armed bridge")
    assert "disarm first" in asyncio.run(host.measure("teach", (1.0, 2.0, 3.0, 4.0)))


def test_a_tracker_that_refuses_what_was_taught_goes_on_as_before(graph: Any, host: RecordingHost):
    tracker = graph.add(VisionTrackerNode, scene="dish_35mm")
    problem = asyncio.run(host._change_tracker({"needle_is_blunt": True, "needle_length": -1.0}))
    assert "needle_length" in problem
    assert "off" not in problem
    assert graph.stage("vision_tracker") == "active"
    assert (tracker.configured_settings.needle_is_blunt, tracker.configured_settings.needle_length) == (False, LENGTH)


def test_a_commissioning_goes_on_in_its_folder_until_it_is_finished(
    host: RecordingHost, monkeypatch: pytest.MonkeyPatch
):
    folders: list[Path] = []

    async def run(measured: measurement.Measurement, arguments: list[str]) -> bool:
        folders.append(Path(arguments[arguments.index("--output") + 1]))
        folders[-1].mkdir(exist_ok=True)
        return len(folders) == 2

    monkeypatch.setattr(measurement.Measurement, "run", run)

    async def commission() -> dict[str, Any]:
        assert await host.measure("commission", ()) == ""
        return await ended(host)

    assert asyncio.run(commission())["state"] == "failed"
    shown = asyncio.run(commission())
    assert shown["state"] == "done"
    assert shown["lines"][0].startswith(f"goes on in {folders[0]}")
    assert folders[0] == folders[1]
    (folders[0] / "summary.json").touch()
    asyncio.run(commission())
    assert folders[2] != folders[0]


def test_a_graph_of_which_nobody_knows_the_setup_is_not_measured(graph: Any, tmp_path: Path):
    with Participant("console", domain=graph.domain) as page:
        shown, setup = ConsoleGraph(page.node, ConsoleSettings()), read_setup("petri_35mm_polyamide")
        host = RecordingHost(shown, setup, tmp_path, print, measures=False)
        assert not host.state()["can_measure"]
        assert "console SETUP --graph" in asyncio.run(host.measure("commission", ()))
        shown.begin(ConsoleSettings(scene="dish_150mm"))
        host = RecordingHost(shown, setup, tmp_path, print)
        assert "dish of 150 mm is not the setup's of 35 mm" in asyncio.run(host.measure("commission", ()))
