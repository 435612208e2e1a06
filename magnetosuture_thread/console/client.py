"""Connection of one page: its messages, validated field by field, their execution, and what is sent to it."""

from __future__ import annotations

import asyncio
import json
import math
import struct
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn, Protocol

from aiohttp import WSMsgType, web

from magnetosuture_thread.console.jog_controller import DelayEstimator, JogController
from magnetosuture_thread.console.settings import ConsoleSettings, RateCounter, same_token
from magnetosuture_thread.settings.configuration import Quantity
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError, MagnetosutureError
from magnetosuture_thread.settings.interface import PRESS_TIMEOUT, STARTS

HELLO_TIMEOUT = 5.0  # after the connection [s]
MAX_MESSAGE_RATE = 400  # per second; beyond, only an emergency stop is accepted
MAX_PENDING_REQUESTS = 4  # of one page, besides those of `UNLEASED`
MAX_UNACKNOWLEDGED = 2  # states in flight, and frames
# Allowed for every page with the token, with or without control.
UNLEASED = ("stop", "disarm", "cancel", "pause procedure", "abort procedure")
HELD = ("jog", "hold")  # messages that are repeated while something is held

Message = str | bytes
Reply = Callable[[str, str], None]


Field = tuple[type, Quantity]
_TEXT, _SWITCH, _NUMBER = (str, Quantity("")), (bool, Quantity("")), (float, Quantity(""))  # the last also a time
_PAIR = (tuple, Quantity("", multiple=2))


def _one_of(*choices: str) -> Field:
    return str, Quantity("", choices=choices)


# What each type of message holds, besides `sent`: when it was sent, or the button for it pressed, by the page's clock
# [s]. In a greeting, `token` is empty for a page that only watches, and `automated` tells whether a script drives the
# browser, null for no browser. `hold` is sent while the page is held so that a procedure may go on; `acknowledge` is
# the receipt of a state or frame.
FIELDS: dict[str, dict[str, Field]] = {
    "hello": {"token": _TEXT, "automated": _SWITCH},
    "jog": {"speed": (float, Quantity("", "m/s", minimum=0.0)), "direction": _PAIR},
    "end_jog": {},
    "acknowledge": {"kind": _one_of("state", "frame")},
    "visibility": {"visible": _SWITCH},
    "acquire_control": {},
    "release_control": {},
    "bridge_action": {"action": _one_of("arm", "disarm", "stop", "reset")},
    "select_setup": {"setup": _TEXT},
    "pause": {"paused": _SWITCH},
    "record": {"recording": _SWITCH},
    "procedure": {"action": _one_of("plan", "resume", "pause", "abort"), "procedure": _TEXT, "hold_to_run": _SWITCH},
    "hold": {},
    "tip": {"position": (tuple, Quantity("", "m", multiple=2))},
    "measure": {"action": _one_of("teach", "commission", "cancel"), "marks": (tuple, Quantity("", "px", multiple=4))},
}


@dataclass(frozen=True)
class ClientMessage:
    """A valid message.

    Attributes:
        type: one of `FIELDS`.
        values: of its fields by name; of a jog, `velocity` [m/s] in place of direction and speed.
        sent: when, by the page's clock [s]; None where it does not say, as only what starts something has to.
    """

    type: str
    values: Mapping[str, Any] = field(default_factory=dict)
    sent: float | None = None

    @property
    def request(self) -> str:
        """Name under which the answer is reported."""
        if self.type == "procedure":
            return f"{self.values['action']} procedure"
        return str(self.values["action"]) if self.type in ("bridge_action", "measure") else self.type

    @property
    def starts(self) -> bool:
        """Whether it may let the needle move, and must not come late."""
        return self.type in HELD or self.values.get("action") in STARTS


