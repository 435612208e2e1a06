"""The server of the operator's page: its files, and one WebSocket for each page."""

from __future__ import annotations

import asyncio
import gc

from aiohttp import web
from aiohttp.typedefs import Handler

from magnetosuture_thread.console.access import host_refusal, is_any, new_token, origin_refusal, page_url
from magnetosuture_thread.console.broadcast import frame_message, state_message
from magnetosuture_thread.console.client import Client
from magnetosuture_thread.console.duties import Duties
from magnetosuture_thread.console.graph import Graph, Host
from magnetosuture_thread.console.pages import HEADERS, page_files
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.console.steering import Steering
from magnetosuture_thread.errors import ConfigurationError

MOST_CLIENTS = 16
LONGEST_MESSAGE = 65536  # bytes; beyond, the connection is closed before the message is read to its end
LOOK = 0.005  # between two looks for a new camera frame [s]
HEARTBEAT = 5.0  # a page that does not even answer a ping after half of this is gone [s]


class ConsoleServer:
    """Serves the page, tells it the graph's state, and steers by what it says.

    Args:
        settings: of the console.
        graph: the running graph.
        host: who runs it.
    """

    def __init__(self, settings: ConsoleSettings, graph: Graph, host: Host) -> None:
        self._settings = settings
        self._graph = graph
        self._host = host
        self._token = settings.token or new_token()
        self._files = page_files()
        self._steering = Steering(graph.steer, settings.rate, settings.hold_timeout)
        self._duties = Duties(graph, host, self._steering)
        self._clients: dict[int, Client] = {}
        self._count = 0
        self._port = 0
        self._shown, self._frame = -1, b""
        self._runner: web.AppRunner | None = None
        self._telling: asyncio.Task[None] | None = None

    async def start(self) -> str:
        """Serve from now on; return the URL that a person opens, with the token in its fragment.

        Raises:
            ConfigurationError: the address cannot be bound.
        """
        application = web.Application(middlewares=[self._guard])
        application.router.add_get("/socket", self._connect)
        application.router.add_get("/{name:[^/]*}", self._serve_file)
        application.on_response_prepare.append(_add_headers)
        runner = web.AppRunner(application, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        address = self._settings.address
        try:
            site = web.TCPSite(runner, "127.0.0.1" if address == "localhost" else address, self._settings.port)
            await site.start()
        except OSError as error:
            await runner.cleanup()
            reason = error.strerror or str(error)
            raise ConfigurationError(
                f"{ConsoleSettings.GROUP}.port", self._settings.port, f"a free port of {address} ({reason})"
            ) from None
        self._runner, self._port = runner, runner.addresses[0][1]
        self._telling = asyncio.create_task(self._tell())
        # What was loaded stays; to look through it for garbage again and again takes tens of milliseconds.
        gc.collect()
        gc.freeze()
        return page_url("127.0.0.1" if is_any(address) else address, self._port, self._token)

    async def stop(self) -> None:
        """Steer to rest, then end all connections; raises what ended the telling of states early, if anything did."""
        self._steering.rest()
        telling, self._telling = self._telling, None
        if telling is not None:
            telling.cancel()
            await asyncio.wait([telling])
        await asyncio.gather(*(client.leave() for client in list(self._clients.values())), return_exceptions=True)
        await self._duties.close()
        if self._runner is not None:
            await self._runner.cleanup()
        self._runner = None
        if telling is not None and not telling.cancelled():
            telling.result()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        refusal = host_refusal(request.headers.get("Host", ""), self._settings.address, self._port)
        if refusal:
            return web.Response(status=403, text=refusal)
        return await handler(request)

    async def _serve_file(self, request: web.Request) -> web.Response:
        found = self._files.get(request.path)
        if found is None:
            return web.Response(status=404, text="there is no such file")
        return web.Response(body=found.body, content_type=found.content_type, charset="utf-8")

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        refusal = origin_refusal(request.headers.get("Origin", ""), request.headers.get("Host", ""))
        if refusal:
            return web.Response(status=403, text=refusal)
        if len(self._clients) >= MOST_CLIENTS:
            return web.Response(status=503, text=f"{MOST_CLIENTS} pages are connected already")
        socket = web.WebSocketResponse(compress=False, heartbeat=HEARTBEAT, max_msg_size=LONGEST_MESSAGE)
        self._count += 1
        number = self._count
        client = Client(number, socket, request, self._settings, self._token, self._steering, self._duties)
        self._clients[number] = client
        if self._frame:
            client.tell("frame", self._frame)
        try:
            await socket.prepare(request)
            await client.serve()
        finally:
            del self._clients[number]
        return socket

    async def _tell(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            now = loop.time()
            if self._clients and now >= due:
                due = max(due + 1.0 / self._settings.frame_rate, now)
                self._tell_all("state", self._state())
            frame = self._graph.frame() if self._clients else None
            if frame is not None and frame[0] != self._shown:
                self._shown, self._frame = frame[0], frame_message(*frame)
                self._tell_all("frame", self._frame)
            await asyncio.sleep(LOOK)

    def _tell_all(self, what: str, message: str | bytes) -> None:
        for client in self._clients.values():
            client.tell(what, message)

    def _state(self) -> str:
        lease = {
            "holder": self._steering.holder,
            "available": self._steering.available,
            "pages": len(self._clients),
        }
        graph = self._graph.state()
        self._steering.watch(bool((graph.get("bridge") or {}).get("armed")))
        return state_message(graph, self._host.state(), lease)


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)
