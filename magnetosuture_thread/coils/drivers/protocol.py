"""Interface of coil drivers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class DriverState:
    """State of a driver and its power stage.

    Attributes:
        ready: whether currents reach the coils now.
        problem: why not; empty while ready.
        losses: how often it ceased to be ready since it was opened. A loss that ended between two steps must be
            detected all the same: the coils went to zero meanwhile.
        warnings: conditions that need attention but no stop.
        currents: measured in each coil, shape (m,) [A]; None where the driver measures none.
        voltages: of the boards' supplies [V]; empty where the driver measures none.
        timeout: without new currents for this long the power stage stops by itself [s]; inf where it does not.
    """

    ready: bool
    problem: str = ""
    losses: int = 0
    warnings: tuple[str, ...] = ()
    currents: Vector | None = None
    voltages: tuple[float, ...] = ()
    timeout: float = math.inf


class CoilDriver(Protocol):
    """Interface to the power stage of the coils.

    No call may wait for a device: slow operations belong in a thread of the driver's own, and their results in
    its state. After any failure of the device a driver reconnects by itself, always from zero: it drops earlier
    currents, and does not apply later ones with a delay.
    """

    def open(self) -> None:
        """Start to connect, with all currents at zero; success is reported in the state.

        Raises:
            DriverError: the connection can never succeed.
        """
        ...

    def apply(self, currents: Vector, computed: float) -> None:
        """Set the current of each coil from now on; ignored while not ready.

        A process that is stopped and goes on must not apply what is outdated by then: a driver of hardware sets zero
        for currents that are older than it allows when they are about to be written.

        Args:
            currents: of the coils, shape (m,) [A].
            computed: the monotonic time for which they were computed [s].
        """
        ...

    def state(self) -> DriverState:
        """Return the present state."""
        ...

    def close(self) -> None:
        """Set all currents to zero and disconnect; no effect if not open."""
        ...
