"""Coil driver for RoboClaw boards: coil currents in, duties out; a thread for each serial port.

A port bounds the time of each exchange. The rules for duties, limits and status bits do no input or output.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import logging
import math
import os
import select
import termios
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import serial
from basicmicro import Basicmicro
from basicmicro.exceptions import BasicmicroError

from magnetosuture_thread.coils.drivers import DriverState, Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.settings.errors import DriverError

FULL_DUTY = 32767  # duty of the full supply voltage
MAX_RETRY_DELAY = 2.0  # s between two attempts to connect
DUTY_TOLERANCE = 164  # by which a board may round a non-zero duty: 0.5 % of the supply
MAX_MISMATCHES, MAX_OVERCURRENTS = 2, 3  # consecutive answers that are a fault; the first may be a lost packet
# Consecutive measurements of a missing current: a fifth of a second and more at 200 Hz, so that neither a change of
# the current nor the coil's L / R looks like a broken wire.

# Errors in the boards' manual that the manufacturer's library lacks.
DRIVER_FAULTS = {0x0040: "Motor 1 Driver Fault", 0x0080: "Motor 2 Driver Fault"}
OPEN_PROBLEMS = {
    errno.EAGAIN: "{0} is held by another process",
    errno.EBUSY: "{0} is held by another process",
    errno.ENOENT: "there is no {0}",
    errno.EACCES: "no permission for {0}; its group is usually dialout",
}
ACK = b"\xff"
MAX_ATTEMPTS = 2


def retry_delay(failures: int) -> float:
    """Return the delay before the next connection attempt: 0.1 s, doubled with each failure, up to 2 s.

    >>> [retry_delay(failures) for failures in (1, 2, 5, 6, 10**6)]
    [0.1, 0.2, 1.6, 2.0, 2.0]
    """
    return min(MAX_RETRY_DELAY, 0.1 * 2.0 ** min(failures - 1, 10))


def duties_for(currents: Vector, resistances: Vector, voltage: float) -> tuple[tuple[int, ...], bool]:
    """Return the duties for given currents, and whether the supply voltage is too low for them.

    d = I R / U, clipped to -1 ... 1, times 32767 and truncated to an integer, so that no current exceeds the
    commanded one. A board sets the mean voltage at a coil, and the current settles with the coil's L / R.

    Args:
        currents: I, shape (m,) [A].
        resistances: R, of each coil with its cable, shape (m,) [ohm].
        voltage: U, of the board's supply [V].

    >>> duties_for(np.array([3.0, -6.0, 30.0]), np.array([1.0, 0.5, 1.0]), 24.0)
    ((4095, -4095, 32767), True)
    """
    share = currents * resistances / voltage
    too_low = bool(np.any(np.abs(share) > 1.0))
    return tuple(np.trunc(FULL_DUTY * np.clip(share, -1.0, 1.0)).astype(int).tolist()), too_low


def is_short(expected: float, measured: float) -> bool:
    """Return whether a coil's current is so low that its wire may be broken.

    A warm coil has 20 to 40 % less. The sign is ignored.

    Args:
        expected: steady-state current of its duty [A].
        measured: current in the coil [A].

    >>> [is_short(4.0, measured) for measured in (0.03, 2.4, -4.0)]
    [True, False, False]
    >>> is_short(0.4, 0.0)
    False
    """
    # Below 0.5 A a missing current cannot be detected; below half of the expected one a warm coil is no explanation.
    return abs(expected) >= 0.5 and abs(measured) < 0.5 * abs(expected)


def describe_bits(bits: int, descriptions: Mapping[int, str], kind: str) -> tuple[str, ...]:
    """Return the meaning of each set bit; an unknown bit is named by its number.

    >>> describe_bits(0x0201, {1: "Emergency Stop"}, "error")
    ('Emergency Stop', 'error bit 0x0200')
    """
    found = [1 << place for place in range(16) if bits >> place & 1]
    return tuple(descriptions.get(bit, f"{kind} bit 0x{bit:04x}") for bit in found)


def duties_match(
    written: Sequence[int], reported: Sequence[int], currents: Sequence[float], max_current: float
) -> bool:
    """Return whether a board's duties match those written.

    A board may round a non-zero duty, and reduce it where the coil's current is close to its limit.

    Args:
        written: duties.
        reported: duties reported by the board.
        currents: measured in each coil [A].
        max_current: maximum current in a coil [A].

    >>> duties_match((4096, 0), (4096, 0), (0.0, 0.0), 10.0)
    True
    >>> duties_match((0, 0), (1, 0), (0.0, 0.0), 10.0)
    False
    """
    for target, actual, current in zip(written, reported, currents, strict=True):
        exact = abs(target - actual) <= (DUTY_TOLERANCE if target else 0)
        # Above 80 % of the maximum current a board may reduce its duty.
        limited = abs(current) >= 0.8 * max_current and min(0, target) <= actual <= max(0, target)
        if not exact and not limited:
            return False
    return True


# `os.write` lets another thread have the interpreter first, and may wait for it there for longer than a board waits for
# the next byte of a packet.
_write = ctypes.PyDLL(None).write
_write.argtypes, _write.restype = (ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t), ctypes.c_ssize_t


class DeviceError(Exception):
    """Failure of a board or its line, with a text for the operator."""


class ExchangePort(serial.Serial):
    """Exclusive serial port for one request and one answer at a time.

    Written bytes are buffered until the answer is read, so that a packet is sent without gaps: a board drops one with a
    gap of 10 ms, and the manufacturer's library writes a packet in up to five pieces.

    Args:
        path: of the port.
        baud_rate: of the line.
        answer_timeout: that a board has for an answer [s].

    Attributes:
        answer_timeout: as given.
        answer: the bytes that were read since `begin`.
        is_drained: whether no answer to an earlier request can come any more; see `Board`.
    """

    def __init__(self, path: str, baud_rate: int, answer_timeout: float) -> None:
        self.answer_timeout = answer_timeout
        self._packet = bytearray()
        self.answer = bytearray()
        self.is_drained = True
        self._until = self._expires = 0.0
        try:
            # The lock comes first, so that a process that holds the port is not disturbed.
            super().__init__(path, baud_rate, timeout=answer_timeout, exclusive=True)
        except (serial.SerialException, ValueError) as error:
            number = getattr(error, "errno", None) or 0
            raise DeviceError(OPEN_PROBLEMS.get(number, "cannot open {0}: {1}").format(path, error)) from error

    def begin(self, expires: float = math.inf) -> None:
        """Begin an exchange; discard late bytes of the last one.

        Args:
            expires: when the packet is outdated, and is not sent any more: a time of `time.monotonic` [s].
        """
        self._expires = expires
        self.reset_input_buffer()
        self._packet.clear()
        self.answer.clear()
        self._until = time.monotonic() + self.answer_timeout

    def write(self, b: Any, /) -> int:
        """Buffer bytes of a packet until the answer is read."""
        self._packet += b
        return len(b)

    def read(self, size: int = 1, /) -> bytes:
        """Send the packet if it has not been sent, and return up to `size` bytes of the answer.

        The board's time begins when the packet is sent; an exchange waits for at most twice that, in any number of
        reads. Bytes that have arrived are returned even if this thread was delayed: rclpy may hold the interpreter
        for longer than the answer timeout, which is no fault of the board. For the same reason a packet that is
        late by that much is not sent, as its command may be outdated.
        """
        if self._packet:
            packet = bytes(self._packet)
            self._packet.clear()
            if time.monotonic() >= self._until:
                return b""
            self._send(packet)
            self._until = time.monotonic() + self.answer_timeout
        if time.monotonic() >= self._until:
            size = min(size, self.in_waiting)
        data = super().read(size)
        self.answer += data
        return data

    def _send(self, packet: bytes) -> None:
        """Write a packet to the kernel, once its buffer takes it; not its last byte, if it is outdated by then.

        A process that is stopped before the clock is read sees there that the packet is outdated; one that is stopped
        after that sends the last byte later than the board waits for it. The board drops the packet in both cases.
        The library's own write reports a sent packet as not sent if this thread was delayed after the system call.
        """
        port, until = self.fileno(), min(self._until, self._expires)
        _, writable, _ = select.select([], [port], [], max(0.0, self._until - time.monotonic()))
        if not writable:
            raise serial.SerialTimeoutException("the output buffer is full")
        most, last = packet[:-1], packet[-1:]
        is_written = _write(port, most, len(most)) == len(most)
        if time.monotonic() >= until:
            raise serial.SerialTimeoutException("an outdated packet")
        if not is_written or _write(port, last, 1) != 1:
            raise serial.SerialTimeoutException("a packet was written in part")


# The library logs every missing byte, a hundred times a second for a dead board; the driver reports the problem
# in its state. A level that was set before is kept.
_library = logging.getLogger("basicmicro")
if _library.level == logging.NOTSET:
    _library.setLevel(logging.CRITICAL)


class Stored(NamedTuple):
    """A setting that a board keeps: its name, how it is written and read, its value in units of 1 / scale."""

    name: str
    write: Callable[..., Any]
    values: tuple[float, ...]
    read: Callable[..., Any]
    scale: float
    expected: int


class Board:
    """RoboClaw board with two coils.

    An acknowledgement is one byte and tells neither what it acknowledges nor which board sent it. After a request
    without a valid answer none counts, until a question that nothing else asks has been answered: a board answers in
    the order of requests, so that all earlier answers have come by then, however late they are.

    Args:
        port: serial port of its line.
        number: of the board; its coils have twice that number, and one more.
        address: on that port, 128 to 135.
        name: for messages.
        settings: of the bridge: maximum current, each coil's resistance, and after how long without a packet
            the board stops by itself.
        no_retry: returns whether there is no time for a second attempt.

    Attributes:
        number: of the board.
        version: firmware version.
        voltage: of its supply [V].
        currents: measured in its two coils [A].
        warnings: conditions that need no stop.
    """

    def __init__(
        self,
        port: ExchangePort,
        number: int,
        address: int,
        name: str,
        settings: CoilBridgeSettings,
        no_retry: Callable[[], bool],
    ) -> None:
        self._port, self._address, self._name, self._no_retry = port, address, name, no_retry
        self.number = number
        self._max_current = settings.max_current
        self._resistances = np.array(settings.resistances()[2 * number : 2 * number + 2])
        device: Any = Basicmicro(port.name, port.baudrate, retries=1)
        # Its own Open makes a port without a lock, and one that may keep its caller for a second.
        device._port, device._connected = port, True
        self._device = device
        self.version = ""
        self.voltage = 0.0
        self.currents = (0.0, 0.0)
        self._commanded = (0.0, 0.0)
        self._expires = math.inf  # of the values of an exchange
        self._written = (0, 0)
        self._signs = [1, 1]
        self._counts: Counter[str] = Counter()  # of consecutive answers that are wrong, by what is
        self._supply_too_low = self._limited = False
        self._conditions: tuple[str, ...] = ()
        self._coil_warnings = ["", ""]
        # Settings that a board loses with its supply; after a short loss, nothing else shows it. Half a tenth is added,
        # as the library truncates; zero would disable the timeout.
        tenths, limit = round(10.0 * settings.driver_timeout), round(100.0 * settings.max_current)
        names, timeout = ("serial timeout in tenths of a second", "current limit in 10 mA"), 0.1 * (tenths + 0.5)
        self._stored = (
            Stored(names[0], device.SetTimeout, (timeout,), device.GetTimeout, 10.0, tenths),
            Stored(names[1], device.SetM1MaxCurrent, (limit, 0), device.ReadM1MaxCurrent, 1.0, limit),
            Stored(names[1], device.SetM2MaxCurrent, (limit, 0), device.ReadM2MaxCurrent, 1.0, limit),
        )
        # With a query each 20 to 25 ms, two boards on a line are polled completely within about a second.
        always = (self._check_duties, self._check_currents)
        self._polls: Iterator[Callable[[], None]] = itertools.cycle(
            check
            for stored in self._stored
            for check in (
                *always,
                self._check_status,
                *always,
                self._check_voltage,
                partial(self._check_stored, stored),
            )
        )
        self._poll = next(self._polls)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Conditions that need attention but no stop."""
        found = list(self._conditions)
        if self._supply_too_low:
            found.append(f"a supply of {self.voltage:g} V is too low for the currents")
        if self._limited:
            found.append("a current is at its limit")
        return (*(f"{self._name}: {warning}" for warning in found), *filter(None, self._coil_warnings))

    def identify(self, others: Sequence[int] = ()) -> None:
        """Verify that the board on this port is the one of this address, before anything is set.

        Args:
            others: addresses that it must not answer to, as those of boards on other ports.

        Raises:
            DeviceError: it does not answer to its own address, or answers to another one too.
        """
        for other in MAX_ATTEMPTS * tuple(others):
            self._attempt(self._device.ReadVersion, other)
            if self._port.answer:
                expected = "expected a path under /dev/serial/by-path for each port, as over USB addresses are ignored"
                raise DeviceError(f"{self._name}: answers to address {other} too; {expected}")
        try:
            (self.version,) = self._query(self._device.ReadVersion)
        except DeviceError as error:
            raise DeviceError(f"{error}: it is off, has another address, or ports are exchanged") from None

    def configure(self) -> None:
        """Set currents to zero, set timeout and limits, and verify each.

        Raises:
            DeviceError: a value cannot be set or verified.
        """
        self.write_zero()
        if (duties := self._query(self._device.ReadPWMs)) != (0, 0):
            raise DeviceError(f"{self._name}: duties {duties[0]} and {duties[1]} instead of 0 and 0")
        for stored in self._stored:
            self._exchange(stored.write, partial(tuple, stored.values), self._acknowledged)
        currents = [self._check_currents] * MAX_OVERCURRENTS
        checks: list[Callable[[], None]] = [partial(self._check_stored, stored) for stored in self._stored]
        for check in (*checks, self._check_status, *currents, self._check_voltage):
            check()

    def write(self, latest: Callable[[], tuple[Vector | None, float]]) -> None:
        """Command the latest currents of its two coils.

        They are read again before each attempt, as they may have been stopped in between.

        Args:
            latest: returns the currents to apply now, shape (2,) [A], None for zero in both coils, and until when they
                may be written, a time of `time.monotonic` [s].

        Raises:
            DeviceError: the board does not acknowledge.
        """

        def target_duties() -> tuple[int, ...]:
            currents, self._expires = latest()
            duties, self._supply_too_low = (
                ((0, 0), False) if currents is None else duties_for(currents, self._resistances, self.voltage)
            )
            self._commanded = (0.0, 0.0) if currents is None else (float(currents[0]), float(currents[1]))
            return duties

        first, second = self._exchange(self._device.DutyM1M2, target_duties, self._acknowledged)[0]
        self._written = first, second
        # A board measures the magnitude of a current, not its sign.
        self._signs = [(d > 0) - (d < 0) or sign for d, sign in zip(self._written, self._signs, strict=True)]

    def write_zero(self) -> None:
        """Command zero currents.

        Raises:
            DeviceError: the board does not acknowledge.
        """
        self.write(lambda: (None, math.inf))

    def poll(self) -> None:
        """Send the next query of the polling sequence.

        Raises:
            DeviceError: the board does not answer or reports a fault.
        """
        self._poll()
        if not self._counts["mismatches"]:  # else the same query again, at once
            self._poll = next(self._polls)

    def _check_stored(self, stored: Stored) -> None:
        value = round(stored.scale * self._query(stored.read)[0])
        if value != stored.expected:
            raise DeviceError(f"{self._name}: {stored.name} {value} instead of {stored.expected}")

    def _is_repeated(self, what: str, is_wrong: bool, limit: int) -> bool:
        """Register an answer, and return whether the last ones, as many as the limit, were wrong."""
        self._counts[what] = self._counts[what] + 1 if is_wrong else 0
        return self._counts[what] >= limit

    def _check_voltage(self) -> None:
        self.voltage = self._query(self._device.GetVolts)[0] / 10.0
        # The range of all models of boards [V].
        low, high = 5.0, 80.0
        if not low <= self.voltage <= high:
            raise DeviceError(f"{self._name}: a supply of {self.voltage:g} V")

    def _check_duties(self) -> None:
        reported = self._query(self._device.ReadPWMs)
        matches = tuple(reported) == self._written
        if not matches:
            self._check_currents()
            matches = duties_match(self._written, reported, self.currents, self._max_current)
        self._limited = matches and any(
            abs(w - r) > DUTY_TOLERANCE for w, r in zip(self._written, reported, strict=True)
        )
        if self._is_repeated("mismatches", not matches, MAX_MISMATCHES):
            raise DeviceError(f"{self._name}: has duties {tuple(reported)} instead of {self._written}")

    def _check_currents(self) -> None:
        first, second = (
            0.01 * raw * sign + 0.0  # -0 A is 0 A
            for raw, sign in zip(self._query(self._device.ReadCurrents), self._signs, strict=True)
        )
        self.currents = (first, second)
        worst = max(self.currents, key=abs)
        # A board may exceed the maximum current by 20 % for a moment.
        if self._is_repeated("excesses", abs(worst) > 1.2 * self._max_current, MAX_OVERCURRENTS):
            raise DeviceError(f"{self._name}: a current of {worst:.2f} A, more than {self._max_current:g} A")
        expected = np.array(self._written) / FULL_DUTY * self.voltage / self._resistances
        for channel, (measured, commanded) in enumerate(zip(self.currents, self._commanded, strict=True)):
            coil = 2 * self.number + channel
            if not self._is_repeated(f"coil {coil}", is_short(float(expected[channel]), measured), 12):
                self._coil_warnings[channel] = ""
            elif not self._coil_warnings[channel]:  # keeps the first text, which would change with every answer
                self._coil_warnings[channel] = f"coil {coil}: {measured:.2f} A measured, {commanded:.2f} A commanded"

    def _check_status(self) -> None:
        (bits,) = self._query(self._device.ReadError)
        known = {**Basicmicro.ERROR_DESCRIPTIONS, **DRIVER_FAULTS}
        errors = describe_bits(bits & 0xFFFF, known, "error")
        if errors:
            raise DeviceError(f"{self._name}: {', '.join(errors)}")
        self._conditions = describe_bits(bits >> 16, Basicmicro.WARNING_DESCRIPTIONS, "warning")

    def _acknowledged(self, result: Any) -> bool:
        return bool(result) and self._port.answer == ACK and self._port.is_drained  # the library accepts any byte

    def _query(self, call: Callable[..., Any]) -> tuple[Any, ...]:
        result: tuple[Any, ...] = self._exchange(call, tuple, lambda result: bool(result[0]))[1]
        return result[1:]

    def _exchange(
        self, call: Callable[..., Any], values: Callable[[], tuple[Any, ...]], is_valid: Callable[[Any], bool]
    ) -> tuple[tuple[Any, ...], Any]:
        """Return the values last sent and the library's result; each attempt gets its values anew."""
        for attempt in range(MAX_ATTEMPTS):
            if attempt:
                if self._no_retry():
                    break
                if not self._drain():
                    continue
            self._expires = math.inf
            sent = values()
            result = self._attempt(call, self._address, *sent)
            if result is not None and is_valid(result):
                return sent, result
            self._port.is_drained = False
        raise DeviceError(f"{self._name}: no valid answer to {call.__name__}")

    def _attempt(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return the library's result of a request, None if it failed."""
        try:
            self._port.begin(self._expires)
            return call(*arguments)
        except (BasicmicroError, serial.SerialException, OSError, termios.error):
            return None

    def _drain(self) -> bool:
        """Return whether all earlier answers of the board have come."""
        time.sleep(0.015)  # in which the board drops a partial packet
        self._expires = math.inf
        result = self._attempt(self._device.ReadMainBatteryVoltage, self._address)  # no such answer begins with an ACK
        self._port.is_drained = result is not None and bool(result[0])
        return self._port.is_drained


KEEP_ALIVE_PERIOD = 0.02  # s, maximum between two writes; a board's own timeout is at least five times as long
POLL_PERIOD = 0.02  # s, maximum between two queries, however often currents are commanded
MIN_BAUD_RATE = 38400  # at which a board's longest answer arrives in time


class Mailbox:
    """Latest currents, kept only while every line is ready, and the boards of all lines. Time comes in [s].

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
        self._boards: list[Sequence[Board]] = [()] * len(problems)  # of each line, while it is ready
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

    def set_ready(self, line: int, boards: Sequence[Board]) -> None:
        """Mark a line as ready, with its boards."""
        with self._lock:
            self._problems[line] = ""
            self._boards[line] = boards

    def set_failed(self, line: int, problem: str) -> None:
        """Mark a line as not ready; the currents of all lines are dropped."""
        with self._lock:
            self._losses += not any(self._problems)
            self._problems[line] = problem
            self._boards[line] = ()
            self._currents = None
            self._timed_out = False
        self._wake()

    def state(self) -> DriverState:
        """Return the state of all lines."""
        with self._lock:
            boards = sorted((board for boards in self._boards for board in boards), key=lambda board: board.number)
            problem = "; ".join(problem for problem in self._problems if problem)
            warnings = [warning for board in boards for warning in board.warnings]
            if self._timed_out:
                warnings.append(f"no currents were commanded within {self._timeout:g} s: coils at zero")
            currents = np.array([current for board in boards for current in board.currents])
            measured = currents if len(currents) == self._coils else None
            voltages = tuple(board.voltage for board in boards)
            return DriverState(not problem, problem, self._losses, tuple(warnings), measured, voltages)

    def _wake(self) -> None:
        for wake in self.wake_events:
            wake.set()


class LineThread(threading.Thread):
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
        super().__init__(name=f"roboclaw {path}", daemon=True)
        self._number, self._path, self._addresses, self._others = number, path, boards, others
        self._settings, self._mailbox = settings, mailbox
        self._wake = mailbox.wake_events[number]
        self._stopping = threading.Event()
        self._boards: dict[int, Board] = {}
        self._leaving = False

    def stop(self) -> None:
        """Request the end of the thread, with all currents at zero."""
        self._stopping.set()
        self._wake.set()

    def run(self) -> None:
        """Connect and serve the boards, again after each failure, until `stop`; a thread that dies is not ready."""
        try:
            self._run()
        finally:
            self._mailbox.set_failed(self._number, f"{self._path}: its thread has ended")

    def _run(self) -> None:
        failures = 0
        while not self._stopping.is_set():
            ready_at, problem, port = None, "closed", None
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
        self._boards = {}
        for number, address in self._addresses.items():
            name = f"board {number} ({self._path}, address {address})"
            self._boards[number] = Board(port, number, address, name, self._settings, self._no_retry)
        for board in self._boards.values():  # all, before any can acknowledge
            board.identify(self._others)
        for board in self._boards.values():
            board.configure()
        self._mailbox.set_ready(self._number, tuple(self._boards.values()))

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

    def _latest(self, number: int) -> tuple[Vector | None, float]:
        """Return the currents of a board to apply now, shape (2,) [A], None for zero in both coils, and until when."""
        currents, until = self._mailbox.latest(time.monotonic())
        return (None if currents is None else currents[2 * number : 2 * number + 2]), until

    def _leave(self, port: ExchangePort) -> None:
        """Set every board to zero; one that does not acknowledge stops by its own timeout."""
        # The boards have 0.12 s to take zero at the end.
        remaining, until = list(self._boards.values()), time.monotonic() + 0.12
        self._leaving = True
        while remaining and time.monotonic() < until:
            for board in remaining.copy():
                with suppress(Exception):
                    board.write_zero()
                    remaining.remove(board)
        self._boards = {}
        with suppress(Exception):
            port.reset_output_buffer()  # or closing may wait for the output
        with suppress(Exception):
            port.close()

    def _no_retry(self) -> bool:
        return self._leaving or self._stopping.is_set()


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

    moves_nothing: ClassVar[bool] = False

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
        until = time.monotonic() + 0.3
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
    tenths = 10.0 * settings.driver_timeout
    refusals = {
        "roboclaw_ports is empty, expected the serial port of each board": not ports,
        f"roboclaw_ports has {len(ports)}, expected one for two of the {coils} coils": 2 * len(ports) != coils,
        f"roboclaw_addresses has {len(addresses)}, expected one for each of the {len(ports)} roboclaw_ports, or none": (
            len(addresses) not in (0, len(ports))
        ),
        f"driver_timeout is {settings.driver_timeout:g}, expected tenths of a second": abs(tenths - round(tenths))
        > 1e-6,
        f"roboclaw_baud_rate is {settings.roboclaw_baud_rate}, expected at least {MIN_BAUD_RATE}, "
        "so that answers come in time": settings.roboclaw_baud_rate < MIN_BAUD_RATE,
    }
    for problem, is_so in refusals.items():
        if is_so:
            raise DriverError("roboclaw", problem)
    found: dict[str, dict[int, int]] = {}
    # A board is delivered with the address 128.
    for number, (path, address) in enumerate(zip(ports, addresses or [128] * len(ports), strict=True)):
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
