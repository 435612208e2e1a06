"""Requests of pages besides jogging: to the coil bridge, and to the host of the graph."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from magnetosuture_thread.console.client_messages import BridgeAction, ClientMessage, Pause, RecordBag, SelectSetup
from magnetosuture_thread.console.graph import Graph, Host
from magnetosuture_thread.console.jog_controller import JogController
from magnetosuture_thread.errors import InvalidInputError, MagnetosutureError

MAX_PENDING_REQUESTS = 4  # of one page, besides emergency stops
UNLEASED_ACTIONS = ("stop", "disarm")  # allowed for every page with the token, with or without control

Reply = Callable[[str, str], None]


class RequestHandler:
    """Executes requests of pages as asyncio tasks.

    Args:
        graph: the running graph.
        host: of the graph.
        jog: knows which page has control.
    """

    def __init__(self, graph: Graph, host: Host, jog: JogController) -> None:
        self._graph = graph
        self._host = host
        self._jog = jog
        self._pending: dict[asyncio.Task[None], int] = {}

    def start(self, client: int, message: ClientMessage, reply: Reply) -> None:
        """Start a request of a page with the token.

        Args:
            client: its number.
            message: the request.
            reply: called with the request's name and the refusal, empty on success.

        Raises:
            InvalidInputError: the request needs control, or too many are pending.
        """
        unleased = isinstance(message, BridgeAction) and message.action in UNLEASED_ACTIONS
        if not unleased and client != self._jog.holder:
            raise InvalidInputError(_name(message), "a page without control", "one with control: take control first")
        if not unleased and list(self._pending.values()).count(client) >= MAX_PENDING_REQUESTS:
            raise InvalidInputError(
                _name(message), f"{MAX_PENDING_REQUESTS} pending requests", "a reply to one of them first"
            )
        if not isinstance(message, RecordBag) and not (isinstance(message, BridgeAction) and message.action == "arm"):
            self._jog.stop()
        task = asyncio.create_task(self._execute(message, reply))
        self._pending[task] = client
        task.add_done_callback(lambda done: self._pending.pop(done, None))

    async def close(self) -> None:
        """Cancel pending requests."""
        tasks = list(self._pending)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _execute(self, message: ClientMessage, reply: Reply) -> None:
        try:
            refusal = await self._request(message)
        except MagnetosutureError as error:
            refusal = str(error)
        reply(_name(message), refusal)

    def _request(self, message: ClientMessage) -> Awaitable[str]:
        if isinstance(message, BridgeAction):
            return self._graph.execute_action(message.action)
        if isinstance(message, SelectSetup):
            return self._host.select_setup(message.setup)
        if isinstance(message, Pause):
            return self._host.set_paused(message.paused)
        if isinstance(message, RecordBag):
            return self._host.set_recording(message.recording)
        raise InvalidInputError("message", _name(message), "a request")


def _name(message: ClientMessage) -> str:
    return message.action if isinstance(message, BridgeAction) else message.TYPE