def parse_client_message(text: str, max_speed: float) -> ClientMessage:
    """Parse and validate a message of a page.

        velocity = direction / max(1, |direction|) * min(speed, max_speed)

    Args:
        text: a JSON object with `type` and that type's fields.
        max_speed: maximum speed of a jog [m/s].

    Raises:
        InvalidInputError: the message is invalid, or a number is not finite.
    """
    fields = _object(text)
    kind = fields.pop("type", None)
    if not isinstance(kind, str) or kind not in FIELDS:
        raise _refusal("type", kind, f"one of {', '.join(FIELDS)}")
    values = {name: _checked(name, fields.get(name), *field) for name, field in FIELDS[kind].items()}
    if kind == "measure" and (len(values["marks"]) != 4) == (values["action"] == "teach"):
        raise _refusal("marks", list(values["marks"]), "u, v of tail and tip to teach, else none")
    for name in values.keys() & {"direction", "position"}:
        if len(values[name]) != 2:
            raise _refusal(name, list(values[name]), "a list of two numbers")
    if kind == "jog":
        direction, speed = values.pop("direction"), values.pop("speed")
        largest = max(abs(direction[0]), abs(direction[1]), 1.0)  # avoids overflow of the squares
        x, y = direction[0] / largest, direction[1] / largest
        factor = min(speed, max_speed) / max(1.0, math.hypot(x, y))
        values["velocity"] = (x * factor, y * factor)
    message = ClientMessage(kind, values)
    try:
        return replace(message, sent=_checked("sent", fields.get("sent"), *_NUMBER))
    except InvalidInputError:
        if message.starts:
            raise
        return message


def _checked(name: str, value: Any, kind: type, quantity: Quantity) -> Any:
    if name == "automated" and value is None:
        return None
    try:
        return quantity.checked(name, value, kind)
    except ConfigurationError as error:
        raise _refusal(name, value, error.expectation) from None


def _refusal(name: str, value: object, expectation: str) -> InvalidInputError:
    """Return the error of a value, shown in ASCII and shortened: a whole number may have thousands of digits."""
    shown = value if isinstance(value, str) else type(value).__name__ if isinstance(value, int) else repr(value)
    shown = shown if len(shown) <= 60 else shown[:60] + "…"
    return InvalidInputError(f"message.{name}", shown.encode("ascii", "backslashreplace").decode(), expectation)


def _object(text: str) -> dict[str, Any]:
    if len(text) > 4096:
        raise InvalidInputError("message", f"{len(text)} characters", "at most 4096")

    def not_finite(name: str) -> NoReturn:
        raise InvalidInputError("message", name, "finite numbers")

    try:
        content = json.loads(text, parse_constant=not_finite)
    except (ValueError, RecursionError):
        raise InvalidInputError("message", "no JSON", "a JSON object") from None
    if not isinstance(content, dict):
        raise InvalidInputError("message", f"a {type(content).__name__}", "a JSON object")
    return content


