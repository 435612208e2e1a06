"""Messages of pages to the server: one JSON object each, validated field by field."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from dataclasses import fields as dataclass_fields
from typing import Any, ClassVar, NoReturn, cast

from magnetosuture_thread.console.jog_controller import Velocity
from magnetosuture_thread.errors import InvalidInputError

MAX_MESSAGE_CHARS = 4096
MAX_SHOWN_CHARS = 60  # of an invalid value in the error


def _text() -> Any:
    return field(metadata={"valid": lambda value: isinstance(value, str), "expected": "a text"})


def _switch() -> Any:
    return field(metadata={"valid": lambda value: isinstance(value, bool), "expected": "true or false"})


def _choice(*choices: str) -> Any:
    return field(metadata={"valid": lambda value: value in choices, "expected": "one of " + ", ".join(choices)})


class ClientMessage:
    """Base class of the messages.

    Attributes:
        TYPE: value of the field `type`.
    """

    TYPE: ClassVar[str]

    @classmethod
    def parse(cls, fields: dict[str, Any], max_speed: float) -> ClientMessage:
        """Return the message of these fields; see `parse_client_message`."""
        values = {own.name: (fields.get(own.name), own.metadata) for own in dataclass_fields(cast(Any, cls))}
        for name, (value, metadata) in values.items():
            if not metadata["valid"](value):
                raise _refusal(name, value, metadata["expected"])
        return cls(**{name: value for name, (value, _) in values.items()})


@dataclass(frozen=True)
class Hello(ClientMessage):
    """First message of a page.

    Attributes:
        token: empty for a page that only watches.
        automated: whether a script drives the browser, as this says of itself; None if it is no browser.
    """

    TYPE = "hello"
    token: str = _text()
    automated: bool | None = field(
        default=None,
        metadata={"valid": lambda value: value is None or isinstance(value, bool), "expected": "true, false or null"},
    )


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

    @classmethod
    def parse(cls, fields: dict[str, Any], max_speed: float) -> Jog:
        """Return the message of these fields; see `parse_client_message`."""
        return cls(_velocity(fields, max_speed), _finite("sent", fields.get("sent")))


@dataclass(frozen=True)
class EndJog(ClientMessage):
    """End of a jog: nothing is held any more."""

    TYPE = "end_jog"


@dataclass(frozen=True)
class Acknowledge(ClientMessage):
    """Receipt of a state or a camera frame; the next may be sent."""

    TYPE = "acknowledge"
    kind: str = _choice("state", "frame")


@dataclass(frozen=True)
class Visibility(ClientMessage):
    """Whether the page is visible or hidden."""

    TYPE = "visibility"
    visible: bool = _switch()


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
    action: str = _choice("arm", "disarm", "stop", "reset")


@dataclass(frozen=True)
class SelectSetup(ClientMessage):
    """Request to run another setup."""

    TYPE = "select_setup"
    setup: str = _text()


@dataclass(frozen=True)
class Pause(ClientMessage):
    """Request to pause or resume time."""

    TYPE = "pause"
    paused: bool = _switch()


@dataclass(frozen=True)
class RecordBag(ClientMessage):
    """Request to start or end a recording."""

    TYPE = "record"
    recording: bool = _switch()


@dataclass(frozen=True)
class ProcedureRequest(ClientMessage):
    """Request to the needle planner: plan a procedure, begin or resume it, pause it, or give it up.

    Attributes:
        action: what is requested.
        procedure: its name, for a plan; empty else.
        hold_to_run: for a plan, whether the needle moves only while the page is held.
    """

    TYPE = "procedure"
    action: str = _choice("plan", "resume", "pause", "abort")
    procedure: str = _text()
    hold_to_run: bool = _switch()


@dataclass(frozen=True)
class HoldProcedure(ClientMessage):
    """The page is held, so that the needle may go on.

    Attributes:
        sent: time of sending by the page's clock [s].
    """

    TYPE = "hold"
    sent: float

    @classmethod
    def parse(cls, fields: dict[str, Any], max_speed: float) -> HoldProcedure:
        """Return the message of these fields; see `parse_client_message`."""
        return cls(_finite("sent", fields.get("sent")))


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
    if not isinstance(kind, str) or kind not in _TYPES:
        raise _refusal("type", kind, f"one of {', '.join(_TYPES)}")
    return _TYPES[kind].parse(fields, max_speed)


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


def _velocity(fields: dict[str, Any], max_speed: float) -> Velocity:
    direction, speed = fields.get("direction"), _finite("speed", fields.get("speed"))
    if not isinstance(direction, list) or len(direction) != 2:
        raise _refusal("direction", direction, "a list of two numbers")
    x, y = _finite("direction", direction[0]), _finite("direction", direction[1])
    if speed < 0.0:
        raise _refusal("speed", speed, "at least 0 m/s")
    largest = max(abs(x), abs(y), 1.0)  # avoids overflow of the squares
    x, y = x / largest, y / largest
    factor = min(speed, max_speed) / max(1.0, math.hypot(x, y))
    return x * factor, y * factor


_TYPES: dict[str, type[ClientMessage]] = {kind.TYPE: kind for kind in ClientMessage.__subclasses__()}
