"""A page that watches the graph under attack, and takes the time between the states that it gets."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import aiohttp

URL = "the operator's page: "  # before it in what the console prints
RETRY_PERIOD = 0.2  # s


class WatchingPage:
    """Connects to the console from a thread of its own, again and again if it has to; used as a context.

    Args:
        log: the file with what the console prints.

    Attributes:
        gaps: between two states of one connection [s].
        losses: connections that the server ended.
    """

    def __init__(self, log: Path) -> None:
        self.gaps: list[float] = []
        self.losses = 0
        self._log = log
        self._ends = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)

    def __enter__(self) -> WatchingPage:
        """Begin to watch."""
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Disconnect."""
        self._ends.set()
        self._thread.join()

    async def _run(self) -> None:
        async with aiohttp.ClientSession() as session:
            while not self._ends.is_set():
                found = [line for line in self._lines() if line.startswith(URL)]
                if not found:
                    await asyncio.sleep(RETRY_PERIOD)
                    continue
                url = urlsplit(found[-1].removeprefix(URL))
                try:
                    await self._watch(session, f"http://{url.netloc}", parse_qs(url.fragment)["token"][0])
                except aiohttp.ClientError:
                    await asyncio.sleep(RETRY_PERIOD)

    def _lines(self) -> list[str]:
        return self._log.read_text(errors="replace").splitlines() if self._log.exists() else []

    async def _watch(self, session: aiohttp.ClientSession, address: str, token: str) -> None:
        async with session.ws_connect(f"{address}/socket?token={token}", origin=address) as socket:
            await socket.send_json({"type": "hello", "token": token, "automated": True})
            last = None
            while not self._ends.is_set():
                try:
                    message = await socket.receive(timeout=RETRY_PERIOD)
                except asyncio.TimeoutError:
                    continue
                if message.type not in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY):
                    self.losses += 1
                    return
                if message.type is aiohttp.WSMsgType.BINARY:
                    await socket.send_json({"type": "acknowledge", "kind": "frame"})
                elif json.loads(message.data)["type"] == "state":
                    await socket.send_json({"type": "acknowledge", "kind": "state"})
                    now = time.monotonic()
                    self.gaps += [] if last is None else [now - last]
                    last = now
