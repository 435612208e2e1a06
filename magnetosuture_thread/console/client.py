"""One page that is connected: hears what it says, tells it the newest."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from aiohttp import WSMsgType, web

from magnetosuture_thread.console.access import same_token
from magnetosuture_thread.console.duties import Duties
from magnetosuture_thread.console.lateness import Lateness
from magnetosuture_thread.console.outbox import Message, Outbox
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.console.steering import Steering
from magnetosuture_thread.console.words import Act, Got, HandBack, Hello, Hold, Release, Take, Visible, Word, read_word
from magnetosuture_thread.errors import InvalidInputError

HELLO_WITHIN = 5.0  # of the connection [s]
SEND_WITHIN = 2.0  # before a page that takes nothing is cut off [s]
LATE_FOR = 1.0  # before a page whose words all come late has to connect again [s]
MOST_WORDS = 400  # a second; of what is beyond, only an emergency stop is obeyed
FLOOD = 2000  # of those beyond, in all, after which the connection is closed
STOP = Act("stop")


class Client:
    """A connected page.

    Args:
        number: of the connection, from 1.
        socket: the prepared WebSocket.
        request: that it came by.
        settings: of the console.
        token: that lets command.
        steering: who steers, and what is held.
        duties: what else can be asked for.
    """

    def __init__(
        self,
        number: int,
        socket: web.WebSocketResponse,
        request: web.Request,
        settings: ConsoleSettings,
        token: str,
        steering: Steering,
        duties: Duties,
    ) -> None:
        self.number = number
        self._socket = socket
        self._request = request
        self._settings = settings
        self._token = token
        self._steering = steering
        self._duties = duties
        self._outbox = Outbox()
        self._wake = asyncio.Event()
        self._commands = False
        self._lateness = Lateness()
        self._in_time = 0.0  # when the last word came that was not late
        self._second, self._words, self._excess = 0, 0, 0

    def tell(self, what: str, message: Message) -> None:
        """Let the page have the newest `state` or `frame` when it can take it."""
        self._outbox.put(what, message)
        self._wake.set()

    async def serve(self) -> None:
        """Hear the page until it is gone; whatever ends the connection, the needle is told to rest."""
        sending = None
        try:
            if not await self._greet():
                return
            sending = asyncio.create_task(self._send_all())
            async for message in self._socket:
                await self._hear(message.type, message.data)
        finally:
            self._steering.hand_back(self.number)
            if sending is not None:
                sending.cancel()
                await asyncio.gather(sending, return_exceptions=True)

    async def leave(self) -> None:
        """End the connection as the server goes."""
        await self._socket.close(code=1001, message=b"the server ends")

    async def _greet(self) -> bool:
        try:
            message = await self._socket.receive(timeout=HELLO_WITHIN)
            word = self._read(message.type, message.data)
        except (asyncio.TimeoutError, InvalidInputError):
            word = None
        if not isinstance(word, Hello):
            await self._socket.close(code=1008, message=b"expected hello first")
            return False
        self._commands = same_token(word.token, self._token)
        settings = self._settings
        self._answer(
            "welcome",
            you=self.number,
            commands=self._commands,
            refusal="the token is wrong" if word.token and not self._commands else "",
            speed=settings.speed,
            max_speed=settings.max_speed,
        )
        return True

    def _read(self, kind: WSMsgType, data: Any) -> Word:
        if kind is not WSMsgType.TEXT:
            raise InvalidInputError("message", kind.name.lower(), "text")
        return read_word(data, self._settings.max_speed)

    async def _hear(self, kind: WSMsgType, data: Any) -> None:
        now = asyncio.get_running_loop().time()
        self._steering.hear(self.number)
        try:
            crowded = self._count(now)
            word = self._read(kind, data)
            if crowded and word != STOP:
                raise InvalidInputError("messages", f"{self._words} in a second", f"at most {MOST_WORDS}")
            if isinstance(word, Got):
                self._outbox.got(word.what)
                self._wake.set()
            elif not self._commands:
                if not isinstance(word, Visible):
                    raise InvalidInputError("token", "none", "the one in the console's address: this page only watches")
            else:
                await self._obey(word, now)
        except InvalidInputError as error:
            self._steering.interrupt(self.number)
            self._answer("error", text=str(error))
            if self._excess > FLOOD:
                await self._socket.close(code=1008, message=b"too many messages")

    async def _obey(self, word: Word, now: float) -> None:
        if isinstance(word, Hold):
            await self._hold(word, now)
        elif isinstance(word, Release):
            self._steering.release(self.number)
        elif isinstance(word, Take):
            self._answer("done", what="take", refusal=self._steering.take(self.number))
        elif isinstance(word, HandBack):
            self._steering.hand_back(self.number)
        elif isinstance(word, Visible):
            self._steering.show(self.number, word.seen)
        elif not isinstance(word, (Hello, Got)):
            self._duties.begin(
                self.number, word, lambda what, refusal: self._answer("done", what=what, refusal=refusal)
            )

    async def _hold(self, word: Hold, now: float) -> None:
        late = self._lateness.of(word.sent, now)
        if late <= self._settings.hold_timeout:
            self._in_time = now
            if not self._steering.hold(self.number, word.velocity):
                self._answer("error", text="hold: this page does not steer; take steering first")
            return
        self._steering.interrupt(self.number)
        self._answer("error", text=f"hold: came {late:.2f} s late, expected at most {self._settings.hold_timeout:g} s")
        if now - self._in_time > LATE_FOR:
            await self._socket.close(code=1008, message=b"every word comes late")

    def _count(self, now: float) -> bool:
        """Count a message; return whether it is one too many."""
        second = int(now)
        self._second, self._words = second, self._words + 1 if second == self._second else 1
        crowded = self._words > MOST_WORDS
        self._excess += crowded
        return crowded

    def _answer(self, kind: str, **fields: Any) -> None:
        self._outbox.answer(json.dumps({"type": kind, **fields}))
        self._wake.set()

    async def _send_all(self) -> None:
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                while (message := self._outbox.next()) is not None:
                    await asyncio.wait_for(self._send(message), SEND_WITHIN)
        except (asyncio.TimeoutError, ConnectionError):
            transport = self._request.transport
            if transport is not None:
                transport.abort()

    async def _send(self, message: Message) -> None:
        if isinstance(message, str):
            await self._socket.send_str(message)
        else:
            await self._socket.send_bytes(message)
