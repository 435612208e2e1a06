"""Coil driver without hardware that records currents."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.drivers.protocol import DriverState

MAX_RECORDED = 10_000


class RecordingDriver:
    """Records currents where no hardware is configured: in tests, and in replays of bags.

    Args:
        coils: number of coils.

    Attributes:
        applied: the last currents that were applied, oldest first, each of shape (coils,) [A].
    """

    def __init__(self, coils: int) -> None:
        self._coils = coils
        self._open = False
        self.applied: deque[NDArray[np.float64]] = deque(maxlen=MAX_RECORDED)

    def open(self) -> None:
        """Accept currents from now on."""
        self._open = True

    def apply(self, currents: NDArray[np.float64]) -> None:
        """Record the currents of all coils, shape (coils,) [A].

        Raises:
            ValueError: the number of currents is wrong.
        """
        if not self._open:
            return
        if currents.shape != (self._coils,):
            raise ValueError(f"{self._coils} currents expected, got shape {currents.shape}")
        self.applied.append(currents.copy())

    def state(self) -> DriverState:
        """Return that the driver is ready while open."""
        return DriverState(self._open, "" if self._open else "not open")

    def close(self) -> None:
        """Record zero currents and accept no more."""
        if self._open:
            self.applied.append(np.zeros(self._coils))
        self._open = False
