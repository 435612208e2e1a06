"""A client of the server that is no browser and may lie, and a server for one test."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import aiohttp

from magnetosuture_thread.console.server import ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from test.console.scene import RecordingGraph, RecordingHost

TOKEN = "a-token-of-the-tests"
WAIT_TIMEOUT = 30.0  # [s]
REST = (0.0, 0.0)
EAST, NORTH = (0.003, 0.0), (0.0, 0.003)  # what a page asks for that holds a direction [m/s]


async def until(condition: Callable[[], Any], what: str = "the condition", timeout: float = WAIT_TIMEOUT) -> Any:
    """Wait until a condition holds, and return what it gave."""
    end = time.monotonic() + timeout
    while not (result := condition()):
        assert time.monotonic() < end, f"waited for {what}"
        await asyncio.sleep(0.002)
    return result


class Page:
    """A connected client, and the messages that it received."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket  # an aiohttp.ClientWebSocketResponse
        self.received: list[dict[str, Any]] = []
        self.frames: list[bytes] = []
        self.graph: dict[str, Any] = {}
        self.host: dict[str, Any] = {}
        self.lease: dict[str, Any] = {}
        self.number = 0
        self.reading = asyncio.create_task(self._read())
        self._held: asyncio.Task[None] | None = None

    async def _read(self) -> None:
        async for message in self.socket:
            what = "frame"
            if message.type is aiohttp.WSMsgType.BINARY:
                self.frames.append(message.data)
            else:
                content = json.loads(message.data)
                self.received.append(content)
                if (what := content["type"]) != "state":
                    continue
                self.graph, self.host, self.lease = (content[name] for name in ("graph", "host", "lease"))
            with contextlib.suppress(ConnectionError):
                await self.send(type="acknowledge", kind=what)

    async def send(self, **message: Any) -> None:
        """Send a message; one that starts something has to say when it was pressed."""
        if message.get("action") in ("arm", "reset", "resume"):
            message.setdefault("sent", time.monotonic())
        await self.socket.send_str(json.dumps(message))

    async def ask(self, **message: Any) -> str:
        """Send a request and return the refusal, empty if it was done."""
        before = len(self.of("result"))
        await self.send(**message)
        await until(lambda: len(self.of("result")) > before, f"an answer to {message}; {self.of('error')}", 120.0)
        return str(self.of("result")[-1]["refusal"])

    async def jog(self, x: float, y: float, speed: float = 0.003, sent: float | None = None) -> None:
        """Send a jog message."""
        await self.send(type="jog", direction=[x, y], speed=speed, sent=time.monotonic() if sent is None else sent)

    def hold(self, x: float, y: float, speed: float = 0.003) -> None:
        """Hold a key from now on."""

        async def repeat() -> None:
            while True:
                await self.jog(x, y, speed)
                await asyncio.sleep(0.02)

        self._held = asyncio.create_task(repeat())

    async def release(self) -> None:
        """Release the key."""
        if self._held is not None:
            self._held.cancel()
            await asyncio.gather(self._held, return_exceptions=True)
        await self.send(type="end_jog")

    def tear(self) -> None:
        """End the TCP connection without a word."""
        self.socket._conn.transport.abort()

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Return the received messages of a type."""
        return [message for message in self.received if message["type"] == kind]

    async def acquire_control(self) -> None:
        """Acquire control, and wait for the state that shows it."""
        await self.send(type="acquire_control")
        await until(lambda: self.lease.get("holder") == self.number)


@contextlib.asynccontextmanager
async def opened(url: str) -> AsyncIterator[Page]:
    """Open the page at an address as the command prints it, with its token."""
    address, token = url.split("/#token=")
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{address}/socket") as socket:
        page = Page(socket)
        await page.send(type="hello", token=token)
        yield page
        await page.release()
        page.reading.cancel()


class Console:
    """A server for one test, its graph and its host."""

    def __init__(self, **settings: Any) -> None:
        self.graph, self.host = RecordingGraph(), RecordingHost()
        self.settings = ConsoleSettings(**{"port": 0, "token": TOKEN, **settings})
        self.server = ConsoleServer(self.settings, self.graph, self.host)
        self.url = ""
        self.session: aiohttp.ClientSession
        self.sockets: list[Any] = []

    async def connect(self, **options: Any) -> Any:
        """Connect without a word."""
        self.sockets.append(await self.session.ws_connect(self.url + "socket", **options))
        return self.sockets[-1]

    async def page(self, token: str = TOKEN, **options: Any) -> Page:
        """Connect a page and greet."""
        page = Page(await self.connect(**options))
        await page.send(type="hello", token=token)
        page.number = (await until(lambda: page.of("welcome")))[0]["client"]
        return page

    async def jogging_page(self) -> Page:
        """Connect a page that jogs to the east."""
        page = await self.page()
        await page.acquire_control()
        await page.jog(1, 0)
        await until(lambda: self.graph.last == EAST)
        return page


@contextlib.asynccontextmanager
async def console(**settings: Any) -> AsyncIterator[Console]:
    """Serve for one test."""
    served = Console(**settings)
    served.url = (await served.server.start()).split("#")[0]
    async with aiohttp.ClientSession() as served.session:
        yield served
        await served.server.stop()
        await asyncio.gather(*(socket.close() for socket in served.sockets))


def run(test: Callable[[Console], Awaitable[None]], **settings: Any) -> None:
    """Run a test against a server of its own."""

    async def served() -> None:
        async with console(**settings) as here:
            await test(here)

    asyncio.run(served())
