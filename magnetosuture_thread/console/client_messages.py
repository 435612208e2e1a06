"""Messages of pages to the server: one JSON object each, validated field by field."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

from magnetosuture_thread.console.dead_man import Velocity
from magnetosuture_thread.errors import InvalidInputError

MAX_MESSAGE_CHARS = 4096
MAX_SHOWN_CHARS = 60  # of an invalid value in the error
ACTIONS = ("arm", "disarm", "stop", "reset")


class ClientMessage:
    """Base class of the messages.

    Attributes:
        TYPE: value of the field `type`.
    """

    TYPE: ClassVar[str]


@dataclass(frozen=True)
class Hello(ClientMessage):
    """First message of a page, with the token; empty for a page that only watches."""

    TYPE = "hello"
    token: str


@dataclass(frozen=True)
class Jog(ClientMessage):
    """Jog command while a direction is held.

    Attributes:
        velocity: commanded velocity [m/s].
        sent: time of sending by the page's clock [s].
    """

    TYPE = "jog"
    velocity: Velocity
    sent: float


@dataclass(frozen=True)
class EndJog(ClientMessage):
    """End of a jog: nothing is held any more."""

    TYPE = "end_jog"


@dataclass(frozen=True)
class Acknowledge(ClientMessage):
    """Receipt of a state or a camera frame; the next may be sent."""

    TYPE = "acknowledge"
    kind: str


@dataclass(frozen=True)
class Visibility(ClientMessage):
    """Whether the page is visible or hidden."""

    TYPE = "visibility"
    visible: bool


@dataclass(frozen=True)
class AcquireControl(ClientMessage):
    """Request for the control lease."""

    TYPE = "acquire_control"


@dataclass(frozen=True)
class ReleaseControl(ClientMessage):
    """Release of the control lease."""

    TYPE = "release_control"


@dataclass(frozen=True)
class BridgeAction(ClientMessage):
    """Request to the coil bridge: arm, disarm, stop or reset."""

    TYPE = "bridge_action"
    action: str


@dataclass(frozen=True)
class SelectSetup(ClientMessage):
    """Request to run another setup."""

    TYPE = "select_setup"
    setup: str


@dataclass(frozen=True)
class Pause(ClientMessage):
    """Request to pause or resume time."""

    TYPE = "pause"
    paused: bool


@dataclass(frozen=True)
class RecordBag(ClientMessage):
    """Request to start or end a recording."""

    TYPE = "record"
    recording: bool


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
    parse = _PARSERS.get(kind) if isinstance(kind, str) else None
    if parse is None:
        raise _refusal("type", kind, f"one of {', '.join(_PARSERS)}")
    return parse(fields, max_speed)


def _refusal(name: str, value: object, expectation: str) -> InvalidInputError:
    shown = value if isinstance(value, str) else repr(value)
    shown = shown if len(shown) <= MAX_SHOWN_CHARS else shown[:MAX_SHOWN_CHARS] + "…"
    return InvalidInputError(f"message.{name}", shown.encode("ascii", "backslashreplace").decode(), expectation)


def _object(text: str) -> dict[str, Any]:
    if len(text) > MAX_MESSAGE_CHARS:
        raise InvalidInputError("message", f"{len(text)} characters", f"at most {MAX_MESSAGE_CHARS}")

    def not_finite(name: str) -> NoReturn:
        raise InvalidInputError("message", name, "finite numbers")

    try:
        content = json.loads(text, parse_constant=not_finite)
    except (ValueError, RecursionError):
        raise InvalidInputError("message", "no JSON", "a JSON object") from None
    if not isinstance(content, dict):
        raise InvalidInputError("message", f"a {type(content).__name__}", "a JSON object")
    return content


def _finite(name: str, value: object) -> float:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:  # an integer beyond the range of floats
            number = math.inf
        if math.isfinite(number):
            return number
    raise _refusal(name, type(value).__name__ if isinstance(value, int) else value, "a finite number")


def _number(fields: dict[str, Any], name: str) -> float:
    return _finite(name, fields.get(name))


def _velocity(fields: dict[str, Any], max_speed: float) -> Velocity:
    direction, speed = fields.get("direction"), _number(fields, "speed")
    if not isinstance(direction, list) or len(direction) != 2:
        raise _refusal("direction", direction, "a list of two numbers")
    x, y = _finite("direction", direction[0]), _finite("direction", direction[1])
    if speed < 0.0:
        raise _refusal("speed", speed, "at least 0 m/s")
    largest = max(abs(x), abs(y), 1.0)  # avoids overflow of the squares
    x, y = x / largest, y / largest
    factor = min(speed, max_speed) / max(1.0, math.hypot(x, y))
    return x * factor, y * factor


def _text(fields: dict[str, Any], name: str) -> str:
    value = fields.get(name)
    if not isinstance(value, str):
        raise _refusal(name, value, "a text")
    return value


def _choice(fields: dict[str, Any], name: str, choices: tuple[str, ...]) -> str:
    value = fields.get(name)
    if not isinstance(value, str) or value not in choices:
        raise _refusal(name, value, "one of " + ", ".join(choices))
    return value


def _switch(fields: dict[str, Any], name: str) -> bool:
    value = fields.get(name)
    if not isinstance(value, bool):
        raise _refusal(name, value, "true or false")
    return value


_PARSERS: dict[str, Callable[[dict[str, Any], float], ClientMessage]] = {
    Hello.TYPE: lambda fields, _: Hello(_text(fields, "token")),
    Jog.TYPE: lambda fields, max_speed: Jog(_velocity(fields, max_speed), _number(fields, "sent")),
    EndJog.TYPE: lambda *_: EndJog(),
    Acknowledge.TYPE: lambda fields, _: Acknowledge(_choice(fields, "kind", ("state", "frame"))),
    Visibility.TYPE: lambda fields, _: Visibility(_switch(fields, "visible")),
    AcquireControl.TYPE: lambda *_: AcquireControl(),
    ReleaseControl.TYPE: lambda *_: ReleaseControl(),
    BridgeAction.TYPE: lambda fields, _: BridgeAction(_choice(fields, "action", ACTIONS)),
    SelectSetup.TYPE: lambda fields, _: SelectSetup(_text(fields, "setup")),
    Pause.TYPE: lambda fields, _: Pause(_switch(fields, "paused")),
    RecordBag.TYPE: lambda fields, _: RecordBag(_switch(fields, "recording")),
}
