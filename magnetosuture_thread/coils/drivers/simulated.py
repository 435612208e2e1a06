"""A driver for the simulated rig: currents go out as messages."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.drivers.protocol import DriverState

Vector = NDArray[np.float64]


class SimulatedDriver:
    """Sends currents to whoever simulates the coils; without anybody there it is not ready.

    Args:
        coils: number of coils.
        send: takes currents of shape (coils,) [A] to the simulation.
        listeners: tells how many simulations listen.
    """

    def __init__(self, coils: int, send: Callable[[Vector], None], listeners: Callable[[], int]) -> None:
        self._coils = coils
        self._send = send
        self._listeners = listeners
        self._open = self._ready = False
        self._losses = 0

    def open(self) -> None:
        """Begin to send."""
        self._open = True

    def apply(self, currents: Vector) -> None:
        """Send the currents of all coils, shape (coils,) [A]."""
        if self.state().ready:
            self._send(currents)

    def state(self) -> DriverState:
        """Return whether anybody listens."""
        ready = self._open and self._listeners() > 0
        if self._ready and not ready:
            self._losses += 1
        self._ready = ready
        return DriverState(ready, "" if ready else "no rig_simulator listens", self._losses)

    def close(self) -> None:
        """Send zeros, and then no more."""
        self.apply(np.zeros(self._coils))
        self._open = False
