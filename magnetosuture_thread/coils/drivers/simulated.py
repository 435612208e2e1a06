"""Coil drivers without hardware: one that records currents, and one for the simulated rig, over messages."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.drivers.protocol import DriverState

Vector = NDArray[np.float64]

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
        self.applied: deque[Vector] = deque(maxlen=MAX_RECORDED)

    def open(self) -> None:
        """Accept currents from now on."""
        self._open = True

    def apply(self, currents: Vector, computed: float) -> None:
        """Record the currents of all coils, shape (coils,) [A], whenever they were computed.

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

    def apply(self, currents: Vector, computed: float) -> None:
        """Send the currents of all coils, shape (coils,) [A], whenever they were computed."""
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
        self.apply(np.zeros(self._coils), math.inf)
        self._open = False
