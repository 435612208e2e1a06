"""Coil drivers, a file for each."""

from __future__ import annotations

from collections.abc import Callable

from magnetosuture_thread.coils.drivers.protocol import CoilDriver, DriverState, Vector
from magnetosuture_thread.coils.drivers.recording import RecordingDriver
from magnetosuture_thread.coils.drivers.roboclaw import RoboClawDriver
from magnetosuture_thread.coils.drivers.simulated import SimulatedDriver
from magnetosuture_thread.coils.settings import CoilBridgeSettings


def make_driver(
    settings: CoilBridgeSettings, coils: int, send: Callable[[Vector], None], listeners: Callable[[], int]
) -> CoilDriver:
    """Return the driver that the settings name.

    Args:
        settings: of the bridge.
        coils: number of coils.
        send: takes currents of shape (m,) [A] to the simulated rig.
        listeners: tells how many simulated rigs listen.

    Raises:
        DriverError: its settings cannot work.
    """
    if settings.driver == "simulated":
        return SimulatedDriver(coils, send, listeners)
    if settings.driver == "roboclaw":
        return RoboClawDriver(settings, coils)
    return RecordingDriver(coils)


__all__ = ["CoilDriver", "DriverState", "RecordingDriver", "RoboClawDriver", "SimulatedDriver", "make_driver"]
