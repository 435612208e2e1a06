"""The server, with a client that may be hostile: access, states and rejected messages."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time

import aiohttp
import pytest

from magnetosuture_thread.console.client import ClientMessage, parse_client_message
from magnetosuture_thread.console.server import HEADERS, ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.settings.errors import ConfigurationError
from test.console.visitor import NORTH, REST, TOKEN, WAIT_TIMEOUT, Console, Page, run, until


def test_the_page_is_served_whole_and_lets_nothing_else_in():
    async def test(here: Console) -> None:
        async with here.session.get(here.url) as response:
            assert response.status == 200
            policy = response.headers["Content-Security-Policy"]
            assert "default-src 'none'" in policy
            assert "unsafe" not in policy
            assert response.headers["X-Content-Type-Options"] == "nosniff"
            text = await response.text()
        assert "http" not in text
        assert TOKEN not in text
        for name in ("main.js", "style.css", "icon.svg"):
            async with here.session.get(here.url + name) as response:
                assert response.status == 200
        for name in ("server.py", "..%2fserver.py", "page/main.js", "%2e%2e/settings.py"):
            async with here.session.get(here.url + name) as response:
                assert response.status == 404
        async with here.session.post(here.url) as response:
            assert response.status == 405
        async with here.session.head(here.url) as response:
            assert response.status == 200

    run(test)


@pytest.mark.parametrize("path", ["", "socket"])
def test_another_host_name_is_refused(path: str):
    async def test(here: Console) -> None:
        async with here.session.get(here.url + path, headers={"Host": "evil.example"}) as response:
            assert response.status == 403

    run(test)


@pytest.mark.parametrize("origin", ["http://evil.example", "null"])
def test_a_page_of_another_site_cannot_connect(origin: str):
    async def test(here: Console) -> None:
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await here.session.ws_connect(here.url + "socket", origin=origin)
        assert refused.value.status == 403
        await here.page(origin=here.url.rstrip("/"))

    run(test)


def test_a_port_that_is_taken_is_said():
    async def test(here: Console) -> None:
        port = int(here.url.rstrip("/").rsplit(":", 1)[1])
        other = ConsoleServer(ConsoleSettings(port=port), here.graph, here.host)
        with pytest.raises(ConfigurationError, match=rf"console\.port: got {port}"):
            await other.start()

    run(test)


@pytest.mark.parametrize("token", ["", TOKEN + "x"])
def test_without_the_token_one_watches_and_nothing_else(token: str):
    async def test(here: Console) -> None:
        page = await here.page(token)
        assert page.of("welcome")[0]["can_command"] is False
        await page.send(type="acquire_control")
        await page.jog(1, 0)
        for word in (
            {"type": "bridge_action", "action": "stop"},
            {"type": "bridge_action", "action": "arm"},
            {"type": "select_setup", "setup": "hernia_ring"},
            {"type": "pause", "paused": True},
            {"type": "record", "recording": True},
            {"type": "hello", "token": TOKEN},
        ):
            await page.send(**word)
        await until(lambda: len(page.of("error")) == 8 and page.lease)
        assert page.lease["holder"] is None
        assert page.of("state")[-1]["graph"]["needle"]
        assert (here.graph.commands, here.graph.actions, here.host.requests) == ([], [], [])

    run(test)


def test_requests_of_the_page_with_control_reach_the_host_and_the_graph():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.acquire_control()
        await page.send(type="select_setup", setup="petri_35mm_polyamide")
        await page.send(type="pause", paused=True)
        await page.send(type="record", recording=True)
        await until(lambda: len(here.host.requests) == 3)
        assert here.host.requests == [("select_setup", "petri_35mm_polyamide"), ("pause", True), ("record", True)]
        await until(lambda: page.of("state")[-1]["host"]["recording"] != "")
        here.graph.refusal = "no planner"
        await page.send(type="procedure", action="plan", procedure="slalom", hold_to_run=True)
        await until(lambda: here.graph.procedures == [("plan", "slalom", True)])

    run(test)


def test_a_measurement_ends_with_what_stops_the_bridge_and_with_the_page():
    async def test(here: Console) -> None:
        page, watcher = await here.page(), await here.page()
        await page.acquire_control()
        await page.send(type="measure", action="commission", marks=[], sent=time.monotonic())
        await until(lambda: here.host.requests == [("commission", ())])
        await watcher.send(type="bridge_action", action="disarm")
        await until(lambda: here.host.cancelled == 1)
        await watcher.send(type="bridge_action", action="stop")
        await until(lambda: here.host.cancelled == 2)
        await watcher.send(type="measure", action="cancel", marks=[])
        await until(lambda: here.host.cancelled == 3 and here.graph.actions[-1] == "disarm")
        await watcher.send(type="measure", action="commission", marks=[], sent=time.monotonic())
        await until(lambda: watcher.of("error"))
        await page.send(type="release_control")
        await until(lambda: here.host.cancelled == 4)
        await page.acquire_control()
        page.tear()
        await until(lambda: here.host.cancelled >= 5)
        assert here.host.requests == [("commission", ())]

    run(test)


@pytest.mark.parametrize("hostile", ["nonsense", b"\x00\x01\x02"])
def test_hostile_message_is_rejected_and_interrupts_the_jog(hostile: str | bytes):
    async def test(here: Console) -> None:
        page = await here.jogging_page()
        await (page.socket.send_bytes if isinstance(hostile, bytes) else page.socket.send_str)(hostile)
        await until(lambda: page.of("error"))
        assert here.graph.last == REST
        await page.jog(0, 1)
        await until(lambda: here.graph.last == NORTH)

    run(test, hold_timeout=1.0)


def test_an_emergency_stop_comes_through_a_flood_which_ends_the_connection():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.acquire_control()
        for _ in range(1200):
            await page.send(type="end_jog")
        await page.send(type="bridge_action", action="stop")
        await until(lambda: here.graph.actions == ["stop"])
        with contextlib.suppress(ConnectionError):
            for _ in range(20_000):
                if page.socket.closed:
                    break
                await page.send(type="end_jog")
        await until(lambda: page.socket.closed and not here.server._clients)

    run(test)


def test_numbers_that_are_not_finite_reach_the_page_as_null():
    async def test(here: Console) -> None:
        here.graph.shown["margins"]["least"]["obstacle"] = math.inf
        here.graph.shown["bridge"]["applied"] = [math.nan, 0.0]
        page = await here.page()
        await until(lambda: page.of("state"))
        shown = page.of("state")[-1]["graph"]
        assert shown["margins"]["least"]["obstacle"] is None
        assert shown["bridge"]["applied"] == [None, 0.0]

    run(test)


def test_stopping_the_server_stops_the_needle_first():
    async def test(here: Console) -> None:
        page = await here.jogging_page()
        stopping = asyncio.create_task(here.server.stop())
        await asyncio.sleep(0)
        assert here.graph.last == REST  # before any connection has ended
        await stopping
        await until(lambda: page.socket.closed)
        assert page.socket.close_code == 1001

    run(test, hold_timeout=1.0)


def test_rubbish_of_a_page_without_the_token_costs_the_page_with_control_nothing(monkeypatch: pytest.MonkeyPatch):
    """10,000 messages a second, and as many new connections as there can be."""
    parsed: list[str] = []

    def parse(text: str, max_speed: float) -> ClientMessage:
        parsed.append(text)
        return parse_client_message(text, max_speed)

    async def flood(here: Console) -> None:
        page = await here.page("")
        with contextlib.suppress(ConnectionError):
            for _ in range(500):
                await page.socket.send_str(json.dumps({"type": "select_setup", "setup": "[" * 3000}))
        await until(lambda: page.socket.closed)

    async def test(here: Console) -> None:
        holder = await here.jogging_page()
        refused = 0
        for _ in range(60):
            try:
                await flood(here)
            except aiohttp.WSServerHandshakeError:
                refused += 1
            await holder.jog(1, 0)
        assert 0 < refused < 60
        assert not any("select_setup" in text for text in parsed)
        await holder.jog(0, 1)
        await until(lambda: here.graph.last == NORTH)
        assert holder.lease["holder"] == holder.number

    monkeypatch.setattr("magnetosuture_thread.console.client.parse_client_message", parse)
    monkeypatch.setattr("magnetosuture_thread.console.server.MAX_NEW_WATCHERS", 5)
    run(test, hold_timeout=1.0)


MALFORMED = [
    "\x00\x01\x02\r\n\r\n",
    "GET / HTTP/9\r\n\r\n",
    "POST / HTTP/1.1\r\nHost: a\r\nContent-Length: -4\r\n\r\n",
    "GET / HTTP/1.1\r\n" + "a: b\r\n" * 5000 + "\r\n",
    "GET /" + "x" * 20000 + " HTTP/1.1\r\n\r\n",
]


@pytest.mark.parametrize("request_text", MALFORMED)
def test_malformed_requests_get_our_headers_and_print_nothing(request_text: str, caplog: pytest.LogCaptureFixture):
    async def test(here: Console) -> None:
        port = int(here.url.rstrip("/").rsplit(":", 1)[1])
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(request_text.encode())
        answer = await asyncio.wait_for(reader.read(), WAIT_TIMEOUT)
        writer.close()
        assert answer.startswith(b"HTTP/1.1 40") or answer.startswith(b"HTTP/1.0 40")
        for name in HEADERS:
            assert name.encode() in answer
        assert b"Traceback" not in answer

    run(test)
    assert caplog.records == []


@pytest.mark.parametrize(
    ("is_browser", "automated", "operator"),
    [(True, False, "an operator"), (True, None, "a script"), (False, False, "a script")],
)
def test_the_host_gets_whether_an_operator_or_a_script_jogs(is_browser: bool, automated: bool | None, operator: str):
    async def test(here: Console) -> None:
        page = Page(await here.connect(**({"origin": here.url.rstrip("/")} if is_browser else {})))
        await page.send(type="hello", token=TOKEN, automated=automated)
        page.number = (await until(lambda: page.of("welcome")))[0]["client"]
        await page.acquire_control()
        await page.send(type="record", recording=True)
        await until(lambda: here.host.requests)
        assert here.host.operator == operator

    run(test)


def test_places_are_limited_for_each_address_that_watches_for_all_of_them_and_for_those_with_the_token(
    monkeypatch: pytest.MonkeyPatch,
):
    async def test(here: Console) -> None:
        async with contextlib.AsyncExitStack() as sessions:

            async def status(address: str, query: str = "") -> int:
                connector = aiohttp.TCPConnector(local_addr=(address, 0))
                session = await sessions.enter_async_context(aiohttp.ClientSession(connector=connector))
                try:
                    here.sockets.append(await session.ws_connect(f"{here.url}socket{query}"))
                except aiohttp.WSServerHandshakeError as refused:
                    return refused.status
                return 101

            first, second, third = (f"127.0.0.{number}" for number in (2, 3, 4))
            watching = [await status(address) for address in (first, first, first, second, second, third)]
            assert watching == [101, 101, 503, 101, 101, 503]  # two of each address, and four in all
            assert [await status(third, f"?token={TOKEN}") for _ in range(4)] == [101, 101, 101, 503]

    monkeypatch.setattr("magnetosuture_thread.console.server.MAX_WATCHERS", 2)
    monkeypatch.setattr("magnetosuture_thread.console.server.MAX_CLIENTS", 3)
    run(test)


def test_a_connection_that_says_nothing_is_closed(monkeypatch: pytest.MonkeyPatch):
    async def test(here: Console) -> None:
        socket = await here.connect()
        assert (await socket.receive(timeout=WAIT_TIMEOUT)).type is aiohttp.WSMsgType.CLOSE

    monkeypatch.setattr("magnetosuture_thread.console.client.HELLO_TIMEOUT", 0.05)
    monkeypatch.setattr("magnetosuture_thread.console.server.HEARTBEAT_PERIOD", 1000.0)
    run(test)
