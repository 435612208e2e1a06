"""The driver for RoboClaw boards: coil currents in, duties out."""

from __future__ import annotations

import time

import numpy as np

from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.drivers.roboclaw.line import LineThread
from magnetosuture_thread.coils.drivers.roboclaw.mailbox import Mailbox
from magnetosuture_thread.coils.drivers.roboclaw.rules import Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import DriverError

NAME = "roboclaw"
ADDRESS = 128  # of a board as it is delivered
SLOWEST = 38400  # baud at which a board's longest answer comes in time
CLOSING = 0.3  # s


class RoboClawDriver:
    """Drives boards of two coils each: coils 0 and 1 are on the first board, 2 and 3 on the second.

    d = I R / U with the duty d from -1 to 1, the current I [A], the resistance R [ohm] of that coil, from the
    calibration or else `coil_resistance`, and the voltage U [V] of the board's supply as it measures it. A board
    sets the mean voltage at a coil and no current: the current settles with the coil's L / R, and is too small
    by as much as the coil is warmer than R says. Above U / R the duty is clipped, and a warning says so. Another
    names a coil whose measured current stays under half of what its duty should give, of at least 0.5 A, as
    where its wire is broken; it goes when they agree or less is asked.

    A thread for each serial port is the only one that talks to it. It keeps the newest currents in force while
    every board is ready, and zero otherwise: where one board fails, where `apply` is not called for `patience`,
    and after every loss until the first `apply` that comes once all are ready again. Currents are taken anew for
    each board and each attempt to write to it, so that a stop gets in between.

    Every board holds a limit of its own on the currents, and stops by itself when it hears nothing for
    `driver_timeout`; a board that does not confirm both is never ready. It is asked for both again and again,
    with two boards on a line within about a second: one whose supply breaks down forgets them, which is a loss
    however soon it is back.

    Args:
        settings: of the bridge.
        coils: number of coils; that of the settings' angles if None.
        patience: without `apply` for this long the coils go to zero [s]; `command_timeout` if None.

    Raises:
        DriverError: ports, addresses, baud rate or timeout cannot work.
    """

    def __init__(self, settings: CoilBridgeSettings, coils: int | None = None, patience: float | None = None) -> None:
        self._settings = settings
        self._coils = len(settings.coil_angles) if coils is None else coils
        self._patience = settings.command_timeout if patience is None else patience
        self._ports = _boards_by_port(settings, self._coils)
        self._mailbox: Mailbox | None = None
        self._lines: list[LineThread] = []

    def open(self) -> None:
        """Begin to connect, with all currents at zero; harmless if it is open."""
        if self._mailbox is not None:
            return
        mailbox = Mailbox(self._coils, [f"connecting to {path}" for path in self._ports], self._patience)
        self._lines = [
            LineThread(number, path, boards, self._settings, mailbox)
            for number, (path, boards) in enumerate(self._ports.items())
        ]
        self._mailbox = mailbox
        for line in self._lines:
            line.start()

    def apply(self, currents: Vector) -> None:
        """Ask for the current of each coil from now on, shape (m,) [A]; nothing is kept while not ready.

        Raises:
            ValueError: the number of currents is wrong, or one is not finite.
        """
        if currents.shape != (self._coils,) or not np.all(np.isfinite(currents)):
            raise ValueError(f"{self._coils} finite currents expected, got {currents.tolist()}")
        if self._mailbox is not None:
            most = self._settings.max_current
            self._mailbox.put(np.clip(currents, -most, most), time.monotonic())

    def state(self) -> DriverState:
        """Return what is known now."""
        return DriverState(False, "not open") if self._mailbox is None else self._mailbox.state()

    def close(self) -> None:
        """Set all currents to zero and disconnect, within 0.3 s; harmless if it is not open."""
        until = time.monotonic() + CLOSING
        for line in self._lines:
            line.end()
        for line in self._lines:
            line.join(max(0.0, until - time.monotonic()))
        self._lines = []
        self._mailbox = None


def _boards_by_port(settings: CoilBridgeSettings, coils: int) -> dict[str, dict[int, int]]:
    """Return number and address of the boards on each port.

    Raises:
        DriverError: that cannot work.
    """
    ports, addresses = settings.roboclaw_ports, settings.roboclaw_addresses
    if not ports:
        raise DriverError(NAME, "roboclaw_ports is empty, expected the serial port of each board")
    if 2 * len(ports) != coils:
        raise DriverError(NAME, f"roboclaw_ports has {len(ports)}, expected one for two of the {coils} coils")
    if addresses and len(addresses) != len(ports):
        expected = f"one for each of the {len(ports)} roboclaw_ports, or none"
        raise DriverError(NAME, f"roboclaw_addresses has {len(addresses)}, expected {expected}")
    tenths = 10.0 * settings.driver_timeout
    if abs(tenths - round(tenths)) > 1e-6:
        raise DriverError(NAME, f"driver_timeout is {settings.driver_timeout:g}, expected tenths of a second")
    if settings.roboclaw_baud_rate < SLOWEST:
        expected = f"at least {SLOWEST}, so that answers come in time"
        raise DriverError(NAME, f"roboclaw_baud_rate is {settings.roboclaw_baud_rate}, expected {expected}")
    found: dict[str, dict[int, int]] = {}
    for number, (path, address) in enumerate(zip(ports, addresses or [ADDRESS] * len(ports), strict=True)):
        on_port = found.setdefault(path, {})
        if address in on_port.values():
            raise DriverError(NAME, f"two boards on {path} have address {address}, expected an address for each")
        on_port[number] = address
    return found
