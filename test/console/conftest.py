"""A console that is served in a thread, and a browser without a window that looks at it."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import ipaddress
import selectors
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from playwright.sync_api import Browser

from benchmarks.page import BROWSERS, started_browser
from magnetosuture_thread.console.server import ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from test.console.scene import RecordingGraph, RecordingHost
from test.console.visitor import TOKEN


class ServedConsole:
    """A server in a loop and a thread of its own, over a graph and a host that a test looks at."""

    def __init__(self, port: int = 0, **settings: Any) -> None:
        self.graph, self.host = RecordingGraph(), RecordingHost()
        self._selector = selectors.DefaultSelector()
        self.loop = asyncio.SelectorEventLoop(self._selector)
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self.server = ConsoleServer(ConsoleSettings(port=port, token=TOKEN, **settings), self.graph, self.host)
        self.url = ""

    def run(self, coroutine: Any) -> Any:
        """Run a coroutine in the server's loop."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(20.0)

    def tear(self) -> None:
        """End every connection without a word."""

        async def abort() -> None:
            for client in list(self.server._clients.values()):
                transport = client._request.transport
                assert transport is not None
                transport.abort()

        self.run(abort())

    def close(self) -> None:
        """Stop the server and its loop, which has to outlast connections that a browser opens in advance."""
        try:
            self.run(self.server.stop())
            self.run(self.all_closed())
        finally:
            self.loop.call_soon_threadsafe(self.loop.stop)
            self._thread.join()
            self.loop.close()

    async def all_closed(self) -> None:
        """Return once no socket is open; fail after 10 s."""
        deadline = time.monotonic() + 10.0
        while len(self._selector.get_map()) > 1:  # the loop's own pipe
            assert time.monotonic() < deadline, "a connection is left open"
            await asyncio.sleep(0.01)


class Link:
    """A TCP proxy before a server, in the server's loop.

    Attributes:
        mode: "pass"; "stalled", as a radio link that is away, which keeps all bytes back; or "dead": whatever is sent
            is lost, and nobody is told.
        port: on which it listens.
        target: port of the server.
    """

    def __init__(self) -> None:
        self.mode, self.port, self.target = "pass", 0, 0
        self._pumps: list[asyncio.Task[None]] = []

    async def open(self) -> None:
        """Listen on a free port."""
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Cut all connections."""
        self._server.close()
        for pump in self._pumps:
            pump.cancel()
        await asyncio.gather(*self._pumps, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self.target)
        for source, sink in ((reader, back), (there, writer)):
            self._pumps.append(asyncio.create_task(self._pump(source, sink)))

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        try:
            while data := await source.read(1 << 16):
                while self.mode == "stalled":
                    await asyncio.sleep(0.005)
                if self.mode == "pass":
                    sink.write(data)
        finally:
            sink.close()
            with contextlib.suppress(ConnectionError):
                await sink.wait_closed()


@pytest.fixture
def linked() -> Iterator[tuple[ServedConsole, Link]]:
    """Serve the page for one test, and return the link by which a browser reaches it."""
    console, link = ServedConsole(), Link()
    console.run(link.open())
    settings = ConsoleSettings(port=0, token=TOKEN, origin=f"http://127.0.0.1:{link.port}")
    console.server = ConsoleServer(settings, console.graph, console.host)
    console.url = console.run(console.server.start())
    link.target = console.server._port
    yield console, link
    console.run(link.close())
    console.close()


@pytest.fixture
def served() -> Iterator[ServedConsole]:
    """Serve the page for one test."""
    console = ServedConsole()
    console.url = console.run(console.server.start())
    yield console
    console.close()


@pytest.fixture(scope="module")  # its loop must be gone before other tests start theirs
def browser() -> Iterator[Browser]:
    """Start Chromium without a window."""
    if not any(map(shutil.which, BROWSERS)):
        pytest.skip("no chromium is installed; CI installs one")
    with started_browser() as started:
        yield started


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the files of a certificate for 127.0.0.1, signed by itself, and of its key."""
    folder = tmp_path_factory.mktemp("tls")
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rig of the tests")])
    now = datetime.datetime.now(datetime.timezone.utc)
    signed = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    (folder / "rig.pem").write_bytes(signed.public_bytes(pem))
    (folder / "key.pem").write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain))
    return folder / "rig.pem", folder / "key.pem"
