"""One board on a line: what is asked of it, and whether it does that."""

from __future__ import annotations

import logging
import termios
import time
from collections.abc import Callable
from typing import Any

import serial
from basicmicro import Basicmicro
from basicmicro.exceptions import BasicmicroError

from magnetosuture_thread.coils.drivers.roboclaw import rules
from magnetosuture_thread.coils.drivers.roboclaw.port import DeviceError, ExchangePort
from magnetosuture_thread.coils.drivers.roboclaw.rules import Question, Streak, Vector

ACKNOWLEDGED = b"\xff"
TRIES = 2
# After a failure the line is left alone for so long: the board forgets what it has of a packet, and an answer
# that is only a little late comes in and is thrown away.
QUIET = 0.015  # s

# The library reports every byte that is missing, a hundred times a second where a board is dead; the driver
# says in its state what is wrong. Who has set a level before wants to see it.
_library = logging.getLogger("basicmicro")
if _library.level == logging.NOTSET:
    _library.setLevel(logging.CRITICAL)


class Board:
    """A board with two coils.

    Args:
        port: that it is on.
        address: on that port, 128 to 135.
        name: for a person.
        timeout: without a packet for this long it stops by itself, in tenths of a second.
        max_current: greatest current in a coil [A].
        resistance: of a coil [ohm].
        hurries: tells whether there is no time to try anything twice.

    Attributes:
        version: what it calls itself.
        voltage: of its supply [V].
        currents: measured in its two coils [A].
        warnings: what a person should know.
    """

    def __init__(
        self,
        port: ExchangePort,
        address: int,
        name: str,
        timeout: int,
        max_current: float,
        resistance: float,
        hurries: Callable[[], bool],
    ) -> None:
        self._port, self._address, self._name, self._hurries = port, address, name, hurries
        self._timeout, self._most, self._resistance = timeout, max_current, resistance
        self._device: Any = Basicmicro(port.name, port.baudrate, retries=1)
        # Its own Open makes a port without a lock, and one that may keep its caller for a second.
        self._device._port = port
        self._device._connected = True
        self.version = ""
        self.voltage = 0.0
        self.currents = (0.0, 0.0)
        self._written = (0, 0)
        self._signs = [1, 1]
        self._at = 0
        self._short = self._limited = False
        self._conditions: tuple[str, ...] = ()
        self._mismatches = Streak(rules.MISMATCHES)
        self._excesses = Streak(rules.EXCESSES)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a person should know although it goes on."""
        found = list(self._conditions)
        if self._short:
            found.append(f"a supply of {self.voltage:g} V is too low for the currents")
        if self._limited:
            found.append("a current is at its limit")
        return tuple(f"{self._name}: {warning}" for warning in found)

    def set_up(self) -> None:
        """Set all currents to zero and all limits, and verify each.

        Raises:
            DeviceError: it does not do what it should.
        """
        (self.version,) = self._ask(self._device.ReadVersion)
        self.write_zero()
        self._verify("duties", self._ask(self._device.ReadPWMs), (0, 0))
        # A half more, as the library cuts off what is left of a tenth; zero would switch the timeout off.
        self._tell(self._device.SetTimeout, 0.1 * (self._timeout + 0.5))
        tenths = tuple(round(10.0 * seconds) for seconds in self._ask(self._device.GetTimeout))
        self._verify("serial timeout in tenths of a second", tenths, (self._timeout,))
        limit = round(100.0 * self._most)
        for tell, ask in (
            (self._device.SetM1MaxCurrent, self._device.ReadM1MaxCurrent),
            (self._device.SetM2MaxCurrent, self._device.ReadM2MaxCurrent),
        ):
            self._tell(tell, limit, 0)
            self._verify("current limit in 10 mA", self._ask(ask)[:1], (limit,))
        for question in (Question.STATUS, *[Question.CURRENTS] * rules.EXCESSES, Question.VOLTAGES):
            self._poll(question)

    def write(self, currents: Vector) -> None:
        """Ask for the currents of its two coils, shape (2,) [A].

        Raises:
            DeviceError: it does not acknowledge that.
        """
        wanted, self._short = rules.duties(currents, self._resistance, self.voltage)
        self._write((wanted[0], wanted[1]))

    def write_zero(self) -> None:
        """Ask for no currents.

        Raises:
            DeviceError: it does not acknowledge that.
        """
        self._short = False
        self._write((0, 0))

    def poll(self) -> None:
        """Ask it what is next in turn.

        Raises:
            DeviceError: it does not answer, or something is wrong with it.
        """
        self._poll(rules.ROUND[self._at])
        if not self._mismatches.count:  # else the same again, at once
            self._at = (self._at + 1) % len(rules.ROUND)

    def _poll(self, question: Question) -> None:
        if question is Question.DUTIES:
            self._check_duties()
        elif question is Question.CURRENTS:
            self._check_currents()
        elif question is Question.STATUS:
            self._check_status()
        else:
            self.voltage = self._ask(self._device.GetVolts)[0] / 10.0
            if not rules.plausible(self.voltage):
                raise DeviceError(f"{self._name}: a supply of {self.voltage:g} V")

    def _check_duties(self) -> None:
        has = self._ask(self._device.ReadPWMs)
        right = tuple(has) == self._written
        if not right:
            self._check_currents()
            right = rules.holds(self._written, has, self.currents, self._most)
        self._limited = right and any(abs(w - h) > rules.ROUNDED for w, h in zip(self._written, has, strict=True))
        if self._mismatches.over(not right):
            raise DeviceError(f"{self._name}: has duties {tuple(has)} instead of {self._written}")

    def _check_currents(self) -> None:
        first, second = (
            0.01 * raw * sign for raw, sign in zip(self._ask(self._device.ReadCurrents), self._signs, strict=True)
        )
        self.currents = (first, second)
        worst = max(self.currents, key=abs)
        if self._excesses.over(abs(worst) > rules.EXCESS * self._most):
            raise DeviceError(f"{self._name}: a current of {worst:.2f} A, more than {self._most:g} A")

    def _check_status(self) -> None:
        (bits,) = self._ask(self._device.ReadError)
        known = {**Basicmicro.ERROR_DESCRIPTIONS, **rules.DRIVER_FAULTS}
        errors = rules.meanings(bits & 0xFFFF, known, "error")
        if errors:
            raise DeviceError(f"{self._name}: {', '.join(errors)}")
        self._conditions = rules.meanings(bits >> 16, Basicmicro.WARNING_DESCRIPTIONS, "warning")

    def _write(self, wanted: tuple[int, int]) -> None:
        self._tell(self._device.DutyM1M2, *wanted)
        self._written = wanted
        # A board tells how much it drives a coil, not which way round.
        self._signs = [(d > 0) - (d < 0) or sign for d, sign in zip(wanted, self._signs, strict=True)]

    def _verify(self, what: str, got: tuple[Any, ...], expected: tuple[int, ...]) -> None:
        if got != expected:
            shown = [" and ".join(str(value) for value in values) for values in (got, expected)]
            raise DeviceError(f"{self._name}: {what} {shown[0]} instead of {shown[1]}")

    def _tell(self, call: Callable[..., Any], *values: float) -> None:
        # The library takes any byte for an acknowledgement.
        self._exchange(call, values, lambda result: bool(result) and self._port.answer == ACKNOWLEDGED)

    def _ask(self, call: Callable[..., Any]) -> tuple[Any, ...]:
        result: tuple[Any, ...] = self._exchange(call, (), lambda result: bool(result[0]))
        return result[1:]

    def _exchange(self, call: Callable[..., Any], values: tuple[float, ...], good: Callable[[Any], bool]) -> Any:
        for attempt in range(TRIES):
            if attempt:
                if self._hurries():
                    break
                time.sleep(QUIET)
            try:
                self._port.begin()
                result = call(self._address, *values)
            except (BasicmicroError, serial.SerialException, OSError, termios.error):
                continue
            if good(result):
                return result
        raise DeviceError(f"{self._name}: no valid answer to {call.__name__}")
