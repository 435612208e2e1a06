"""How late a page's words arrive: what the network held up says what was held then, not what is held now.

Pure: it reads no clock. The page's clock has an origin of its own, so the quickest word counts as not late.
"""

from __future__ import annotations

import math

LEAK = 1e-4  # the quickest word is forgotten at this rate [s/s], more than what two clocks drift apart


class Lateness:
    """Compares when words were sent, by the page's clock, with when they arrived, by ours."""

    def __init__(self) -> None:
        self._least = math.inf  # arrival less sending of the quickest word [s]
        self._arrival = 0.0

    def of(self, sent: float, arrival: float) -> float:
        """Return how much later than the quickest word this one arrived [s].

        Args:
            sent: by the page's monotonic clock [s].
            arrival: by our monotonic clock [s].
        """
        forgotten = LEAK * max(0.0, arrival - self._arrival)
        self._least, self._arrival = min(self._least + forgotten, arrival - sent), arrival
        return arrival - sent - self._least
