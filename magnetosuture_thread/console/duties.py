"""What a page can ask for beside steering: of the coil bridge, and of whoever runs the graph."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from magnetosuture_thread.console.graph import Graph, Host
from magnetosuture_thread.console.steering import Steering
from magnetosuture_thread.console.words import Act, Choose, Pause, Record, Word
from magnetosuture_thread.errors import InvalidInputError, MagnetosutureError

MOST = 4  # under way for one page, emergency stops aside
SAFE = ("stop", "disarm")  # what everybody with the token may ask for, who steers or not

Answer = Callable[[str, str], None]


class Duties:
    """Does what pages ask for, beside the loop that hears them.

    Args:
        graph: the running graph.
        host: who runs it.
        steering: who steers.
    """

    def __init__(self, graph: Graph, host: Host, steering: Steering) -> None:
        self._graph = graph
        self._host = host
        self._steering = steering
        self._under_way: dict[asyncio.Task[None], int] = {}

    def begin(self, client: int, word: Word, answer: Answer) -> None:
        """Begin what a page with the token asks for.

        Args:
            client: its number.
            word: what it said.
            answer: is called with what was asked for and the refusal, empty if it was done.

        Raises:
            InvalidInputError: only the one who steers may ask for this, or too much is under way.
        """
        safe = isinstance(word, Act) and word.action in SAFE
        if not safe and client != self._steering.holder:
            raise InvalidInputError(_name(word), "a page that does not steer", "the one that does: take steering first")
        if not safe and list(self._under_way.values()).count(client) >= MOST:
            raise InvalidInputError(_name(word), f"{MOST} requests under way", "an answer to one of them first")
        if not isinstance(word, Record) and not (isinstance(word, Act) and word.action == "arm"):
            self._steering.rest()
        task = asyncio.create_task(self._do(word, answer))
        self._under_way[task] = client
        task.add_done_callback(lambda done: self._under_way.pop(done, None))

    async def close(self) -> None:
        """Give up what is under way."""
        tasks = list(self._under_way)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _do(self, word: Word, answer: Answer) -> None:
        try:
            refusal = await self._request(word)
        except MagnetosutureError as error:
            refusal = str(error)
        answer(_name(word), refusal)

    def _request(self, word: Word) -> Awaitable[str]:
        if isinstance(word, Act):
            return self._graph.act(word.action)
        if isinstance(word, Choose):
            return self._host.choose(word.scenario)
        if isinstance(word, Pause):
            return self._host.pause(word.still)
        if isinstance(word, Record):
            return self._host.record(word.on)
        raise InvalidInputError("message", _name(word), "a request")


def _name(word: Word) -> str:
    return word.action if isinstance(word, Act) else type(word).__name__.lower()
