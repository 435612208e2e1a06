"""Jogging through the server, with a client that may be hostile."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from magnetosuture_thread.console.client import ClientMessage, RequestHandler
from magnetosuture_thread.console.jog_controller import JogController
from magnetosuture_thread.settings.errors import InvalidInputError
from test.console.scene import RecordingGraph, RecordingHost, procedure_state
from test.console.visitor import EAST, NORTH, REST, Console, run, until


def test_lost_connection_stops_the_needle_before_the_timeout():
    async def test(here: Console) -> None:
        page, watcher = await here.page(), await here.page()
        await page.acquire_control()
        await page.jog(1, 0)
        await until(lambda: len(here.graph.commands) > 1)
        page.tear()
        await until(lambda: here.graph.last == REST)
        assert here.graph.commands[-1][0] - here.graph.commands[0][0] < 30.0
        await until(lambda: watcher.lease["holder"] is None)

    run(test, hold_timeout=1.0)


def test_the_bridge_is_disarmed_when_the_page_with_control_is_gone_and_not_when_another_is():
    async def test(here: Console) -> None:
        operator, watcher = await here.page(), await here.page()
        await operator.acquire_control()
        watcher.tear()
        await until(lambda: operator.lease["pages"] == 1)
        assert not here.graph.actions
        operator.tear()
        await until(lambda: here.graph.actions == ["disarm"])

    run(test)


def test_late_jog_messages_are_rejected_and_a_late_page_is_disconnected():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.acquire_control()
        await page.jog(1, 0, sent=100.0)
        await page.jog(0, 1, sent=99.84)
        await until(lambda: here.graph.last == REST and page.of("error"))
        assert "late" in page.of("error")[0]["text"]
        assert NORTH not in here.graph.velocities
        while not page.socket.closed:
            with contextlib.suppress(ConnectionError):
                await page.jog(0, 1, sent=99.0)
            await asyncio.sleep(0.02)
        assert NORTH not in here.graph.velocities
        await until(lambda: not here.server._clients)

    run(test)


def test_what_starts_something_is_refused_late_and_what_stops_is_not():
    async def test(here: Console) -> None:
        here.graph.shown = procedure_state()
        page = await here.page()
        await page.acquire_control()
        await page.send(type="acknowledge", kind="state", sent=100.0)
        planned = {"type": "procedure", "procedure": "hernia", "hold_to_run": False}
        ask = {"type": "bridge_action"}
        for what in ({**ask, "action": "arm"}, {**ask, "action": "reset"}, {**planned, "action": "resume"}):
            assert "s late, expected at most 1 s" in await page.ask(**what, sent=98.9)
        assert not here.graph.actions
        assert not here.graph.procedures
        for what in ({**ask, "action": "stop"}, {**ask, "action": "disarm"}, {**planned, "action": "abort"}):
            assert await page.ask(**what, sent=0.0) == ""
        for fastest, action in ((1e6, "reset"), (2e6, "arm")):
            assert await page.ask(**ask, action=action, sent=fastest) == ""
        assert here.graph.actions == ["stop", "disarm", "reset", "arm"]
        assert [action for action, *_ in here.graph.procedures] == ["abort"]

    run(test)


def test_one_page_has_control_until_it_releases_it():
    async def test(here: Console) -> None:
        first, second = await here.page(), await here.page()
        await first.acquire_control()
        await second.send(type="acquire_control")
        refusal = (await until(lambda: second.of("result")))[0]["refusal"]
        assert f"page {first.number} has control" in refusal
        await second.jog(0, -1)
        await until(lambda: second.of("error"))
        for word in ({"type": "bridge_action", "action": "arm"}, {"type": "pause", "paused": True}):
            await second.send(**word)
        await until(lambda: len(second.of("error")) == 3)
        assert (here.graph.commands, here.graph.actions, here.host.requests) == ([], [], [])
        await first.jog(1, 0)
        await first.send(type="release_control")
        await until(lambda: second.lease["holder"] is None)
        assert here.graph.last == REST
        await second.acquire_control()
        assert first.lease["pages"] == 2
        await until(lambda: first.lease["holder"] == second.number)

    run(test)


def test_hidden_page_cannot_jog_and_loses_control():
    async def test(here: Console) -> None:
        first, second = await here.page(), await here.page()
        await first.acquire_control()
        await first.jog(1, 0)
        await first.send(type="visibility", visible=False)
        await first.jog(1, 0)
        await until(lambda: first.of("error"))
        assert here.graph.velocities[-1] == REST
        await until(lambda: second.lease["available"])
        await second.acquire_control()
        await first.send(type="visibility", visible=True)
        await first.jog(1, 0)
        await until(lambda: len(first.of("error")) == 2)
        assert here.graph.velocities.count(REST) == 1

    run(test, hold_timeout=1.0)


def test_emergency_stop_of_any_page_requires_a_release():
    async def test(here: Console) -> None:
        first, second = await here.page(), await here.page()
        await first.acquire_control()
        await first.jog(1, 0)
        await until(lambda: here.graph.last == EAST)
        await second.send(type="bridge_action", action="stop")
        await until(lambda: here.graph.actions == ["stop"])
        assert here.graph.last == REST
        count = len(here.graph.commands)
        await first.jog(1, 0)
        await first.send(type="bridge_action", action="reset")
        await until(lambda: here.graph.actions == ["stop", "reset"])
        await first.jog(1, 0)
        await first.send(type="bridge_action", action="arm")
        await until(lambda: here.graph.actions == ["stop", "reset", "arm"])
        assert len(here.graph.commands) == count
        await first.send(type="end_jog")
        await first.jog(1, 0)
        await until(lambda: here.graph.last == EAST)

    run(test, hold_timeout=1.0)


def test_disarming_elsewhere_requires_a_release():
    async def test(here: Console) -> None:
        page = await here.jogging_page()
        here.graph.shown["bridge"].update(armed=False, emergency_stopped=True)
        await until(lambda: here.graph.last == REST)
        await until(lambda: page.lease["release_first"])
        here.graph.shown["bridge"].update(armed=True, emergency_stopped=False)
        count = len(here.graph.commands)
        await page.jog(1, 0)
        await page.send(type="bridge_action", action="reset")
        await until(lambda: here.graph.actions == ["reset"])
        assert len(here.graph.commands) == count
        await page.send(type="end_jog")
        await page.jog(1, 0)
        await until(lambda: here.graph.last == EAST)

    run(test, hold_timeout=1.0)


def test_a_procedure_is_held_by_the_page_with_control_alone_and_not_by_late_messages():
    async def test(here: Console) -> None:
        page, other = await here.page(), await here.page()
        await page.acquire_control()
        await other.send(type="hold", sent=100.0)
        await other.send(type="hold", sent=99.0)
        await until(lambda: other.of("error"))  # of the late one; both have been handled
        assert here.graph.holds == []
        await page.send(type="hold", sent=100.0)
        await until(lambda: len(here.graph.holds) == 1)
        await page.send(type="hold", sent=99.0)
        await until(lambda: page.of("error"))
        assert "late" in page.of("error")[0]["text"]
        assert len(here.graph.holds) == 1

    run(test)


ARM, STOP = (ClientMessage("bridge_action", {"action": action}) for action in ("arm", "stop"))
PAUSE, RECORD = ClientMessage("pause", {"paused": True}), ClientMessage("record", {"recording": True})
SELECT = ClientMessage("select_setup", {"setup": "hernia_ring"})


def bridge_action(action: str) -> ClientMessage:
    """Return a request to the coil bridge."""
    return ClientMessage("bridge_action", {"action": action})


def procedure(action: str) -> ClientMessage:
    """Return a request to the needle planner."""
    return ClientMessage("procedure", {"action": action, "procedure": "", "hold_to_run": False})


def requests_and_jog() -> tuple[RequestHandler, JogController, RecordingGraph]:
    """Return a handler of requests, and the jog controller and the graph that it acts on."""
    graph = RecordingGraph()
    jog = JogController(graph.publish_velocity, rate=50.0, timeout=0.15)
    return RequestHandler(graph, RecordingHost(), jog), jog, graph


def start(requests: RequestHandler, client: int, message: ClientMessage) -> None:
    """Start a request of a page."""
    requests.start(client, message, "an operator", lambda name, refusal: None)


@pytest.mark.parametrize(
    "message",
    [
        *(bridge_action(action) for action in ("stop", "disarm", "arm", "reset")),
        *(procedure(action) for action in ("pause", "abort", "plan", "resume")),
        *(SELECT, PAUSE, RECORD),
    ],
)
def test_a_page_without_control_ends_what_moves_and_requests_nothing_else(message: ClientMessage):
    async def test() -> None:
        requests, _, _ = requests_and_jog()
        ends = message.values.get("action") in ("stop", "disarm", "pause", "abort")
        with contextlib.nullcontext() if ends else pytest.raises(InvalidInputError, match="take control first"):
            start(requests, 7, message)
        await requests.close()

    asyncio.run(test())
