"""A driver without hardware: it keeps what it was told."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

KEPT = 10_000


class RecordingDriver:
    """Stands in where no hardware is configured: in tests, and while a bag is replayed.

    Args:
        coils: number of coils.

    Attributes:
        applied: the last currents that were applied, oldest first, each of shape (coils,) [A].
    """

    def __init__(self, coils: int) -> None:
        self._coils = coils
        self._open = False
        self.applied: deque[NDArray[np.float64]] = deque(maxlen=KEPT)

    def open(self) -> None:
        """Start to accept currents."""
        self._open = True

    def apply(self, currents: NDArray[np.float64]) -> None:
        """Keep the currents of all coils, shape (coils,) [A].

        Raises:
            RuntimeError: the driver is not open.
            ValueError: the number of currents is wrong.
        """
        if not self._open:
            raise RuntimeError("the recording driver is not open")
        if currents.shape != (self._coils,):
            raise ValueError(f"{self._coils} currents expected, got shape {currents.shape}")
        self.applied.append(currents.copy())

    def close(self) -> None:
        """Set all currents to zero and stop to accept any."""
        if self._open:
            self.applied.append(np.zeros(self._coils))
        self._open = False
