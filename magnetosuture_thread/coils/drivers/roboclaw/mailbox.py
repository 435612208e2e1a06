"""Exchange of currents and reports between the driver and the threads of its lines."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.drivers.roboclaw.protocol import Vector


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
        self._put_at = 0.0
        self._timed_out = False
        self._losses = 0

    def put(self, currents: Vector, now: float) -> None:
        """Set the currents, shape (m,) [A]; they are dropped unless every line is ready."""
        with self._lock:
            if any(self._problems):
                return
            self._currents, self._put_at, self._timed_out = currents.copy(), now, False
        self._wake()

    def latest(self, now: float) -> Vector | None:
        """Return the currents to apply now, shape (m,) [A]; None is zero in all coils."""
        with self._lock:
            if self._currents is not None and now - self._put_at > self._timeout:
                self._timed_out = bool(np.any(self._currents))
                self._currents = None
            return self._currents

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
