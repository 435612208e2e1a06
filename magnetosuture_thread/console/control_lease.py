"""Control lease: one page at a time may command the needle, others watch.

Pure: it reads no clock; times are monotonic [s].
"""

from __future__ import annotations

import math


class ControlLease:
    """Exclusive control of the needle.

    Only the holder releases control. Another client may acquire it while the holder cannot command: while its page is
    hidden, or after `timeout` without a message.

    Args:
        timeout: maximum silence of the holder [s].

    Attributes:
        holder: number of the client that has control, None if there is none.
    """

    def __init__(self, timeout: float) -> None:
        self.holder: int | None = None
        self._timeout = timeout
        self._last_message = -math.inf
        self._hidden = False

    def available(self, now: float) -> bool:
        """Return whether another client may acquire control."""
        return self.holder is None or self._hidden or now - self._last_message > self._timeout

    def acquire(self, client: int, now: float) -> str:
        """Give control to a client; return an empty text, or the reason of a refusal."""
        if client != self.holder and not self.available(now):
            return f"page {self.holder} has control and must release it first"
        self.holder, self._last_message, self._hidden = client, now, False
        return ""

    def release(self, client: int) -> bool:
        """Release control if this client holds it; return whether it did."""
        if client != self.holder:
            return False
        self.holder, self._hidden = None, False
        return True

    @property
    def hidden(self) -> bool:
        """Whether the holder's page is hidden."""
        return self._hidden

    def keep_alive(self, client: int, now: float) -> None:
        """Register a message of a client."""
        if client == self.holder:
            self._last_message = now

    def set_hidden(self, client: int, hidden: bool) -> None:
        """Register whether a client's page is hidden."""
        if client == self.holder:
            self._hidden = hidden
