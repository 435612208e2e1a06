"""The lease on the needle: one operator steers at a time, others watch.

Pure: it reads no clock; times are monotonic [s].
"""

from __future__ import annotations

import math


class Lease:
    """Who steers.

    It is handed over only by its holder, or taken from one who cannot be steering: whose page is hidden, or of
    whom nothing was heard for `silence`.

    Args:
        silence: [s].

    Attributes:
        holder: the number of the client who steers, None if nobody does.
    """

    def __init__(self, silence: float) -> None:
        self.holder: int | None = None
        self._silence = silence
        self._heard = -math.inf
        self._hidden = False

    def available(self, now: float) -> bool:
        """Return whether somebody else may take it."""
        return self.holder is None or self._hidden or now - self._heard > self._silence

    def take(self, client: int, now: float) -> str:
        """Make a client the holder; return an empty text, or why not."""
        if client != self.holder and not self.available(now):
            return f"page {self.holder} steers: it has to hand back first"
        self.holder, self._heard, self._hidden = client, now, False
        return ""

    def hand_back(self, client: int) -> bool:
        """Free it, if this client holds it; return whether it did."""
        if client != self.holder:
            return False
        self.holder, self._hidden = None, False
        return True

    @property
    def hidden(self) -> bool:
        """Whether the holder's page is hidden."""
        return self._hidden

    def hear(self, client: int, now: float) -> None:
        """Know that a client is alive."""
        if client == self.holder:
            self._heard = now

    def hide(self, client: int, hidden: bool) -> None:
        """Know that a client's page is hidden, or seen again."""
        if client == self.holder:
            self._hidden = hidden
