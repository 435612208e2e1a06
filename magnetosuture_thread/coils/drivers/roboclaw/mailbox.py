"""What the driver and the threads of its lines leave for each other."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.drivers.roboclaw.rules import Vector


@dataclass(frozen=True)
class Report:
    """What a line has found out about its boards.

    Attributes:
        currents: measured, by the coil's number [A].
        voltages: of the supplies, by the board's number [V].
        warnings: what a person should know.
    """

    currents: dict[int, float]
    voltages: dict[int, float]
    warnings: tuple[str, ...]


class Mailbox:
    """Keeps the newest currents while every line is ready, and nothing else. Time comes in [s].

    No call waits for more than another call.

    Args:
        coils: number of coils.
        problems: of each line, until it is ready.
        patience: for this long currents are good [s].

    Attributes:
        wakes: for each line, set when there is something new for it.
    """

    def __init__(self, coils: int, problems: Sequence[str], patience: float) -> None:
        self.wakes = [threading.Event() for _ in problems]
        self._coils, self._patience = coils, patience
        self._lock = threading.Lock()
        self._problems = list(problems)  # a line without one is ready
        self._reports: list[Report | None] = [None] * len(problems)
        self._currents: Vector | None = None
        self._put_at = 0.0
        self._cut = False
        self._losses = 0

    def put(self, currents: Vector, now: float) -> None:
        """Leave currents, shape (m,) [A]; they are dropped unless every line is ready."""
        with self._lock:
            if any(self._problems):
                return
            self._currents, self._put_at, self._cut = currents.copy(), now, False
        self._wake()

    def take(self, now: float) -> Vector | None:
        """Return the currents that are to be given now, shape (m,) [A]; None is zero in all coils."""
        with self._lock:
            if self._currents is not None and now - self._put_at > self._patience:
                self._cut = bool(np.any(self._currents))
                self._currents = None
            return self._currents

    def ready(self, line: int, report: Report) -> None:
        """Let a line be ready, with its first report."""
        with self._lock:
            self._problems[line] = ""
            self._reports[line] = report

    def report(self, line: int, report: Report) -> None:
        """Leave what a line has found out."""
        with self._lock:
            self._reports[line] = report

    def lost(self, line: int, problem: str) -> None:
        """Let a line not be ready any more, or still not; all others go to zero with it."""
        with self._lock:
            self._losses += not any(self._problems)
            self._problems[line] = problem
            self._reports[line] = None
            self._currents = None
            self._cut = False
        self._wake()

    def state(self) -> DriverState:
        """Return what is known of all lines."""
        with self._lock:
            reports = [report for report in self._reports if report is not None]
            problem = "; ".join(problem for problem in self._problems if problem)
            warnings = [warning for report in reports for warning in report.warnings]
            if self._cut:
                warnings.append(f"no currents were asked for within {self._patience:g} s: coils at zero")
            currents = _in_order([report.currents for report in reports])
            voltages = _in_order([report.voltages for report in reports])
            measured = np.array(currents) if len(currents) == self._coils else None
            return DriverState(not problem, problem, self._losses, tuple(warnings), measured, tuple(voltages))

    def _wake(self) -> None:
        for wake in self.wakes:
            wake.set()


def _in_order(values: Sequence[dict[int, float]]) -> list[float]:
    together = {number: value for some in values for number, value in some.items()}
    return [together[number] for number in sorted(together)]