class Graph(Protocol):
    """Interface to a running graph. All calls come from the thread of one asyncio loop.

    `state` returns, in SI units and plain JSON types, where every part is None until its first message:

        {
          "time": float,                   # the graph's time [s]
          "needle_length": float, "needle_curvature": float,   # of the console's settings
          "scene": {"version": str, "dish_diameter": m, "dish_depth": m,
                    "shapes": [{"name": str, "kind": "tissue|instrument|wall", "label": [x, y],   # position of its name
                                "disc": [x, y, r]}   # or, in place of the disc,
                               | {..., "outline": [[x, y], ...], "holes": [[[x, y], ...], ...]}]} | None,
          "needle": {"tail": [x, y], "heading": rad, "age": s} | None,
          "axis": the same | None,         # in place of the needle, where nothing tells which end is the tip
          "camera": {"age": s} | None,     # of the latest image
          "tracker": {"state": "tracked|lost|searching", "reason": str, "confidence": float,
                      "view": {"centre": [u, v], "scale": m_per_px, "rotation": rad} | None, "age": s} | None,
          "measured": [[x, y], ...],       # the measured centreline, may be empty
          "predicted": {"vertices": [[x, y], ...], "residual": float, "step_time": s, "status": str, "age": s} | None,
          "estimated": {"vertices": [[x, y], ...], "deviation": [m, ...],   # of each vertex across the thread
                        "prediction_only": bool, "unmeasured_for": s, "hidden": share,
                        "disturbances": [{"position": [x, y], "direction": [x, y], "force": N, "text": str}, ...],
                        "age": s} | None,
          "forecast": {"horizon": s,        # along the plan, or while the present command is held
                       "ghosts": [{"time": s, "vertices": [[x, y], ...]}, ...],   # the thread, last at the horizon
                       "events": [str],     # what happens when
                       "problem": str,      # why it ends early, empty if it does not
                       "age": s} | None,
          "margins": {"valid": bool, "of": "estimate|prediction|nothing", "reason": str,
                      "clearance": [float | None, ...],   # of each node, minimum over wall and shapes; None: none near
                      "least": {"connectivity": m, "compression": m, "obstacle": m, ...},   # of the kinds present
                      "bound": m | None,   # least of the 99 % bounds of all clearances
                      "contact": [node, ...],
                      "friction": {"state": "unknown|free|pulled|resting", "nodes": [int], "slowdown": float}} | None,
          "filter": {"source": "operator|needle|", "commanded": [vx, vy], "filtered": [vx, vy], "applied": [vx, vy],
                     "slowdown": float, "active": [str], "overridden": str, "reason": str, "age": s} | None,
          "bridge": {"state": "unconfigured|inactive|active|fault", "armed": bool, "emergency_stopped": bool,
                     "reasons": [str], "commanded": [vx, vy], "filtered": [vx, vy], "applied": [vx, vy],
                     "saturated": bool, "driver": str, "driver_ready": bool, "driver_warnings": [str], "current": [A],
                     "measured_current": [A], "refused": int, "age": s} | None,
          "procedure": {"state": "idle|ready|running|paused|done|failed", "name": str, "goals": [str], "goal": int,
                        "goals_met": int, "progress": share, "reason": str, "resumes": bool, "hold_to_run": bool,
                        "clearance": m | None} | None,   # None where no needle planner runs
          "plan": [[x, y], ...],           # where the middle of the needle is to go, may be empty
          "procedures": [str],             # names of those whose shapes the scene has
          "nodes": {name: {"level": "ok|warn|error|silent", "message": str, "values": {str: str}, "age": s}},
        }
    """

    def publish_velocity(self, velocity: tuple[float, float]) -> None:
        """Publish an operator velocity command, stamped now.

        Args:
            velocity: of the needle's tip in the dish plane [m/s].
        """

    async def execute_action(self, action: str) -> str:
        """Execute arm, disarm, stop or reset; return an empty text, or the reason of a refusal."""

    async def point_at_tip(self, position: tuple[float, float]) -> str:
        """Tell the tracker of a point near the needle's tip [m]; return an empty text, or the reason of a refusal."""

    def publish_hold(self) -> None:
        """Publish that the page is held, so that a procedure may go on."""

    async def execute_procedure(self, action: str, procedure: str, hold_to_run: bool) -> str:
        """Plan, resume, pause or abort a procedure; return an empty text, or the reason of a refusal."""

    def state(self) -> dict[str, Any]:
        """Return the present state as a new dictionary; fast enough for 30 calls a second."""

    def frame(self) -> tuple[int, bytes] | None:
        """Return number and JPEG or PNG bytes of the latest camera frame; the number increases."""


