"""Coil drivers: their interface, and those without hardware: one records currents, one sends them to a simulation."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.settings.errors import DriverError

if TYPE_CHECKING:
    from magnetosuture_thread.coils.settings import CoilBridgeSettings

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
    currents, and does not apply later ones with a delay. One whose thread has died is not ready.

    Attributes:
        moves_nothing: whether it is known that its currents move nothing real: only then the bridge may arm itself, and
            the power stage need not stop by itself (`DriverState.timeout`).
    """

    moves_nothing: ClassVar[bool]

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


class SimulatedDriver:
    """Sends currents to the simulated rig; not ready without a subscriber.

    Args:
        coils: number of coils.
        send: sends currents of shape (coils,) [A] to the simulation.
        listeners: returns the number of simulations that subscribe.
    """

    moves_nothing: ClassVar[bool] = True

    def __init__(self, coils: int, send: Callable[[Vector], None], listeners: Callable[[], int]) -> None:
        self._coils, self._send, self._listeners = coils, send, listeners
        self._open = self._ready = False
        self._losses = 0

    def open(self) -> None:
        """Send currents from now on."""
        self._open = True

    def apply(self, currents: Vector, computed: float) -> None:
        """Send the currents of all coils, shape (coils,) [A], whenever they were computed.

        Raises:
            ValueError: the number of currents is wrong.
        """
        if currents.shape != (self._coils,):
            raise ValueError(f"{self._coils} currents expected, got shape {currents.shape}")
        if self.state().ready:
            self._send(currents.copy())

    def state(self) -> DriverState:
        """Return whether there is a subscriber."""
        ready = self._open and self._listeners() > 0
        if self._ready and not ready:
            self._losses += 1
        self._ready = ready
        problem = "no rig_simulator subscribed" if self._open else "not open"
        return DriverState(ready, "" if ready else problem, self._losses)

    def close(self) -> None:
        """Send zero currents, and no more after that."""
        self.apply(np.zeros(self._coils), math.inf)
        self._open = False


class RecordingDriver(SimulatedDriver):
    """Records currents where no hardware is configured: in tests, and in replays of bags.

    Args:
        coils: number of coils.

    Attributes:
        applied: the last currents that were applied, oldest first, each of shape (coils,) [A].
    """

    def __init__(self, coils: int) -> None:
        self.applied: deque[Vector] = deque(maxlen=10_000)
        super().__init__(coils, self.applied.append, lambda: 1)


def make_driver(
    settings: CoilBridgeSettings, coils: int, send: Callable[[Vector], None], listeners: Callable[[], int]
) -> CoilDriver:
    """Create the driver named in the settings.

    Args:
        settings: of the bridge.
        coils: number of coils.
        send: sends currents of shape (m,) [A] to the simulated rig.
        listeners: returns the number of simulated rigs that subscribe.

    Raises:
        DriverError: its settings are invalid.
    """
    if settings.driver == "simulated":
        return SimulatedDriver(coils, send, listeners)
    if settings.driver == "roboclaw":
        try:
            from magnetosuture_thread.coils.drivers.roboclaw import RoboClawDriver
        except ModuleNotFoundError as error:
            raise DriverError("roboclaw", f"{error}; install it by: pip install basicmicro pyserial") from None

        return RoboClawDriver(settings, coils)
    return RecordingDriver(coils)
