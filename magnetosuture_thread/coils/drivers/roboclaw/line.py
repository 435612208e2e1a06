"""Input/output threads of serial ports with RoboClaw boards, and their exchange of currents and reports."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.drivers.roboclaw import protocol
from magnetosuture_thread.coils.drivers.roboclaw.board import Board
from magnetosuture_thread.coils.drivers.roboclaw.port import DeviceError, ExchangePort
from magnetosuture_thread.coils.drivers.roboclaw.protocol import Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings

KEEP_ALIVE_PERIOD = 0.02  # s, maximum between two writes; a board's own timeout is at least five times as long
POLL_PERIOD = 0.02  # s, maximum between two queries, however often currents are commanded
SHUTDOWN_TIMEOUT = 0.12  # s in which boards are set to zero at the end


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
            if ready_at is not None and time.monotonic() - ready_at > protocol.MAX_RETRY_DELAY:
                failures = 0
            failures += 1
            self._stopping.wait(protocol.retry_delay(failures))

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
