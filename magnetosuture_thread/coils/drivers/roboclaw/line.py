"""The thread that alone talks to the boards on a serial port."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from functools import partial

import numpy as np

from magnetosuture_thread.coils.drivers.roboclaw import rules
from magnetosuture_thread.coils.drivers.roboclaw.board import Board
from magnetosuture_thread.coils.drivers.roboclaw.mailbox import Mailbox, Report
from magnetosuture_thread.coils.drivers.roboclaw.port import DeviceError, ExchangePort
from magnetosuture_thread.coils.drivers.roboclaw.rules import Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings

KEEP_ALIVE = 0.02  # s between two writes at the most; a board's own timeout is at least five times as long
POLL_PERIOD = 0.02  # s between two questions at the most, however often currents are asked for
LEAVING = 0.12  # s in which boards are asked for zero at the end


class LineThread:
    """Connects to the boards on a port, writes duties and looks after them, again and again until it is ended.

    This is where the driver waits for hardware, so here it reads the clock itself.

    Args:
        number: of the line.
        path: of its port.
        boards: number and address of each board on it.
        settings: of the bridge.
        mailbox: where currents come from, and where what it finds out goes.
    """

    def __init__(
        self,
        number: int,
        path: str,
        boards: dict[int, int],
        settings: CoilBridgeSettings,
        mailbox: Mailbox,
    ) -> None:
        self._number, self._path, self._addresses, self._settings = number, path, boards, settings
        self._mailbox = mailbox
        self._wake = mailbox.wakes[number]
        self._ends = threading.Event()
        self._boards: dict[int, Board] = {}
        self._leaves = False
        self._thread = threading.Thread(target=self._run, name=f"roboclaw {path}", daemon=True)

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def end(self) -> None:
        """Begin to end, with all currents at zero."""
        self._ends.set()
        self._wake.set()

    def join(self, timeout: float) -> None:
        """Wait until it has ended, for a time [s] at the most."""
        self._thread.join(timeout)

    def _run(self) -> None:
        failures = 0
        while not self._ends.is_set():
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
            except Exception as error:  # whatever happens to a device, the line comes back
                problem = f"{self._path}: {type(error).__name__}: {error}"
            self._mailbox.lost(self._number, problem)
            if port is not None:
                self._leave(port)
            if ready_at is not None and time.monotonic() - ready_at > rules.LONGEST_PAUSE:
                failures = 0
            failures += 1
            self._ends.wait(rules.pause(failures))

    def _connect(self, port: ExchangePort) -> None:
        self._leaves = False
        self._boards = {
            number: Board(
                port,
                number,
                address,
                f"board {number} ({self._path}, address {address})",
                self._settings,
                self._hurries,
            )
            for number, address in self._addresses.items()
        }
        for board in self._boards.values():
            board.set_up()
        self._mailbox.ready(self._number, self._report())

    def _serve(self) -> None:
        turn, polled_at = 0, 0.0
        while not self._ends.is_set():
            self._wake.wait(KEEP_ALIVE)
            self._wake.clear()
            for number, board in self._boards.items():
                board.write(partial(self._newest, number))
            # What is new goes first, but what goes on must be known all the same.
            if not self._wake.is_set() or time.monotonic() - polled_at > POLL_PERIOD:
                list(self._boards.values())[turn % len(self._boards)].poll()
                turn, polled_at = turn + 1, time.monotonic()
                self._mailbox.report(self._number, self._report())

    def _newest(self, number: int) -> Vector | None:
        """Return the currents that a board is to give now, shape (2,) [A]; None is zero in both its coils."""
        currents = self._mailbox.take(time.monotonic())
        return None if currents is None else currents[2 * number : 2 * number + 2]

    def _leave(self, port: ExchangePort) -> None:
        """Ask every board for zero; one that does not hear stops by its own timeout, as nobody writes to it."""
        left, until = list(self._boards.values()), time.monotonic() + LEAVING
        self._leaves = True
        while left and time.monotonic() < until:
            left = [board for board in left if not _zeroed(board)]
        self._boards = {}
        with suppress(Exception):
            port.reset_output_buffer()  # or closing may wait until it has gone out
        with suppress(Exception):
            port.close()

    def _hurries(self) -> bool:
        return self._leaves or self._ends.is_set()

    def _report(self) -> Report:
        currents = np.array([board.currents for board in self._boards.values()]).ravel()
        coils = [2 * number + channel for number in self._boards for channel in (0, 1)]
        return Report(
            dict(zip(coils, currents.tolist(), strict=True)),
            {number: board.voltage for number, board in self._boards.items()},
            tuple(warning for board in self._boards.values() for warning in board.warnings),
        )


def _zeroed(board: Board) -> bool:
    """Ask a board for zero, and return whether it has heard that."""
    try:
        board.write_zero()
    except Exception:
        return False
    return True
