"""Coil drivers, a file for each."""

from __future__ import annotations

from magnetosuture_thread.coils.drivers.protocol import CoilDriver
from magnetosuture_thread.coils.drivers.recording import RecordingDriver
from magnetosuture_thread.coils.settings import CoilBridgeSettings


def make_driver(settings: CoilBridgeSettings) -> CoilDriver:
    """Return the driver that the settings name."""
    return {"recording": RecordingDriver}[settings.driver](len(settings.coil_angles))


__all__ = ["CoilDriver", "RecordingDriver", "make_driver"]
