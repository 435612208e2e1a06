"""Web server of the operator page: static files, and one WebSocket for each page."""

from __future__ import annotations

import asyncio
import gc
import ssl
from collections.abc import Awaitable, Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from weakref import WeakSet

from aiohttp import web

from magnetosuture_thread.console.client import Client, Graph, Host, RequestHandler, encode_frame, encode_state
from magnetosuture_thread.console.jog_controller import JogController
from magnetosuture_thread.console.settings import ConsoleSettings, RateCounter, new_token, same_token
from magnetosuture_thread.settings.errors import ConfigurationError

MAX_CLIENTS = 16  # with the token
MAX_WATCHERS = 8  # without it, from one address, and twice as many in all; they take no place of the others
MAX_NEW_WATCHERS = 20  # from one address in a second
HEARTBEAT_PERIOD = 5.0  # a page that does not answer a ping within half of this is disconnected [s]


Responder = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class ConsoleServer:
    """Serves the operator page, sends it the state of the graph, and executes its commands.

    Args:
        settings: of the console.
        graph: the running graph.
        host: of the graph.
    """

    def __init__(self, settings: ConsoleSettings, graph: Graph, host: Host) -> None:
        self._settings = replace(settings, token=settings.token or new_token())
        self._graph, self._host = graph, host
        self._files = page_files()
        self._jog = JogController(graph.publish_velocity, settings.rate, settings.hold_timeout)
        self._requests = RequestHandler(graph, host, self._jog)
        self._clients: dict[int, Client] = {}
        self._new_watchers, self._request_rate = RateCounter(), RateCounter()
        self._count = self._port = 0
        self._frame_number, self._frame = -1, b""
        self._transports: WeakSet[asyncio.Transport] = WeakSet()
        self._runner: web.ServerRunner | None = None
        self._broadcast_task: asyncio.Task[None] | None = None

    async def start(self) -> str:
        """Start the server; return the URL of the page, with the token in its fragment.

        Raises:
            ConfigurationError: the address cannot be bound, or the certificate not be used.
        """
        context = server_context(self._settings)
        runner = web.ServerRunner(_Server(self._respond, self._transports), shutdown_timeout=1.0)
        await runner.setup()
        address, port = self._settings.address, self._settings.port
        try:
            bound = "127.0.0.1" if address == "localhost" else address
            await web.TCPSite(runner, bound, port, ssl_context=context).start()
        except OSError as error:
            await runner.cleanup()
            expected = f"a free port of {address} ({error.strerror or error})"
            raise ConfigurationError(f"{ConsoleSettings.GROUP}.port", port, expected) from None
        self._runner, self._port = runner, runner.addresses[0][1]
        self._broadcast_task = asyncio.create_task(self._broadcast())
        # Excludes loaded objects from garbage collection, which would take tens of milliseconds each time.
        gc.collect()
        gc.freeze()
        return self._settings.page_url(self._port)

    async def stop(self) -> None:
        """Stop the needle, then close all connections; raise the error that ended the broadcast, if any."""
        self._jog.stop()
        task, self._broadcast_task = self._broadcast_task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        await asyncio.gather(*(client.close() for client in list(self._clients.values())), return_exceptions=True)
        await self._requests.close()
        if self._runner is not None:
            # Over TLS each would wait up to 30 s for its browser to close it too.
            for transport in list(self._transports):
                transport.abort()
            await self._runner.cleanup()
            await asyncio.sleep(0)
        self._runner = None
        if task is not None and not task.cancelled():
            task.result()

    async def _respond(self, request: web.BaseRequest) -> web.StreamResponse:
        if not same_token(request.query.get("token"), self._settings.token):
            now = asyncio.get_running_loop().time()
            if self._request_rate.count(request.remote or "", now) > 100:  # those beyond wait for the next second
                await asyncio.sleep(1.0 - now % 1.0)
        if refusal := self._settings.host_refusal(request.headers.get("Host", ""), self._port):
            return _answer(403, refusal)
        if request.method not in ("GET", "HEAD"):
            return _answer(405, "only GET")
        if request.path == "/socket":
            try:
                return await self._connect(request)
            except web.HTTPBadRequest as error:  # no WebSocket
                return _answer(error.status, error.text or "")
        if request.path == "/measurement.png" and (picture := self._host.picture()):  # of what was measured last
            return web.Response(body=picture, content_type="image/png", headers=HEADERS)
        if request.path not in self._files:
            return _answer(404, "there is no such file")
        content_type, body = self._files[request.path]
        return web.Response(body=body, content_type=content_type, charset="utf-8", headers=HEADERS)

    async def _connect(self, request: web.BaseRequest) -> web.StreamResponse:
        origin, host = (request.headers.get(name, "") for name in ("Origin", "Host"))
        if refusal := self._settings.origin_refusal(origin, host):
            return _answer(403, refusal)
        # Only for a place: commands need the token of the greeting.
        has_token = same_token(request.query.get("token"), self._settings.token)
        if full := self._no_place(has_token, request.remote or ""):
            return _answer(503, full)
        # Pings are left to the client, which counts them.
        socket = web.WebSocketResponse(compress=False, autoping=False, heartbeat=HEARTBEAT_PERIOD, max_msg_size=1 << 16)
        socket.headers.update(HEADERS)
        self._count += 1
        number = self._count
        client = Client(number, socket, request, self._settings, self._requests)
        self._clients[number] = client
        client.has_token = has_token
        if self._frame:
            client.outbox.put("frame", self._frame)
        try:
            await socket.prepare(request)
            await client.serve()
        finally:
            del self._clients[number]
        return socket

    def _no_place(self, has_token: bool, address: str) -> str:
        """Return why a connection from an address has no place; empty if it has one."""
        if has_token:
            count = sum(client.has_token for client in self._clients.values())
            return f"{MAX_CLIENTS} pages are connected already" if count >= MAX_CLIENTS else ""
        new = self._new_watchers.count(address, asyncio.get_running_loop().time())
        watchers = [client.address for client in self._clients.values() if not client.has_token]
        too_many = watchers.count(address) >= MAX_WATCHERS or len(watchers) >= 2 * MAX_WATCHERS
        if too_many or new > MAX_NEW_WATCHERS:
            return "too many pages without the token are connected already"
        return ""

    async def _broadcast(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            now = loop.time()
            if self._clients and now >= due:
                due = max(due + 1.0 / self._settings.frame_rate, now)
                self._send_all("state", self._state())
            frame = self._graph.frame() if self._clients else None
            if frame is not None and frame[0] != self._frame_number:
                self._frame_number, self._frame = frame[0], encode_frame(*frame)
                self._send_all("frame", self._frame)
            await asyncio.sleep(0.005)

    def _send_all(self, kind: str, message: str | bytes) -> None:
        for client in self._clients.values():
            client.outbox.put(kind, message)

    def _state(self) -> str:
        jog = self._jog
        lease = {"holder": jog.holder, "available": jog.available, "release_first": jog.switch.latched}
        lease["pages"] = len(self._clients)
        graph = self._graph.state()
        jog.set_armed(bool((graph.get("bridge") or {}).get("armed")))
        return encode_state(graph, self._host.state(), lease)


def _answer(status: int, text: str) -> web.Response:
    return web.Response(status=status, text=text, headers=HEADERS)


class _Connection(web.RequestHandler):
    """HTTP connection whose errors carry our headers too; what is no HTTP is answered, not logged."""

    def __init__(self, server: _Server) -> None:
        super().__init__(server, loop=asyncio.get_running_loop(), access_log=None)  # type: ignore[arg-type]
        self._opened = server.transports

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Remember the transport, which aiohttp forgets before it is closed."""
        assert isinstance(transport, asyncio.Transport)
        self._opened.add(transport)
        super().connection_made(transport)

    def handle_error(
        self, request: web.BaseRequest, status: int = 500, *arguments: Any, **options: Any
    ) -> web.StreamResponse:
        """Return the response to a request that cannot be handled; it closes the connection."""
        malformed = _answer(status, "malformed request") if status < 500 else None
        response = malformed or super().handle_error(request, status, *arguments, **options)
        response.headers.update(HEADERS)
        response.force_close()
        return response


class _Server(web.Server):
    """Makes such connections; `transports` holds those that are not closed."""

    def __init__(self, respond: Responder, transports: WeakSet[asyncio.Transport]) -> None:
        super().__init__(respond)
        self.transports = transports

    def __call__(self) -> _Connection:
        return _Connection(self)


def page_files() -> dict[str, tuple[str, bytes]]:
    """Return MIME type and content of the page's files by the path of their URL; `/` is the page itself."""
    types = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
    entries = [Path(str(entry)) for entry in files("magnetosuture_thread.console").joinpath("page").iterdir()]
    served = {f"/{path.name}": (types[path.suffix], path.read_bytes()) for path in entries if path.suffix in types}
    return {"/": served.pop("/index.html"), **served}


def server_context(settings: ConsoleSettings) -> ssl.SSLContext | None:
    """Return the TLS context of a server, version 1.2 or later; None where the settings name no certificate.

    Raises:
        ConfigurationError: certificate or key cannot be read, do not belong together, or the key has a password.
    """
    if not settings.certificate:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # Without this password OpenSSL would ask at the terminal.
        context.load_cert_chain(settings.certificate, settings.private_key or None, password=lambda: b"")
    except (OSError, ValueError) as error:
        expected = "a PEM file with a certificate, and its key without a password in it or in private_key"
        name, reason = f"{ConsoleSettings.GROUP}.certificate", " ".join(str(error).split())
        raise ConfigurationError(name, settings.certificate, f"{expected} ({reason})") from None
    return context
