"""What a page may say: one JSON object a message, checked field by field before anything is done with it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, NoReturn

from magnetosuture_thread.console.dead_man import Velocity
from magnetosuture_thread.errors import InvalidInputError

LONGEST = 4096  # characters of a message
ACTIONS = ("arm", "disarm", "stop", "reset")
SHOWN = 60  # characters of a refused value in the refusal


@dataclass(frozen=True)
class Hello:
    """The first message: the token, empty from somebody who only watches."""

    token: str


@dataclass(frozen=True)
class Hold:
    """A direction and a speed are held.

    Attributes:
        velocity: that is asked for [m/s].
        sent: when, by the page's clock [s].
    """

    velocity: Velocity
    sent: float


@dataclass(frozen=True)
class Release:
    """Nothing is held any more."""


@dataclass(frozen=True)
class Got:
    """A state or a camera frame has arrived; another may come."""

    what: str


@dataclass(frozen=True)
class Visible:
    """The page is seen, or hidden behind another tab."""

    seen: bool


@dataclass(frozen=True)
class Take:
    """Steering is asked for."""


@dataclass(frozen=True)
class HandBack:
    """Steering is handed back."""


@dataclass(frozen=True)
class Act:
    """Something is asked of the coil bridge."""

    action: str


@dataclass(frozen=True)
class Choose:
    """Another scenario is asked for."""

    scenario: str


@dataclass(frozen=True)
class Pause:
    """Time shall stand still, or go on."""

    still: bool


@dataclass(frozen=True)
class Record:
    """A recording shall begin, or end."""

    on: bool


Word = Hello | Hold | Release | Got | Visible | Take | HandBack | Act | Choose | Pause | Record


def read_word(text: str, max_speed: float) -> Word:
    """Return what a message says.

        velocity = direction / max(1, |direction|) * min(speed, max_speed)

    Args:
        text: a JSON object with `type` and that type's fields.
        max_speed: greatest speed that may be asked for [m/s].

    Raises:
        InvalidInputError: it is anything else, or a number is not finite.
    """
    fields = _object(text)
    kind = fields.pop("type", None)
    if kind == "hold":
        return Hold(_velocity(fields, max_speed), _number(fields, "sent"))
    if kind == "got":
        return Got(_choice(fields, "what", ("state", "frame")))
    if kind == "hello":
        return Hello(_text(fields, "token"))
    if kind == "visible":
        return Visible(_switch(fields, "seen"))
    if kind == "act":
        return Act(_choice(fields, "action", ACTIONS))
    if kind == "choose":
        return Choose(_text(fields, "scenario"))
    if kind == "pause":
        return Pause(_switch(fields, "still"))
    if kind == "record":
        return Record(_switch(fields, "on"))
    plain: dict[Any, Word] = {"release": Release(), "take": Take(), "hand_back": HandBack()}
    if isinstance(kind, str) and kind in plain:
        return plain[kind]
    raise _refusal("type", kind, "hello, hold, release, got, visible, take, hand_back, act, choose, pause or record")


def _refusal(name: str, value: object, expectation: str) -> InvalidInputError:
    shown = value if isinstance(value, str) else repr(value)
    shown = shown if len(shown) <= SHOWN else shown[:SHOWN] + "…"
    return InvalidInputError(f"message.{name}", shown.encode("ascii", "backslashreplace").decode(), expectation)


def _object(text: str) -> dict[str, Any]:
    if len(text) > LONGEST:
        raise InvalidInputError("message", f"{len(text)} characters", f"at most {LONGEST}")

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
        except OverflowError:  # a whole number beyond any float
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
    largest = max(abs(x), abs(y), 1.0)  # before the root, which would overflow
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
