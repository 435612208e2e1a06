"""Coil driver for the simulated rig, over messages."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.drivers.protocol import DriverState

Vector = NDArray[np.float64]


class SimulatedDriver:
    """Sends currents to the simulated rig; not ready without a subscriber.

    Args:
        coils: number of coils.
        send: sends currents of shape (coils,) [A] to the simulation.
        listeners: returns the number of simulations that subscribe.
    """

    def __init__(self, coils: int, send: Callable[[Vector], None], listeners: Callable[[], int]) -> None:
        self._coils = coils
        self._send = send
        self._listeners = listeners
        self._open = self._ready = False
        self._losses = 0

    def open(self) -> None:
        """Send currents from now on."""
        self._open = True

    def apply(self, currents: Vector) -> None:
        """Send the currents of all coils, shape (coils,) [A]."""
        if self.state().ready:
            self._send(currents)

    def state(self) -> DriverState:
        """Return whether there is a subscriber."""
        ready = self._open and self._listeners() > 0
        if self._ready and not ready:
            self._losses += 1
        self._ready = ready
        return DriverState(ready, "" if ready else "no rig_simulator subscribed", self._losses)

    def close(self) -> None:
        """Send zero currents, and no more after that."""
        self.apply(np.zeros(self._coils))
        self._open = False
