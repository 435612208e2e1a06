"""Messages of pages to the server: one JSON object each, validated field by field."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn

from magnetosuture_thread.errors import InvalidInputError

MAX_MESSAGE_CHARS = 4096
MAX_SHOWN_CHARS = 60  # of an invalid value in the error


@dataclass(frozen=True)
class ClientMessage:
    """A valid message.

    Attributes:
        type: one of `FIELDS`.
        values: of its fields by name; of a jog, `velocity` [m/s] in place of direction and speed.
    """

    type: str
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def request(self) -> str:
        """Name under which the answer is reported."""
        if self.type == "procedure":
            return f"{self.values['action']} procedure"
        return str(self.values["action"]) if self.type == "bridge_action" else self.type


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
    values = {name: read(name, fields.get(name)) for name, read in FIELDS[kind].items()}
    if kind == "jog":
        (x, y), speed = values.pop("direction"), values.pop("speed")
        largest = max(abs(x), abs(y), 1.0)  # avoids overflow of the squares
        x, y = x / largest, y / largest
        factor = min(speed, max_speed) / max(1.0, math.hypot(x, y))
        values["velocity"] = (x * factor, y * factor)
    return ClientMessage(kind, values)


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


def _of_type(kind: type, expectation: str) -> Callable[[str, Any], Any]:
    def read(name: str, value: Any) -> Any:
        if not isinstance(value, kind):
            raise _refusal(name, value, expectation)
        return value

    return read


def _choice(*choices: Any) -> Callable[[str, Any], Any]:
    def read(name: str, value: Any) -> Any:
        if not any(value is choice or (isinstance(value, str) and value == choice) for choice in choices):
            raise _refusal(name, value, "one of " + ", ".join(json.dumps(choice).strip('"') for choice in choices))
        return value

    return read


def _finite(name: str, value: Any) -> float:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:  # an integer beyond the range of floats
            number = math.inf
        if math.isfinite(number):
            return number
    raise _refusal(name, type(value).__name__ if isinstance(value, int) else value, "a finite number")


def _speed(name: str, value: Any) -> float:
    speed = _finite(name, value)
    if speed < 0.0:
        raise _refusal(name, speed, "at least 0 m/s")
    return speed


def _direction(name: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise _refusal(name, value, "a list of two numbers")
    return _finite(name, value[0]), _finite(name, value[1])


_text, _switch = _of_type(str, "a text"), _of_type(bool, "true or false")

# What each type of message holds. `sent` is the time of sending by the page's clock [s]. In a greeting, `token` is
# empty for a page that only watches, and `automated` tells whether a script drives the browser, null for no browser.
# `hold` is sent while the page is held so that a procedure may go on; `acknowledge` is the receipt of a state or frame.
FIELDS: dict[str, dict[str, Callable[[str, Any], Any]]] = {
    "hello": {"token": _text, "automated": _choice(True, False, None)},
    "jog": {"speed": _speed, "direction": _direction, "sent": _finite},
    "end_jog": {},
    "acknowledge": {"kind": _choice("state", "frame")},
    "visibility": {"visible": _switch},
    "acquire_control": {},
    "release_control": {},
    "bridge_action": {"action": _choice("arm", "disarm", "stop", "reset")},
    "select_setup": {"setup": _text},
    "pause": {"paused": _switch},
    "record": {"recording": _switch},
    "procedure": {
        "action": _choice("plan", "resume", "pause", "abort"),
        "procedure": _text,
        "hold_to_run": _switch,
    },
    "hold": {"sent": _finite},
}
