"""Messages of pages to the server: one JSON object each, validated field by field."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn

from magnetosuture_thread.configuration import Quantity
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError

MAX_MESSAGE_CHARS = 4096

Field = tuple[type, Quantity]
_TEXT, _SWITCH, _NUMBER = (str, Quantity("")), (bool, Quantity("")), (float, Quantity(""))


def _one_of(*choices: str) -> Field:
    return str, Quantity("", choices=choices)


# What each type of message holds. `sent` is the time of sending by the page's clock [s]. In a greeting, `token` is
# empty for a page that only watches, and `automated` tells whether a script drives the browser, null for no browser.
# `hold` is sent while the page is held so that a procedure may go on; `acknowledge` is the receipt of a state or frame.
FIELDS: dict[str, dict[str, Field]] = {
    "hello": {"token": _TEXT, "automated": _SWITCH},
    "jog": {
        "speed": (float, Quantity("", "m/s", minimum=0.0)),
        "direction": (tuple, Quantity("", multiple=2)),
        "sent": _NUMBER,
    },
    "end_jog": {},
    "acknowledge": {"kind": _one_of("state", "frame")},
    "visibility": {"visible": _SWITCH},
    "acquire_control": {},
    "release_control": {},
    "bridge_action": {"action": _one_of("arm", "disarm", "stop", "reset")},
    "select_setup": {"setup": _TEXT},
    "pause": {"paused": _SWITCH},
    "record": {"recording": _SWITCH},
    "procedure": {
        "action": _one_of("plan", "resume", "pause", "abort"),
        "procedure": _TEXT,
        "hold_to_run": _SWITCH,
    },
    "hold": {"sent": _NUMBER},
}


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
    values = {name: _checked(name, fields.get(name), *about) for name, about in FIELDS[kind].items()}
    if kind == "jog":
        direction, speed = values.pop("direction"), values.pop("speed")
        if len(direction) != 2:
            raise _refusal("direction", list(direction), "a list of two numbers")
        largest = max(abs(direction[0]), abs(direction[1]), 1.0)  # avoids overflow of the squares
        x, y = direction[0] / largest, direction[1] / largest
        factor = min(speed, max_speed) / max(1.0, math.hypot(x, y))
        values["velocity"] = (x * factor, y * factor)
    return ClientMessage(kind, values)


def _checked(name: str, value: Any, kind: type, about: Quantity) -> Any:
    if name == "automated" and value is None:
        return None
    try:
        return about.checked(name, value, kind)
    except ConfigurationError as error:
        raise _refusal(name, value, error.expectation) from None


def _refusal(name: str, value: object, expectation: str) -> InvalidInputError:
    """Return the error of a value, shown in ASCII and shortened: a whole number may have thousands of digits."""
    shown = value if isinstance(value, str) else type(value).__name__ if isinstance(value, int) else repr(value)
    shown = shown if len(shown) <= 60 else shown[:60] + "…"
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
