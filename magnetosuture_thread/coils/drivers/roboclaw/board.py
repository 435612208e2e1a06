"""A RoboClaw board on a serial line: commands, queries and verification."""

from __future__ import annotations

import logging
import math
import termios
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import serial
from basicmicro import Basicmicro
from basicmicro.exceptions import BasicmicroError

from magnetosuture_thread.coils.drivers.roboclaw import protocol
from magnetosuture_thread.coils.drivers.roboclaw.port import DeviceError, ExchangePort
from magnetosuture_thread.coils.drivers.roboclaw.protocol import ConsecutiveCounter, Query, Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings

ACK = b"\xff"
MAX_ATTEMPTS = 2
# Pause after a failure, in which the board drops a partial packet.
RETRY_DELAY = 0.015  # s

# The library logs every missing byte, a hundred times a second for a dead board; the driver reports the problem
# in its state. A level that was set before is kept.
_library = logging.getLogger("basicmicro")
if _library.level == logging.NOTSET:
    _library.setLevel(logging.CRITICAL)


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
        self._coils = (2 * number, 2 * number + 1)
        self._timeout = round(10.0 * settings.driver_timeout)  # in tenths of a second
        self._max_current, self._limit = settings.max_current, round(100.0 * settings.max_current)
        self._resistances = np.array(settings.resistances()[2 * number : 2 * number + 2])
        self._device: Any = Basicmicro(port.name, port.baudrate, retries=1)
        # Its own Open makes a port without a lock, and one that may keep its caller for a second.
        self._device._port = port
        self._device._connected = True
        self.version = ""
        self.voltage = 0.0
        self.currents = (0.0, 0.0)
        self._commanded = (0.0, 0.0)
        self._expires = math.inf  # of the values of an exchange
        self._written = (0, 0)
        self._signs = [1, 1]
        self._poll_index = 0
        self._supply_too_low = self._limited = False
        self._conditions: tuple[str, ...] = ()
        self._mismatches = ConsecutiveCounter(protocol.MAX_MISMATCHES)
        self._excesses = ConsecutiveCounter(protocol.MAX_OVERCURRENTS)
        self._supply_too_lowfalls = [ConsecutiveCounter(protocol.MAX_SHORTFALLS) for _ in self._coils]
        self._coil_warnings = ["", ""]

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
        self._verify("duties", self._query(self._device.ReadPWMs), (0, 0))
        # Half a tenth is added, as the library truncates; zero would disable the timeout.
        self._set(self._device.SetTimeout, 0.1 * (self._timeout + 0.5))
        self._set(self._device.SetM1MaxCurrent, self._limit, 0)
        self._set(self._device.SetM2MaxCurrent, self._limit, 0)
        first_currents = [Query.CURRENTS] * protocol.MAX_OVERCURRENTS
        for query in (*protocol.SETTING_QUERIES, Query.STATUS, *first_currents, Query.VOLTAGES):
            self._poll(query)

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
                ((0, 0), False) if currents is None else protocol.duties_for(currents, self._resistances, self.voltage)
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
        self._poll(protocol.POLL_SEQUENCE[self._poll_index])
        if not self._mismatches.count:  # else the same query again, at once
            self._poll_index = (self._poll_index + 1) % len(protocol.POLL_SEQUENCE)

    def _poll(self, query: Query) -> None:
        if query is Query.DUTIES:
            self._check_duties()
        elif query is Query.CURRENTS:
            self._check_currents()
        elif query is Query.STATUS:
            self._check_status()
        elif query is Query.TIMEOUT:
            tenths = tuple(round(10.0 * seconds) for seconds in self._query(self._device.GetTimeout))
            self._verify("serial timeout in tenths of a second", tenths, (self._timeout,))
        elif query in (Query.LIMIT_1, Query.LIMIT_2):
            first = query is Query.LIMIT_1
            limits = self._query(self._device.ReadM1MaxCurrent if first else self._device.ReadM2MaxCurrent)
            self._verify("current limit in 10 mA", limits[:1], (self._limit,))
        else:
            self.voltage = self._query(self._device.GetVolts)[0] / 10.0
            if not protocol.is_plausible_supply(self.voltage):
                raise DeviceError(f"{self._name}: a supply of {self.voltage:g} V")

    def _check_duties(self) -> None:
        reported = self._query(self._device.ReadPWMs)
        matches = tuple(reported) == self._written
        if not matches:
            self._check_currents()
            matches = protocol.duties_match(self._written, reported, self.currents, self._max_current)
        self._limited = matches and any(
            abs(w - r) > protocol.DUTY_TOLERANCE for w, r in zip(self._written, reported, strict=True)
        )
        if self._mismatches.update(not matches):
            raise DeviceError(f"{self._name}: has duties {tuple(reported)} instead of {self._written}")

    def _check_currents(self) -> None:
        first, second = (
            0.01 * raw * sign + 0.0  # -0 A is 0 A
            for raw, sign in zip(self._query(self._device.ReadCurrents), self._signs, strict=True)
        )
        self.currents = (first, second)
        worst = max(self.currents, key=abs)
        if self._excesses.update(abs(worst) > protocol.OVERCURRENT_RATIO * self._max_current):
            raise DeviceError(f"{self._name}: a current of {worst:.2f} A, more than {self._max_current:g} A")
        expected = protocol.steady_currents(self._written, self._resistances, self.voltage)
        for channel, (coil, counter) in enumerate(zip(self._coils, self._supply_too_lowfalls, strict=True)):
            measured, commanded = self.currents[channel], self._commanded[channel]
            if not counter.update(protocol.is_short(expected[channel], measured)):
                self._coil_warnings[channel] = ""
            elif not self._coil_warnings[channel]:  # keeps the first text, which would change with every answer
                self._coil_warnings[channel] = f"coil {coil}: {measured:.2f} A measured, {commanded:.2f} A commanded"

    def _check_status(self) -> None:
        (bits,) = self._query(self._device.ReadError)
        known = {**Basicmicro.ERROR_DESCRIPTIONS, **protocol.DRIVER_FAULTS}
        errors = protocol.describe_bits(bits & 0xFFFF, known, "error")
        if errors:
            raise DeviceError(f"{self._name}: {', '.join(errors)}")
        self._conditions = protocol.describe_bits(bits >> 16, Basicmicro.WARNING_DESCRIPTIONS, "warning")

    def _verify(self, what: str, got: tuple[Any, ...], expected: tuple[int, ...]) -> None:
        if got != expected:
            shown = [" and ".join(str(value) for value in values) for values in (got, expected)]
            raise DeviceError(f"{self._name}: {what} {shown[0]} instead of {shown[1]}")

    def _set(self, call: Callable[..., Any], *values: float) -> None:
        self._exchange(call, lambda: values, self._acknowledged)

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
        time.sleep(RETRY_DELAY)
        self._expires = math.inf
        result = self._attempt(self._device.ReadMainBatteryVoltage, self._address)  # no such answer begins with an ACK
        self._port.is_drained = result is not None and bool(result[0])
        return self._port.is_drained
