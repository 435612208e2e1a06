"""Writes the parts of the reference that are taken from the code: a page asks for one by a block `{generated} NAME`."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

WRITERS: dict[str, Callable[[], str]] = {}
_BLOCK = re.compile(r"^```\{generated\} (\w+)\n```$", re.MULTILINE)


def write_generated(text: str) -> str:
    """Return a page with its generated parts."""
    return _BLOCK.sub(lambda found: WRITERS[found[1]](), text)


def setup(app: Any) -> dict[str, bool]:
    """Register at Sphinx."""

    def fill(_app: Any, _page: str, source: list[str]) -> None:
        source[0] = write_generated(source[0])

    app.connect("source-read", fill)
    return {"parallel_read_safe": True}
