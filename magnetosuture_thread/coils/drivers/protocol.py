"""What a coil driver must do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class DriverState:
    """What a driver knows of its power stage.

    Attributes:
        ready: whether currents get to the coils now.
        problem: why not; empty while it is ready.
        losses: how often it has ceased to be ready since it was opened. A loss that is over before anybody
            looked must be noticed all the same: the coils went to zero meanwhile.
        warnings: what a person should know although it goes on.
        currents: measured in each coil, shape (m,) [A]; None where the driver measures none.
        voltages: of the boards' supplies [V]; empty where the driver measures none.
    """

    ready: bool
    problem: str = ""
    losses: int = 0
    warnings: tuple[str, ...] = ()
    currents: Vector | None = None
    voltages: tuple[float, ...] = ()


class CoilDriver(Protocol):
    """The interface to the coils' power stage.

    No call may wait for a device: what takes time belongs in a thread of the driver's own, and what it finds
    in its state. Whatever happens to the device, a driver comes back by itself, and always from zero: it
    drops what was asked of it before, and what it is asked between is not applied late.
    """

    def open(self) -> None:
        """Begin to connect, with all currents at zero; whether it succeeds is in the state.

        Raises:
            DriverError: it can never succeed.
        """
        ...

    def apply(self, currents: Vector) -> None:
        """Ask for the current of each coil from now on, shape (m,) [A]; nothing is kept while not ready."""
        ...

    def state(self) -> DriverState:
        """Return what is known now."""
        ...

    def close(self) -> None:
        """Set all currents to zero and disconnect; harmless if it is not open."""
        ...
