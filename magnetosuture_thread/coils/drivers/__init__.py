"""Coil drivers: those without hardware, and that of RoboClaw boards."""

from __future__ import annotations

from collections.abc import Callable

from magnetosuture_thread.coils.drivers.protocol import (
    CoilDriver,
    DriverState,
    RecordingDriver,
    SimulatedDriver,
    Vector,
)
from magnetosuture_thread.coils.drivers.roboclaw import RoboClawDriver
from magnetosuture_thread.coils.settings import CoilBridgeSettings


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
        return RoboClawDriver(settings, coils)
    return RecordingDriver(coils)


__all__ = ["CoilDriver", "DriverState", "RecordingDriver", "RoboClawDriver", "SimulatedDriver", "make_driver"]
