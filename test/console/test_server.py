"""The server, with a client that may be hostile: access, states and rejected messages."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from typing import Any

import aiohttp
import pytest
from aiohttp import web

from magnetosuture_thread.console.client_messages import ClientMessage, parse_client_message
from magnetosuture_thread.console.server import HEADERS, ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import ConfigurationError
from test.console.scene import RecordingGraph, RecordingHost, picture
from test.console.visitor import EAST, NORTH, REST, TOKEN, WAIT_TIMEOUT, Console, Page, run, until


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


@pytest.mark.parametrize("path", ["", "main.js", "socket"])
def test_another_host_name_is_refused(path: str):
    async def test(here: Console) -> None:
        async with here.session.get(here.url + path, headers={"Host": "evil.example"}) as response:
            assert response.status == 403

    run(test)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1"])
def test_a_page_of_another_site_cannot_connect(origin: str):
    async def test(here: Console) -> None:
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await here.session.ws_connect(here.url + "socket", origin=origin)
        assert refused.value.status == 403
        await here.page(origin=here.url.rstrip("/"))

    run(test)


def test_a_random_token_is_made_where_none_is_configured():
    async def start() -> str:
        server = ConsoleServer(ConsoleSettings(port=0), RecordingGraph(), RecordingHost())
        url = await server.start()
        await server.stop()
        return url.split("#token=")[1]

    tokens = {asyncio.run(start()) for _ in range(3)}
    assert len(tokens) == 3
    assert all(len(token) >= 20 for token in tokens)


def test_a_port_that_is_taken_is_said():
    async def test(here: Console) -> None:
        port = int(here.url.rstrip("/").rsplit(":", 1)[1])
        other = ConsoleServer(ConsoleSettings(port=port), here.graph, here.host)
        with pytest.raises(ConfigurationError, match=rf"console\.port: got {port}"):
            await other.start()

    run(test)


@pytest.mark.parametrize("token", ["", "wrong", TOKEN + "x"])
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


def test_who_says_nothing_first_or_something_else_is_cut_off():
    async def test(here: Console) -> None:
        socket = await here.connect()
        await socket.send_str('{"type": "acquire_control"}')
        assert (await socket.receive(timeout=WAIT_TIMEOUT)).type is aiohttp.WSMsgType.CLOSE

    run(test)


def test_a_refusal_is_told():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.acquire_control()
        here.graph.refusal = "arm: got emergency stop, expected a reset before"
        await page.send(type="bridge_action", action="arm")
        await page.send(type="select_setup", setup="nowhere")
        await until(lambda: len(page.of("result")) == 3)
        refusals = {entry["request"]: entry["refusal"] for entry in page.of("result")}
        assert refusals == {"acquire_control": "", "arm": here.graph.refusal, "select_setup": "no setup nowhere"}

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


@pytest.mark.parametrize(
    "hostile",
    [
        "", "nonsense", "[" * 3000, '{"type": "jog", "direction": [NaN, 0], "speed": 1, "sent": 1}',
        '{"type": "jog", "direction": [1e999, 0], "speed": 1, "sent": 1}', '{"type": "jog", "direction": "left"}',
        json.dumps({"type": "end_jog", "ballast": "x" * 5000}), b"\x00\x01\x02",
    ],
)  # fmt: skip
def test_hostile_message_is_rejected_and_interrupts_the_jog(hostile: str | bytes):
    async def test(here: Console) -> None:
        page = await here.jogging_page()
        await (page.socket.send_bytes if isinstance(hostile, bytes) else page.socket.send_str)(hostile)
        await until(lambda: page.of("error"))
        assert here.graph.last == REST
        await page.jog(0, 1)
        await until(lambda: here.graph.last == NORTH)

    run(test, hold_timeout=1.0)


def test_a_huge_message_ends_the_connection_and_the_movement():
    async def test(here: Console) -> None:
        page = await here.jogging_page()
        with contextlib.suppress(ConnectionError):
            await page.socket.send_str("x" * 10_000_000)
        await until(lambda: here.graph.last == REST)
        await until(lambda: page.socket.closed)
        assert page.socket.close_code == 1009

    run(test, hold_timeout=1.0)


def test_a_flood_of_messages_is_refused():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.acquire_control()
        for _ in range(1500):
            await page.send(type="end_jog")
        await until(lambda: any("in a second" in entry["text"] for entry in page.of("error")))

    run(test)


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


def test_page_without_acknowledgements_gets_two_states():
    async def test(here: Console) -> None:
        slow = Page(await here.connect())
        slow.answers = False
        await slow.send(type="hello", token="")
        quick = await here.page()
        for number in range(1, 30):
            here.graph.picture = (number, picture())
            await quick.pictures(number)
        await until(lambda: len(quick.of("state")) > 20)
        assert len(slow.of("state")) == 2
        assert len(slow.frames) == 2
        slow.answers = True
        await slow.send(type="acknowledge", kind="frame")
        await until(lambda: len(slow.frames) == 3)
        assert int.from_bytes(slow.frames[-1][:8], "big") == 29

    run(test, frame_rate=100.0)


def test_a_page_that_stops_reading_does_not_delay_the_others():
    async def test(here: Console) -> None:
        stuck = await here.page()
        stuck.socket._conn.transport.pause_reading()
        quick = await here.page()
        await quick.acquire_control()
        for number in range(1, 200):
            here.graph.picture = (number, picture() * 20)
            await asyncio.sleep(0)
        await quick.jog(1, 0)
        await until(lambda: here.graph.last == EAST)
        states = len(quick.of("state"))
        await until(lambda: len(quick.of("state")) > states + 10)
        stuck.tear()

    run(test)


def test_a_page_that_comes_later_gets_the_frame_that_stands():
    async def test(here: Console) -> None:
        here.graph.picture = (7, picture())
        first = await here.page()
        await until(lambda: first.frames)
        second = await here.page()
        await until(lambda: second.frames)
        assert second.frames == [(7).to_bytes(8, "big") + picture()]

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


def test_what_ends_the_broadcast_task_is_raised_at_the_end():
    class Broken(RecordingGraph):
        def state(self) -> dict[str, Any]:
            raise RuntimeError("no state")

    async def test() -> None:
        server = ConsoleServer(ConsoleSettings(port=0, token=TOKEN), Broken(), RecordingHost())
        url = (await server.start()).split("#")[0]
        async with aiohttp.ClientSession() as session:
            socket = await session.ws_connect(url + "socket")
            await until(lambda: server._broadcast_task is not None and server._broadcast_task.done())
            with pytest.raises(RuntimeError, match="no state"):
                await server.stop()
            await socket.close()

    asyncio.run(test())


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

    monkeypatch.setattr("magnetosuture_thread.console.client_messages.parse_client_message", parse)
    monkeypatch.setattr("magnetosuture_thread.console.server.MAX_NEW_WATCHERS", 5)
    run(test, hold_timeout=1.0)


def test_pages_without_the_token_take_no_place_of_those_with_it():
    async def test(here: Console) -> None:
        watchers = [await here.connect() for _ in range(8)]
        with pytest.raises(aiohttp.WSServerHandshakeError) as full:
            await here.connect()
        assert full.value.status == 503
        with pytest.raises(aiohttp.WSServerHandshakeError):
            await here.session.ws_connect(here.url + "socket?token=wrong")
        here.sockets.append(await here.session.ws_connect(here.url + f"socket?token={TOKEN}"))
        operator = Page(here.sockets[-1])
        await operator.send(type="hello", token=TOKEN)
        await until(lambda: operator.of("welcome"))
        assert operator.of("welcome")[0]["can_command"] is True
        assert not any(watcher.closed for watcher in watchers)

    run(test)


def test_a_page_without_the_token_that_pings_is_disconnected():
    async def test(here: Console) -> None:
        watcher = await here.page("")
        await watcher.socket.ping(b"once")
        with contextlib.suppress(ConnectionError):
            for _ in range(500):
                await watcher.socket.ping(b"x" * 100)
        await until(lambda: watcher.socket.closed)

    run(test)


def test_who_asks_for_too_many_files_waits_for_the_next_second(monkeypatch: pytest.MonkeyPatch):
    async def test(here: Console) -> None:
        began = asyncio.get_running_loop().time()
        for _ in range(20):
            async with here.session.get(here.url) as answer:
                assert answer.status == 200
        assert asyncio.get_running_loop().time() - began > 2.0  # five in each second at the most
        operator = await here.session.ws_connect(here.url + f"socket?token={TOKEN}")
        assert not operator.closed
        await operator.close()

    monkeypatch.setattr("magnetosuture_thread.console.server.MAX_REQUESTS", 5)
    run(test)


MALFORMED = [
    "\x00\x01\x02\r\n\r\n",
    "GET / HTTP/9\r\n\r\n",
    "GET /\x7f HTTP/1.1\r\nHost x\r\n\r\n",
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


@pytest.mark.parametrize("path", ["", "nothing", "socket"])
def test_every_answer_has_the_security_headers(path: str):
    async def test(here: Console) -> None:
        for method in ("GET", "POST", "DELETE"):
            async with here.session.request(method, here.url + path) as response:
                assert HEADERS.items() <= response.headers.items()
        socket = await here.connect()
        assert HEADERS.items() <= socket._response.headers.items()

    run(test)


@pytest.mark.parametrize(
    ("is_browser", "automated", "operator"),
    [(True, False, "an operator"), (True, True, "a script"), (True, None, "a script"), (False, False, "a script")],
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


def test_a_first_message_other_than_hello_closes_the_connection_with_the_reason(caplog: pytest.LogCaptureFixture):
    async def test(here: Console) -> None:
        socket = await here.connect()
        await socket.send_str('{"type": "acquire_control"}')
        ended = await socket.receive(timeout=WAIT_TIMEOUT)
        assert (ended.data, ended.extra) == (aiohttp.WSCloseCode.POLICY_VIOLATION, "expected hello first")
        await until(lambda: not here.server._clients)

    run(test)
    assert not caplog.records


def test_states_come_at_the_frame_rate_and_not_faster(monkeypatch: pytest.MonkeyPatch):
    async def test(here: Console) -> None:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(0.0)  # the server has begun to wait for the first page
        clock = loop.time
        monkeypatch.setattr(loop, "time", lambda: clock() + 60.0)  # a minute without any page is not made up for
        page = await here.page()
        since, before = loop.time(), len(page.of("state"))
        await until(lambda: len(page.of("state")) >= before + 8)
        assert loop.time() - since > 5.0 / 20.0  # two more may have been on their way

    run(test, frame_rate=20.0)


def test_who_waits_for_the_next_second_waits_no_longer(monkeypatch: pytest.MonkeyPatch):
    delays: list[float] = []
    sleep = asyncio.sleep

    async def remembered(delay: float, *given: Any) -> Any:
        delays.append(delay)
        return await sleep(0.0 if delay > 0.1 else delay, *given)

    async def test(here: Console) -> None:
        monkeypatch.setattr(asyncio, "sleep", remembered)
        for _ in range(8):
            async with here.session.get(here.url):
                pass
        assert 0.0 < max(delays) <= 1.0

    monkeypatch.setattr("magnetosuture_thread.console.server.MAX_REQUESTS", 1)
    run(test)


def test_stopping_the_server_gives_up_requests_that_are_not_answered():
    async def test() -> None:
        class Slow(RecordingHost):
            async def set_paused(self, paused: bool) -> str:
                await asyncio.sleep(60.0)
                return ""

        server = ConsoleServer(ConsoleSettings(port=0, token=TOKEN), RecordingGraph(), Slow())
        url = (await server.start()).split("#")[0]
        async with aiohttp.ClientSession() as session:
            page = Page(await session.ws_connect(url + "socket"))
            await page.send(type="hello", token=TOKEN)
            page.number = (await until(lambda: page.of("welcome")))[0]["client"]
            await page.acquire_control()
            await page.send(type="pause", paused=True)
            await until(lambda: server._requests._pending)
            await asyncio.wait_for(server.stop(), WAIT_TIMEOUT)
            await page.socket.close()

    asyncio.run(test())


def test_the_reason_distinguishes_a_missing_token_from_a_wrong_one():
    async def test(here: Console) -> None:
        for token, refusal in (("", ""), ("wrong", "the token is wrong"), (TOKEN, "")):
            page = await here.page(token)
            assert page.of("welcome")[0]["refusal"] == refusal

    run(test)


def test_a_ping_is_answered_and_a_flood_of_them_ends_the_connection(monkeypatch: pytest.MonkeyPatch):
    async def test(here: Console) -> None:
        socket = await here.connect(autoping=False)
        await socket.send_str(json.dumps({"type": "hello", "token": TOKEN}))

        async def answers_until(*ends: aiohttp.WSMsgType) -> list[bytes]:
            answers: list[bytes] = []
            while (message := await socket.receive(timeout=WAIT_TIMEOUT)).type not in ends:
                answers += [bytes(message.data)] if message.type is aiohttp.WSMsgType.PONG else []
            return [*answers, bytes(message.data or b"")]

        await socket.ping(b"once")
        assert await answers_until(aiohttp.WSMsgType.PONG) == [b"once"]
        with contextlib.suppress(ConnectionError):
            for _ in range(300):
                await socket.ping(b"again")
        assert len(await answers_until(aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.ERROR)) < 300

    monkeypatch.setattr("magnetosuture_thread.console.client.MAX_MESSAGE_RATE", 20)
    run(test)


def test_as_many_messages_as_permitted_are_taken(monkeypatch: pytest.MonkeyPatch):
    async def test(here: Console) -> None:
        page = await here.page()
        for _ in range(60):  # and 30 acknowledgements of states in a second
            await page.send(type="visibility", visible=True)
        await page.acquire_control()
        assert not page.of("error")

    monkeypatch.setattr("magnetosuture_thread.console.client.MAX_MESSAGE_RATE", 100)
    run(test)


def test_a_frame_is_sent_once_and_nothing_is_compressed():
    async def test(here: Console) -> None:
        page = await here.page(compress=15)
        assert page.socket.compress == 0
        here.graph.picture = 1, picture()
        await page.pictures(1)
        states = len(page.of("state"))
        await until(lambda: len(page.of("state")) > states + 5)
        assert len(page.frames) == 1

    run(test)


def test_where_all_addresses_are_bound_the_url_names_one_that_a_browser_opens(monkeypatch: pytest.MonkeyPatch):
    class Local(web.TCPSite):
        """Binds to this machine alone, whatever it is to bind to."""

        def __init__(self, runner: Any, host: str, *given: Any, **options: Any) -> None:
            super().__init__(runner, "127.0.0.1", *given, **options)

    async def test(here: Console) -> None:
        assert here.url.startswith("http://127.0.0.1:")

    monkeypatch.setattr(web, "TCPSite", Local)
    run(test, address="0.0.0.0")


def test_it_is_served_at_the_address_that_is_set():
    async def test(here: Console) -> None:
        assert here.url.startswith("http://127.0.0.2:")
        async with here.session.get(here.url) as response:
            assert response.status == 200

    run(test, address="127.0.0.2")


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


def test_beyond_the_message_rate_nothing_but_an_emergency_stop_is_accepted(monkeypatch: pytest.MonkeyPatch):
    async def test(here: Console) -> None:
        page = await here.page()
        await page.acquire_control()
        monkeypatch.setattr("magnetosuture_thread.console.client.MAX_MESSAGE_RATE", 0)
        for action in ("arm", "reset", "disarm", "stop"):
            await page.send(type="bridge_action", action=action)
        await until(lambda: here.graph.actions)
        assert here.graph.actions == ["stop"]

    run(test)


def test_a_page_gets_the_speeds_of_the_settings_and_may_say_that_it_is_hidden_without_the_token():
    async def test(here: Console) -> None:
        page = await here.page("")
        welcome = page.of("welcome")[0]
        assert (welcome["speed"], welcome["max_speed"]) == (0.002, 0.008)
        await page.send(type="visibility", visible=False)
        await page.send(type="end_jog")
        await until(lambda: page.of("error"))
        assert len(page.of("error")) == 1

    run(test, speed=0.002, max_speed=0.008)
