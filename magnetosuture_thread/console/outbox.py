"""What is on its way to one page: small answers in their order, of states and camera frames the newest only.

Pure. A page says when it got a state or a frame. No more than `AHEAD` of a kind are on their way to it, so a slow
page sees fewer of them, and none of them late.
"""

from __future__ import annotations

from collections import deque

AHEAD = 2
MOST_ANSWERS = 64

Message = str | bytes


class Outbox:
    """Keeps what a page is to get next."""

    def __init__(self) -> None:
        self._answers: deque[str] = deque(maxlen=MOST_ANSWERS)
        self._newest: dict[str, Message] = {}
        self._on_their_way = {"state": 0, "frame": 0}

    def answer(self, text: str) -> None:
        """Keep a small message; the oldest of too many is dropped."""
        self._answers.append(text)

    def put(self, what: str, message: Message) -> None:
        """Keep the newest of `state` or `frame`, in the place of one that has not gone out."""
        self._newest[what] = message

    def got(self, what: str) -> None:
        """Know that the page got one."""
        self._on_their_way[what] = max(0, self._on_their_way[what] - 1)

    def next(self) -> Message | None:
        """Return what goes out next, None while there is nothing or the page is behind."""
        if self._answers:
            return self._answers.popleft()
        for what in ("state", "frame"):
            if what in self._newest and self._on_their_way[what] < AHEAD:
                self._on_their_way[what] += 1
                return self._newest.pop(what)
        return None
