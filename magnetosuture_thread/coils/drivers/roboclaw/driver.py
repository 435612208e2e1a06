"""Coil driver for RoboClaw boards: coil currents in, duties out."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.drivers.roboclaw.line import LineThread, Mailbox
from magnetosuture_thread.coils.drivers.roboclaw.protocol import Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import DriverError

DRIVER_NAME = "roboclaw"
DEFAULT_ADDRESS = 128  # of a board as delivered
MIN_BAUD_RATE = 38400  # at which a board's longest answer arrives in time
CLOSE_TIMEOUT = 0.3  # s


class RoboClawDriver:
    """Driver for RoboClaw boards of two coils each: coils 0 and 1 are on the first board, 2 and 3 on the second.

    d = I R / U with the duty d from -1 to 1, the current I [A], the resistance R [ohm] of that coil, from the
    calibration or else `coil_resistance`, and the voltage U [V] of the board's supply as it measures it. A board
    sets the mean voltage at a coil, not its current: the current settles with the coil's L / R, and is lower in
    a coil that is warmer than R assumes. Above U / R the duty is clipped, with a warning. Another warning names a
    coil whose measured current stays under half of that expected, of at least 0.5 A, as with a broken wire; it
    ends when they agree or less is commanded.

    Each serial port has its own thread. It applies the latest currents while every board is ready, and zero
    otherwise: if one board fails, if the currents are older than `apply_timeout`, and after every loss until the
    first `apply` after all are ready again. Currents are read again for each board and each attempt to write, so
    that a stop takes effect in between, and their age is checked once more when the packet is about to be written.

    Every board has its own current limit, and stops by itself without a packet for `driver_timeout`; a board that
    does not confirm both is never ready. Both are polled, with two boards on a line within about a second: a board
    whose supply fails forgets them, which is a loss however soon it is back.

    Each board has to be identified before any is driven, at the start and after every loss: it answers to its own
    address and, unless the path of its port is stable (see `is_stable`), to none of the boards on other ports.

    Args:
        settings: of the bridge.
        coils: number of coils; that of the settings' angles if None.
        apply_timeout: currents older than this are zero [s]; if None the smaller of `command_timeout` and
            `driver_timeout`, after which the boards have stopped by themselves.

    Raises:
        DriverError: ports, addresses, baud rate or timeout are invalid.
    """

    def __init__(
        self, settings: CoilBridgeSettings, coils: int | None = None, apply_timeout: float | None = None
    ) -> None:
        self._settings = settings
        self._coils = len(settings.coil_angles) if coils is None else coils
        usual = min(settings.command_timeout, settings.driver_timeout)
        self._apply_timeout = usual if apply_timeout is None else apply_timeout
        self._ports = _boards_by_port(settings, self._coils)
        self._mailbox: Mailbox | None = None
        self._lines: list[LineThread] = []

    def open(self) -> None:
        """Start to connect, with all currents at zero; no effect if open."""
        if self._mailbox is not None:
            return
        mailbox = Mailbox(self._coils, [f"connecting to {path}" for path in self._ports], self._apply_timeout)
        self._lines = [
            LineThread(number, path, boards, self._settings, mailbox, _others(self._ports, path))
            for number, (path, boards) in enumerate(self._ports.items())
        ]
        self._mailbox = mailbox
        for line in self._lines:
            line.start()

    def apply(self, currents: Vector, computed: float) -> None:
        """Set the current of each coil from now on, for `apply_timeout` at the most; ignored while not ready.

        Args:
            currents: of the coils, shape (m,) [A].
            computed: the time of `time.monotonic` for which they were computed [s].

        Raises:
            ValueError: the number of currents is wrong, or one is not finite.
        """
        if currents.shape != (self._coils,) or not np.all(np.isfinite(currents)):
            raise ValueError(f"{self._coils} finite currents expected, got {currents.tolist()}")
        if self._mailbox is not None:
            limit = self._settings.max_current
            self._mailbox.put(np.clip(currents, -limit, limit), computed)

    def state(self) -> DriverState:
        """Return the present state."""
        if self._mailbox is None:
            return DriverState(False, "not open")
        return replace(self._mailbox.state(), timeout=self._settings.driver_timeout)

    def close(self) -> None:
        """Set all currents to zero and disconnect, within 0.3 s; no effect if not open."""
        until = time.monotonic() + CLOSE_TIMEOUT
        for line in self._lines:
            line.stop()
        for line in self._lines:
            line.join(max(0.0, until - time.monotonic()))
        self._lines = []
        self._mailbox = None


def _boards_by_port(settings: CoilBridgeSettings, coils: int) -> dict[str, dict[int, int]]:
    """Return number and address of the boards on each port.

    Raises:
        DriverError: the settings are invalid.
    """
    ports, addresses = settings.roboclaw_ports, settings.roboclaw_addresses
    if not ports:
        raise DriverError(DRIVER_NAME, "roboclaw_ports is empty, expected the serial port of each board")
    if 2 * len(ports) != coils:
        raise DriverError(DRIVER_NAME, f"roboclaw_ports has {len(ports)}, expected one for two of the {coils} coils")
    if addresses and len(addresses) != len(ports):
        expected = f"one for each of the {len(ports)} roboclaw_ports, or none"
        raise DriverError(DRIVER_NAME, f"roboclaw_addresses has {len(addresses)}, expected {expected}")
    tenths = 10.0 * settings.driver_timeout
    if abs(tenths - round(tenths)) > 1e-6:
        raise DriverError(DRIVER_NAME, f"driver_timeout is {settings.driver_timeout:g}, expected tenths of a second")
    if settings.roboclaw_baud_rate < MIN_BAUD_RATE:
        expected = f"at least {MIN_BAUD_RATE}, so that answers come in time"
        raise DriverError(DRIVER_NAME, f"roboclaw_baud_rate is {settings.roboclaw_baud_rate}, expected {expected}")
    found: dict[str, dict[int, int]] = {}
    for number, (path, address) in enumerate(zip(ports, addresses or [DEFAULT_ADDRESS] * len(ports), strict=True)):
        on_port = found.setdefault(path, {})
        if address in on_port.values():
            raise DriverError(DRIVER_NAME, f"two boards on {path} have address {address}, expected an address for each")
        on_port[number] = address
    for path, boards in found.items():
        if shared := set(boards.values()).intersection(_others(found, path)):
            expected = "different addresses, or a path of each that stays with its plug, as under /dev/serial/by-path"
            problem = f"{path} and another port have boards of address {min(shared)}, expected {expected}"
            raise DriverError(DRIVER_NAME, problem)
    return found


def is_stable(path: str) -> bool:
    """Return whether a port's path stays with one plug: a link, as udev makes them, there already or not yet.

    What the kernel numbers (`/dev/tty...`, `/dev/pts/...`) goes to whatever board is found first.
    """
    return not Path(path).name.startswith("tty") and (os.path.islink(path) or not os.path.exists(path))


def _others(ports: Mapping[str, Mapping[int, int]], path: str) -> tuple[int, ...]:
    """Return the addresses of boards on other ports, for which one here may be taken; none where the path is stable."""
    others = {address for other, boards in ports.items() if other != path for address in boards.values()}
    return () if is_stable(path) else tuple(sorted(others))
