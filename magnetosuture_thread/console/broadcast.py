"""What every page is told: encoded once, whoever listens."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

NUMBER = struct.Struct(">Q")  # before the bytes of a camera frame


def state_message(graph: dict[str, Any], host: dict[str, Any], lease: dict[str, Any]) -> str:
    """Return the state of everything as JSON; a number that is not finite, which JSON does not know, is null."""
    state = {"type": "state", "graph": graph, "host": host, "lease": lease}
    try:
        return json.dumps(state, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return json.dumps(_finite(state), allow_nan=False, separators=(",", ":"))


def frame_message(number: int, image: bytes) -> bytes:
    """Return a camera frame with its number in 8 bytes, big end first, before it."""
    return NUMBER.pack(number) + image


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
