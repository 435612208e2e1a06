"""Encoding and queueing of messages to a page: replies in order, of states and camera frames only the latest.

Pure. A page acknowledges each state and frame. At most `MAX_UNACKNOWLEDGED` of a kind are in flight, so a slow page
receives fewer of them, and none of them late.
"""

from __future__ import annotations

import json
import math
import struct
from collections import deque
from typing import Any

MAX_UNACKNOWLEDGED = 2
MAX_REPLIES = 64
FRAME_HEADER = struct.Struct(">Q")  # number of a camera frame, before its bytes

Message = str | bytes


class Outbox:
    """Queue of the messages to one page."""

    def __init__(self) -> None:
        self._replies: deque[str] = deque(maxlen=MAX_REPLIES)
        self._latest: dict[str, Message] = {}
        self._in_flight = {"state": 0, "frame": 0}

    def reply(self, text: str) -> None:
        """Queue a reply; the oldest of too many is dropped."""
        self._replies.append(text)

    def put(self, kind: str, message: Message) -> None:
        """Set the latest `state` or `frame`; it replaces one that was not sent."""
        self._latest[kind] = message

    def acknowledge(self, kind: str) -> bool:
        """Register that the page received a `state` or `frame`; return whether one was in flight."""
        was_in_flight = self._in_flight[kind] > 0
        self._in_flight[kind] -= was_in_flight
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
        return json.dumps(_finite(state), allow_nan=False, separators=(",", ":"))


def encode_frame(number: int, image: bytes) -> bytes:
    """Encode a camera frame: its number in 8 bytes, big endian, then the image."""
    return FRAME_HEADER.pack(number) + image


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
