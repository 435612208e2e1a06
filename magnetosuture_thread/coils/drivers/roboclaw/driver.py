"""Coil driver for RoboClaw boards: coil currents in, duties out; a thread for each serial port."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.drivers.roboclaw.board import (
    MAX_RETRY_DELAY,
    Board,
    DeviceError,
    ExchangePort,
    Vector,
    retry_delay,
)
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import DriverError

KEEP_ALIVE_PERIOD = 0.02  # s, maximum between two writes; a board's own timeout is at least five times as long
POLL_PERIOD = 0.02  # s, maximum between two queries, however often currents are commanded
SHUTDOWN_TIMEOUT = 0.12  # s in which boards are set to zero at the end
DEFAULT_ADDRESS = 128  # of a board as delivered
MIN_BAUD_RATE = 38400  # at which a board's longest answer arrives in time
CLOSE_TIMEOUT = 0.3  # s


@dataclass(frozen=True)
class LineReport:
    """Measurements and warnings of the boards on a line.

    Attributes:
        currents: measured, by the coil's number [A].
        voltages: of the supplies, by the board's number [V].
        warnings: conditions that need no stop.
    """

    currents: dict[int, float]
    voltages: dict[int, float]
    warnings: tuple[str, ...]


class Mailbox:
    """Latest currents, kept only while every line is ready, and the reports of all lines. Time comes in [s].

    A call blocks only while another call runs.

    Args:
        coils: number of coils.
        problems: initial problem of each line, until it is ready.
        timeout: currents are valid for this long [s].

    Attributes:
        wake_events: for each line, set when currents change or a line fails.
    """

    def __init__(self, coils: int, problems: Sequence[str], timeout: float) -> None:
        self.wake_events = [threading.Event() for _ in problems]
        self._coils, self._timeout = coils, timeout
        self._lock = threading.Lock()
        self._problems = list(problems)  # a line without a problem is ready
        self._reports: list[LineReport | None] = [None] * len(problems)
        self._currents: Vector | None = None
        self._computed = 0.0
        self._timed_out = False
        self._losses = 0

    def put(self, currents: Vector, computed: float) -> None:
        """Set the currents, shape (m,) [A], and when they were computed; dropped unless every line is ready."""
        with self._lock:
            if any(self._problems):
                return
            self._currents, self._computed, self._timed_out = currents.copy(), computed, False
        self._wake()

    def latest(self, now: float) -> tuple[Vector | None, float]:
        """Return the currents to apply now, shape (m,) [A], None for zero in all coils, and until when [s]."""
        with self._lock:
            if self._currents is not None and now - self._computed > self._timeout:
                self._timed_out = bool(np.any(self._currents))
                self._currents = None
            return self._currents, math.inf if self._currents is None else self._computed + self._timeout

    def set_ready(self, line: int, report: LineReport) -> None:
        """Mark a line as ready, with its first report."""
        with self._lock:
            self._problems[line] = ""
            self._reports[line] = report

    def update_report(self, line: int, report: LineReport) -> None:
        """Update the report of a line."""
        with self._lock:
            self._reports[line] = report

    def set_failed(self, line: int, problem: str) -> None:
        """Mark a line as not ready; the currents of all lines are dropped."""
        with self._lock:
            self._losses += not any(self._problems)
            self._problems[line] = problem
            self._reports[line] = None
            self._currents = None
            self._timed_out = False
        self._wake()

    def state(self) -> DriverState:
        """Return the state of all lines."""
        with self._lock:
            reports = [report for report in self._reports if report is not None]
            problem = "; ".join(problem for problem in self._problems if problem)
            warnings = [warning for report in reports for warning in report.warnings]
            if self._timed_out:
                warnings.append(f"no currents were commanded within {self._timeout:g} s: coils at zero")
            currents = _in_order([report.currents for report in reports])
            voltages = _in_order([report.voltages for report in reports])
            measured = np.array(currents) if len(currents) == self._coils else None
            return DriverState(not problem, problem, self._losses, tuple(warnings), measured, tuple(voltages))

    def _wake(self) -> None:
        for wake in self.wake_events:
            wake.set()


def _in_order(values: Sequence[dict[int, float]]) -> list[float]:
    merged = {number: value for some in values for number, value in some.items()}
    return [merged[number] for number in sorted(merged)]


class LineThread:
    """Connects to the boards of a port, writes duties and polls the boards; reconnects until it is stopped.

    This is where the driver waits for hardware, so it reads the clock itself.

    Args:
        number: of the line.
        path: of its port.
        boards: number and address of each board on it.
        settings: of the bridge.
        mailbox: source of currents, and destination of reports.
        others: addresses that none of the boards may answer to.
    """

    def __init__(
        self,
        number: int,
        path: str,
        boards: dict[int, int],
        settings: CoilBridgeSettings,
        mailbox: Mailbox,
        others: Sequence[int] = (),
    ) -> None:
        self._number, self._path, self._addresses, self._others = number, path, boards, others
        self._settings, self._mailbox = settings, mailbox
        self._wake = mailbox.wake_events[number]
        self._stopping = threading.Event()
        self._boards: dict[int, Board] = {}
        self._leaving = False
        self._thread = threading.Thread(target=self._run, name=f"roboclaw {path}", daemon=True)

    def start(self) -> None:
        """Start to connect."""
        self._thread.start()

    def stop(self) -> None:
        """Request the end of the thread, with all currents at zero."""
        self._stopping.set()
        self._wake.set()

    def join(self, timeout: float) -> None:
        """Wait for the end of the thread, for at most a time [s]."""
        self._thread.join(timeout)

    def _run(self) -> None:
        failures = 0
        while not self._stopping.is_set():
            ready_at = None
            problem = "closed"
            port = None
            try:
                port = ExchangePort(
                    self._path, self._settings.roboclaw_baud_rate, self._settings.roboclaw_answer_timeout
                )
                self._connect(port)
                ready_at = time.monotonic()
                self._serve()
            except DeviceError as error:
                problem = str(error)
            except Exception as error:  # the line reconnects after any error
                problem = f"{self._path}: {type(error).__name__}: {error}"
            self._mailbox.set_failed(self._number, problem)
            if port is not None:
                self._leave(port)
            if ready_at is not None and time.monotonic() - ready_at > MAX_RETRY_DELAY:
                failures = 0
            failures += 1
            self._stopping.wait(retry_delay(failures))

    def _connect(self, port: ExchangePort) -> None:
        self._leaving = False
        self._boards = {
            number: Board(
                port,
                number,
                address,
                f"board {number} ({self._path}, address {address})",
                self._settings,
                self._no_retry,
            )
            for number, address in self._addresses.items()
        }
        for board in self._boards.values():  # all, before any can acknowledge
            board.identify(self._others)
        for board in self._boards.values():
            board.configure()
        self._mailbox.set_ready(self._number, self._report())

    def _serve(self) -> None:
        turn, polled_at = 0, 0.0
        while not self._stopping.is_set():
            self._wake.wait(KEEP_ALIVE_PERIOD)
            self._wake.clear()
            for number, board in self._boards.items():
                board.write(partial(self._latest, number))
            # New currents go first, but the boards must be polled all the same.
            if not self._wake.is_set() or time.monotonic() - polled_at > POLL_PERIOD:
                list(self._boards.values())[turn % len(self._boards)].poll()
                turn, polled_at = turn + 1, time.monotonic()
                self._mailbox.update_report(self._number, self._report())

    def _latest(self, number: int) -> tuple[Vector | None, float]:
        """Return the currents of a board to apply now, shape (2,) [A], None for zero in both coils, and until when."""
        currents, until = self._mailbox.latest(time.monotonic())
        return (None if currents is None else currents[2 * number : 2 * number + 2]), until

    def _leave(self, port: ExchangePort) -> None:
        """Set every board to zero; one that does not acknowledge stops by its own timeout."""
        remaining, until = list(self._boards.values()), time.monotonic() + SHUTDOWN_TIMEOUT
        self._leaving = True
        while remaining and time.monotonic() < until:
            remaining = [board for board in remaining if not _set_zero(board)]
        self._boards = {}
        with suppress(Exception):
            port.reset_output_buffer()  # or closing may wait for the output
        with suppress(Exception):
            port.close()

    def _no_retry(self) -> bool:
        return self._leaving or self._stopping.is_set()

    def _report(self) -> LineReport:
        currents = np.array([board.currents for board in self._boards.values()]).ravel()
        coils = [2 * number + channel for number in self._boards for channel in (0, 1)]
        return LineReport(
            dict(zip(coils, currents.tolist(), strict=True)),
            {number: board.voltage for number, board in self._boards.items()},
            tuple(warning for board in self._boards.values() for warning in board.warnings),
        )


def _set_zero(board: Board) -> bool:
    """Set a board to zero, and return whether it acknowledged."""
    try:
        board.write_zero()
    except Exception:
        return False
    return True


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
        raise DriverError("roboclaw", "roboclaw_ports is empty, expected the serial port of each board")
    if 2 * len(ports) != coils:
        raise DriverError("roboclaw", f"roboclaw_ports has {len(ports)}, expected one for two of the {coils} coils")
    if addresses and len(addresses) != len(ports):
        expected = f"one for each of the {len(ports)} roboclaw_ports, or none"
        raise DriverError("roboclaw", f"roboclaw_addresses has {len(addresses)}, expected {expected}")
    tenths = 10.0 * settings.driver_timeout
    if abs(tenths - round(tenths)) > 1e-6:
        raise DriverError("roboclaw", f"driver_timeout is {settings.driver_timeout:g}, expected tenths of a second")
    if settings.roboclaw_baud_rate < MIN_BAUD_RATE:
        expected = f"at least {MIN_BAUD_RATE}, so that answers come in time"
        raise DriverError("roboclaw", f"roboclaw_baud_rate is {settings.roboclaw_baud_rate}, expected {expected}")
    found: dict[str, dict[int, int]] = {}
    for number, (path, address) in enumerate(zip(ports, addresses or [DEFAULT_ADDRESS] * len(ports), strict=True)):
        on_port = found.setdefault(path, {})
        if address in on_port.values():
            raise DriverError("roboclaw", f"two boards on {path} have address {address}, expected an address for each")
        on_port[number] = address
    for path, boards in found.items():
        if shared := set(boards.values()).intersection(_others(found, path)):
            expected = "different addresses, or a path of each that stays with its plug, as under /dev/serial/by-path"
            problem = f"{path} and another port have boards of address {min(shared)}, expected {expected}"
            raise DriverError("roboclaw", problem)
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
