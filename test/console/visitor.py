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


async def until(condition: Callable[[], Any]) -> Any:
    """Wait until a condition holds, and return what it gave."""
    end = time.monotonic() + WAIT_TIMEOUT
    while not (result := condition()):
        assert time.monotonic() < end, "the condition has not come true"
        await asyncio.sleep(0.002)
    return result


class Page:
    """A connected client, and the messages that it received."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket  # an aiohttp.ClientWebSocketResponse
        self.received: list[dict[str, Any]] = []
        self.frames: list[bytes] = []
        self.number = 0
        self.answers = True
        self.reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        async for message in self.socket:
            what = "state"
            if message.type is aiohttp.WSMsgType.BINARY:
                self.frames.append(message.data)
                what = "frame"
            else:
                self.received.append(json.loads(message.data))
                if self.received[-1]["type"] != "state":
                    continue
            if self.answers:
                with contextlib.suppress(ConnectionError):
                    await self.send(type="acknowledge", kind=what)

    async def send(self, **message: Any) -> None:
        """Send a message."""
        await self.socket.send_str(json.dumps(message))

    async def jog(self, x: float, y: float, speed: float = 0.003, sent: float | None = None) -> None:
        """Send a jog message."""
        await self.send(type="jog", direction=[x, y], speed=speed, sent=time.monotonic() if sent is None else sent)

    def tear(self) -> None:
        """End the TCP connection without a word."""
        self.socket._conn.transport.abort()

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Return the received messages of a type."""
        return [message for message in self.received if message["type"] == kind]

    async def pictures(self, count: int) -> None:
        """Wait until so many frames have come."""
        await until(lambda: len(self.frames) >= count)

    @property
    def lease(self) -> dict[str, Any]:
        """The control lease of the last state."""
        states = self.of("state")
        return states[-1]["lease"] if states else {}

    async def acquire_control(self) -> None:
        """Acquire control, and wait for the state that shows it."""
        await self.send(type="acquire_control")
        await until(lambda: self.lease.get("holder") == self.number)


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