class Host(Protocol):
    """Interface to the host of the graph, which may offer setups, pause and recording.

    `state` returns

        {"mode": "simulated|graph|replay", "setup": str, "setups": [str], "can_pause": bool, "paused": bool,
         "can_record": bool, "can_measure": bool,
         "measurement": {"name": "teach|commission", "state": "running|done|failed",   # the last one
                         "lines": [str],   # the latest that it printed
                         "picture": str} | None,   # its name, empty without one
         "recording": str,   # the path, empty if nothing is recorded
         "busy": str,        # operation in progress, empty if none
         "simulated": bool}
    """

    def state(self) -> dict[str, Any]:
        """Return what is running and which requests are possible."""

    async def select_setup(self, setup: str) -> str:
        """Run another setup; return an empty text, or the reason of a refusal."""

    async def set_paused(self, paused: bool) -> str:
        """Pause or resume time; return an empty text, or the reason of a refusal."""

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Start or end a recording; return an empty text, or the reason of a refusal.

        Args:
            recording: whether to start.
            operator: who commands the page that has control, "an operator" or "a script"; noted in the recording.
        """

    async def measure(self, action: str, marks: tuple[float, ...]) -> str:
        """Begin a measurement; return an empty text, or the reason of a refusal.

        Args:
            action: "teach" the tracker how the needle looks, or "commission" the rig.
            marks: of the former the needle's tail and tip in the camera's frame, u, v, u, v [px]; else empty.
        """

    def cancel(self) -> None:
        """End the measurement that runs, if there is one."""

    def picture(self) -> bytes:
        """Return the picture of the last measurement, a PNG file; empty if there is none."""


class Outbox:
    """Queue of the messages to one page: replies in order, of states and camera frames only the latest.

    A page acknowledges each state and frame. At most `MAX_UNACKNOWLEDGED` of a kind are in flight, so a slow page
    receives fewer of them, and none of them late.

    Attributes:
        changed: set whenever there may be another message to send.
    """

    def __init__(self) -> None:
        self.changed = asyncio.Event()
        self._replies: deque[str] = deque(maxlen=64)
        self._latest: dict[str, Message] = {}
        self._in_flight = {"state": 0, "frame": 0}

    def reply(self, text: str) -> None:
        """Queue a reply; the oldest of too many is dropped."""
        self._replies.append(text)
        self.changed.set()

    def put(self, kind: str, message: Message) -> None:
        """Set the latest `state` or `frame`; it replaces one that was not sent."""
        self._latest[kind] = message
        self.changed.set()

    def acknowledge(self, kind: str) -> bool:
        """Register that the page received a `state` or `frame`; return whether one was in flight."""
        was_in_flight = self._in_flight[kind] > 0
        self._in_flight[kind] -= was_in_flight
        self.changed.set()
        return was_in_flight

    def next(self) -> Message | None:
        """Return the next message to send, None while there is none or the page is behind."""
        if self._replies:
            return self._replies.popleft()
        for kind in ("state", "frame"):
            if kind in self._latest and self._in_flight[kind] < MAX_UNACKNOWLEDGED:
                self._in_flight[kind] += 1
                return self._latest.pop(kind)
        return None


def encode_state(graph: dict[str, Any], host: dict[str, Any], lease: dict[str, Any]) -> str:
    """Encode the state of graph, host and lease as JSON; numbers that are not finite become null."""
    state = {"type": "state", "graph": graph, "host": host, "lease": lease}
    try:
        return json.dumps(state, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return json.dumps(json.loads(json.dumps(state), parse_constant=lambda name: None), separators=(",", ":"))


def encode_frame(number: int, image: bytes) -> bytes:
    """Encode a camera frame: its number in 8 bytes, big endian, then the image."""
    return struct.pack(">Q", number) + image


class RequestHandler:
    """Executes requests of pages as asyncio tasks.

    Args:
        graph: the running graph.
        host: of the graph.
        jog: knows which page has control.

    Attributes:
        jog: as given.
        hold: called while a page is held for a procedure.
    """

    def __init__(self, graph: Graph, host: Host, jog: JogController) -> None:
        self.jog, self.hold, self._graph, self._host = jog, graph.publish_hold, graph, host
        self._pending: dict[asyncio.Task[None], int] = {}
        self._calls: dict[str, Callable[..., Awaitable[str]]] = {  # with the fields of the message
            "bridge_action": self._switch,
            "tip": graph.point_at_tip,
            "procedure": graph.execute_procedure,
            "select_setup": host.select_setup,
            "pause": host.set_paused,
            "record": host.set_recording,
            "measure": self._measure,
        }

    def start(self, client: int, message: ClientMessage, operator: str, reply: Reply) -> None:
        """Start a request of a page with the token.

        Args:
            client: its number.
            message: the request.
            operator: who commands the page, as recordings note it.
            reply: called with the request's name and the refusal, empty on success.

        Raises:
            InvalidInputError: the request needs control, or too many are pending.
        """
        name, unleased = message.request, message.request in UNLEASED
        if not unleased and client != self.jog.holder:
            raise InvalidInputError(name, "a page without control", "one with control: take control first")
        if not unleased and list(self._pending.values()).count(client) >= MAX_PENDING_REQUESTS:
            raise InvalidInputError(name, f"{MAX_PENDING_REQUESTS} pending requests", "a reply to one of them first")
        if name not in ("record", "arm"):  # which end no jog
            self.jog.stop()
        task = asyncio.create_task(self._execute(message, operator, reply))
        self._pending[task] = client
        task.add_done_callback(lambda done: self._pending.pop(done, None))

    def release(self, client: int) -> None:
        """Release control; what a page has let the rig measure ends with that."""
        if client == self.jog.holder:
            self._host.cancel()
        self.jog.release_control(client)

    async def close(self) -> None:
        """Cancel pending requests."""
        for task in (tasks := list(self._pending)):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _switch(self, action: str) -> str:
        """Switch the bridge; what stops or disarms it ends a measurement, which would arm it again."""
        if action in ("stop", "disarm"):
            self._host.cancel()
        return await self._graph.execute_action(action)

    async def _measure(self, action: str, marks: tuple[float, ...]) -> str:
        return await (self._switch("disarm") if action == "cancel" else self._host.measure(action, marks))

    async def _execute(self, message: ClientMessage, operator: str, reply: Reply) -> None:
        try:
            others = {"operator": operator} if message.type == "record" else {}
            refusal = await self._calls[message.type](**message.values, **others)
        except MagnetosutureError as error:
            refusal = str(error)
        reply(message.request, refusal)


class Client:
    """Server side of a connected page.

    Args:
        number: of the connection, from 1.
        socket: the prepared WebSocket.
        request: of the connection.
        settings: of the console; its token permits commands.
        requests: handler of all requests but jogs; its `jog` has the control lease and the jog commands.

    Attributes:
        address: of the page's computer.
        outbox: messages to it.
        has_token: whether it has shown the token, with the connection or in its greeting.
        is_script: whether a program commands it, and no person.
    """

    def __init__(
        self,
        number: int,
        socket: web.WebSocketResponse,
        request: web.BaseRequest,
        settings: ConsoleSettings,
        requests: RequestHandler,
    ) -> None:
        self.number, self.address, self.has_token = number, request.remote or "", False
        self.is_script = True
        self._socket, self._request, self._settings = socket, request, settings
        self._jog, self._requests = requests.jog, requests
        self.outbox = Outbox()
        self._delay, self._last_in_time = DelayEstimator(), 0.0  # arrival of the last message that was not late
        self._rate, self._message_count, self._excess = RateCounter(), 0, 0

    async def serve(self) -> None:
        """Handle messages until the page disconnects; the bridge is disarmed then if the page had control."""
        if not await self._handshake():
            return
        sending = asyncio.create_task(self._send_all())
        try:
            receive = self._on_message if self.has_token else self._on_watcher_message
            async for message in self._socket:
                if message.type in (WSMsgType.PING, WSMsgType.PONG):
                    await self._on_ping(message.type, message.data)
                else:
                    await receive(message.type, message.data)
        finally:
            if self._jog.holder == self.number:
                self._requests.release(self.number)
                # Nobody is there who would see what the needle does.
                disarm = ClientMessage("bridge_action", {"action": "disarm"})
                self._requests.start(self.number, disarm, "nobody", lambda name, refusal: None)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)

    async def close(self) -> None:
        """Close the connection when the server stops."""
        await self._socket.close(code=1001, message=b"the server stops")

    async def _handshake(self) -> bool:
        try:
            message = await self._socket.receive(timeout=HELLO_TIMEOUT)
            parsed = self._read(message.type, message.data)
        except (asyncio.TimeoutError, InvalidInputError):
            parsed = None
        if parsed is None or parsed.type != "hello":
            await self._socket.close(code=1008, message=b"expected hello first")
            return False
        self._lateness(parsed, asyncio.get_running_loop().time())
        self.has_token = same_token(token := parsed.values["token"], self._settings.token)
        # Programs other than browsers name no origin.
        self.is_script = parsed.values["automated"] is not False or not self._request.headers.get("Origin")
        refusal = "the token is wrong" if token and not self.has_token else ""
        speeds = {"speed": self._settings.speed, "max_speed": self._settings.max_speed}
        self._reply("welcome", client=self.number, can_command=self.has_token, refusal=refusal, **speeds)
        return True

    def _read(self, kind: WSMsgType, data: Any) -> ClientMessage:
        if kind is not WSMsgType.TEXT:
            raise InvalidInputError("message", kind.name.lower(), "text")
        return parse_client_message(data, self._settings.max_speed)

    async def _on_ping(self, kind: WSMsgType, data: bytes) -> None:
        """Answer a ping, and count it like any message: no page sends one, but other programs may."""
        if self._count_message(asyncio.get_running_loop().time()):
            self._abort()
        elif kind is WSMsgType.PING:
            with suppress(ConnectionError):
                await self._socket.pong(data)

    async def _on_message(self, kind: WSMsgType, data: Any) -> None:
        now = asyncio.get_running_loop().time()
        self._jog.lease.keep_alive(self.number, now)
        try:
            exceeded = self._count_message(now)
            parsed = self._read(kind, data)
            late = self._lateness(parsed, now)
            if exceeded and parsed.request != "stop":
                raise InvalidInputError("messages", f"{self._message_count} in a second", f"at most {MAX_MESSAGE_RATE}")
            if parsed.type == "acknowledge":
                self.outbox.acknowledge(parsed.values["kind"])
            else:
                await self._dispatch(parsed, late, now)
        except InvalidInputError as error:
            self._jog.interrupt(self.number)
            self._reply("error", text=str(error))
            if self._excess > 2000:  # in total
                await self._socket.close(code=1008, message=b"too many messages")

    async def _on_watcher_message(self, kind: WSMsgType, data: Any) -> None:
        """Handle a message of a page without the token: receipts count, all else is not even parsed."""
        text = data[:100] if kind is WSMsgType.TEXT else ""
        if '"acknowledge"' in text and self.outbox.acknowledge("frame" if '"frame"' in text else "state"):
            return
        if self._count_message(asyncio.get_running_loop().time()):
            self._abort()  # at once, without the formalities of closing
        elif '"visibility"' not in text:
            expected = "the one in the console's address: this page only watches"
            self._reply("error", text=str(InvalidInputError("token", "none", expected)))

    async def _dispatch(self, message: ClientMessage, late: str, now: float) -> None:
        values, jog = message.values, self._jog
        match message.type:
            case "jog" if late:
                jog.interrupt(self.number)
                if now - self._last_in_time > 1.0:  # s; it must reconnect
                    await self._socket.close(code=1008, message=b"all messages are late")
            case "jog":
                if not jog.jog(self.number, values["velocity"]):
                    self._reply("error", text="jog: this page does not have control; take control first")
            case "hold":
                if not late and jog.holder == self.number:
                    self._requests.hold()
            case "end_jog":
                jog.end_jog(self.number)
            case "acquire_control":
                self._report(message.type, jog.acquire_control(self.number))
            case "release_control":
                self._requests.release(self.number)
            case "visibility":
                jog.set_visible(self.number, values["visible"])
            case _ if late:
                self._report(message.request, late)
            case request if request != "hello":
                operator = "a script" if self.is_script else "an operator"
                self._requests.start(self.number, message, operator, self._report)

    def _lateness(self, message: ClientMessage, now: float) -> str:
        """Return why a message comes too late to start anything, empty if it does not; of one of a hold, report it."""
        if message.sent is None:
            return ""
        delay, timeout = self._delay.update(message.sent, now), self._settings.hold_timeout
        if delay <= timeout:
            self._last_in_time = now
        is_held = message.type in HELD
        limit = timeout if is_held else PRESS_TIMEOUT
        if delay <= limit or not message.starts:
            return ""
        late = f"computer or network {delay:.2f} s late, expected at most {limit:g} s"
        if is_held:
            self._reply("error", text=f"jog: {late}", delay=delay)
        return late

    def _count_message(self, now: float) -> bool:
        """Count a message; return whether it exceeds the maximum rate."""
        self._message_count = self._rate.count(self.address, now)
        # A page without the token is disconnected beyond 20 a second, besides receipts.
        exceeded = self._message_count > (MAX_MESSAGE_RATE if self.has_token else 20)
        self._excess += exceeded
        return exceeded

    def _report(self, request: str, refusal: str) -> None:
        self._reply("result", request=request, refusal=refusal)

    def _reply(self, kind: str, **fields: Any) -> None:
        self.outbox.reply(json.dumps({"type": kind, **fields}))

    async def _send_all(self) -> None:
        try:
            while True:
                await self.outbox.changed.wait()
                self.outbox.changed.clear()
                while (message := self.outbox.next()) is not None:
                    socket = self._socket
                    sent = socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message)
                    await asyncio.wait_for(sent, 2.0)  # s; else it does not receive
        except (asyncio.TimeoutError, ConnectionError):
            self._abort()

    def _abort(self) -> None:
        transport = self._request.transport
        if transport is not None:
            transport.abort()
