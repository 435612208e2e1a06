"""Errors of scenes, in one short line however large the value is."""

from __future__ import annotations

import reprlib
from typing import Any

from magnetosuture_thread.errors import ConfigurationError

MAX_VALUE_CHARS = 80
MAX_NAME_CHARS = 120


class _ShortRepr:
    """A value as an error shows it: the beginning of its representation."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _short_repr() -> reprlib.Repr:
    made = reprlib.Repr()
    made.maxdict = made.maxlist = made.maxtuple = 3
    made.maxlevel = 3
    made.maxstring = made.maxlong = made.maxother = MAX_VALUE_CHARS
    return made


_SHORT_REPR = _short_repr()


def scene_error(name: str, value: Any, expectation: str, source: str = "") -> ConfigurationError:
    """Return the error for a part of a scene.

    Args:
        name: of the field, for example `post.disc.radius`; of a long one the beginning is shown.
        value: what was given; of a long or deep one the beginning is shown.
        expectation: what would have been accepted, with its unit.
        source: the file.
    """
    text = _SHORT_REPR.repr(value)
    if len(text) > 2 * MAX_VALUE_CHARS:
        text = f"{text[: 2 * MAX_VALUE_CHARS]}…"
    short = _ShortRepr(text) if isinstance(value, (str, list, tuple, dict)) or len(text) > MAX_VALUE_CHARS else value
    # A name comes from a file too: control characters and line ends are shown as escapes.
    name = "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in name[: MAX_NAME_CHARS + 1])
    return ConfigurationError(
        name if len(name) <= MAX_NAME_CHARS else f"{name[:MAX_NAME_CHARS]}…", short, expectation, source
    )
