"""One board on a line: what is asked of it, and whether it does that."""

from __future__ import annotations

import logging
import termios
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import serial
from basicmicro import Basicmicro
from basicmicro.exceptions import BasicmicroError

from magnetosuture_thread.coils.drivers.roboclaw import rules
from magnetosuture_thread.coils.drivers.roboclaw.port import DeviceError, ExchangePort
from magnetosuture_thread.coils.drivers.roboclaw.rules import Question, Streak, Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings

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
        number: of the board; its coils have twice that number, and one more.
        address: on that port, 128 to 135.
        name: for a person.
        settings: of the bridge: greatest current, each coil's resistance, and after how long without a packet
            the board stops by itself.
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
        number: int,
        address: int,
        name: str,
        settings: CoilBridgeSettings,
        hurries: Callable[[], bool],
    ) -> None:
        self._port, self._address, self._name, self._hurries = port, address, name, hurries
        self._coils = (2 * number, 2 * number + 1)
        self._timeout = round(10.0 * settings.driver_timeout)  # in tenths of a second
        self._most, self._limit = settings.max_current, round(100.0 * settings.max_current)
        self._resistances = np.array(settings.resistances()[2 * number : 2 * number + 2])
        self._device: Any = Basicmicro(port.name, port.baudrate, retries=1)
        # Its own Open makes a port without a lock, and one that may keep its caller for a second.
        self._device._port = port
        self._device._connected = True
        self.version = ""
        self.voltage = 0.0
        self.currents = (0.0, 0.0)
        self._asked = (0.0, 0.0)
        self._written = (0, 0)
        self._signs = [1, 1]
        self._at = 0
        self._short = self._limited = False
        self._conditions: tuple[str, ...] = ()
        self._mismatches = Streak(rules.MISMATCHES)
        self._excesses = Streak(rules.EXCESSES)
        self._shortfalls = [Streak(rules.SHORTFALLS) for _ in self._coils]
        self._missing = ["", ""]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a person should know although it goes on."""
        found = list(self._conditions)
        if self._short:
            found.append(f"a supply of {self.voltage:g} V is too low for the currents")
        if self._limited:
            found.append("a current is at its limit")
        return (*(f"{self._name}: {warning}" for warning in found), *filter(None, self._missing))

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
        self._tell(self._device.SetM1MaxCurrent, self._limit, 0)
        self._tell(self._device.SetM2MaxCurrent, self._limit, 0)
        for question in (*rules.SET, Question.STATUS, *[Question.CURRENTS] * rules.EXCESSES, Question.VOLTAGES):
            self._poll(question)

    def write(self, newest: Callable[[], Vector | None]) -> None:
        """Ask for the newest currents of its two coils.

        They are taken anew before each attempt: what was right before the last one may be stopped by now.

        Args:
            newest: returns the currents that are to be given now, shape (2,) [A]; None is zero in both coils.

        Raises:
            DeviceError: it does not acknowledge that.
        """

        def wanted() -> tuple[int, ...]:
            currents = newest()
            duties, self._short = (
                ((0, 0), False) if currents is None else rules.duties(currents, self._resistances, self.voltage)
            )
            self._asked = (0.0, 0.0) if currents is None else (float(currents[0]), float(currents[1]))
            return duties

        first, second = self._exchange(self._device.DutyM1M2, wanted, self._acknowledged)[0]
        self._written = first, second
        # A board tells how much it drives a coil, not which way round.
        self._signs = [(d > 0) - (d < 0) or sign for d, sign in zip(self._written, self._signs, strict=True)]

    def write_zero(self) -> None:
        """Ask for no currents.

        Raises:
            DeviceError: it does not acknowledge that.
        """
        self.write(lambda: None)

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
        elif question is Question.TIMEOUT:
            tenths = tuple(round(10.0 * seconds) for seconds in self._ask(self._device.GetTimeout))
            self._verify("serial timeout in tenths of a second", tenths, (self._timeout,))
        elif question in (Question.LIMIT_1, Question.LIMIT_2):
            first = question is Question.LIMIT_1
            limits = self._ask(self._device.ReadM1MaxCurrent if first else self._device.ReadM2MaxCurrent)
            self._verify("current limit in 10 mA", limits[:1], (self._limit,))
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
            0.01 * raw * sign + 0.0  # -0 A is 0 A
            for raw, sign in zip(self._ask(self._device.ReadCurrents), self._signs, strict=True)
        )
        self.currents = (first, second)
        worst = max(self.currents, key=abs)
        if self._excesses.over(abs(worst) > rules.EXCESS * self._most):
            raise DeviceError(f"{self._name}: a current of {worst:.2f} A, more than {self._most:g} A")
        due = rules.settled(self._written, self._resistances, self.voltage)
        for channel, (coil, streak) in enumerate(zip(self._coils, self._shortfalls, strict=True)):
            measured, asked = self.currents[channel], self._asked[channel]
            if not streak.over(rules.falls_short(due[channel], measured)):
                self._missing[channel] = ""
            elif not self._missing[channel]:  # and then stays as it was found: else it changed with every answer
                self._missing[channel] = f"coil {coil}: {measured:.2f} A measured, {asked:.2f} A asked"

    def _check_status(self) -> None:
        (bits,) = self._ask(self._device.ReadError)
        known = {**Basicmicro.ERROR_DESCRIPTIONS, **rules.DRIVER_FAULTS}
        errors = rules.meanings(bits & 0xFFFF, known, "error")
        if errors:
            raise DeviceError(f"{self._name}: {', '.join(errors)}")
        self._conditions = rules.meanings(bits >> 16, Basicmicro.WARNING_DESCRIPTIONS, "warning")

    def _verify(self, what: str, got: tuple[Any, ...], expected: tuple[int, ...]) -> None:
        if got != expected:
            shown = [" and ".join(str(value) for value in values) for values in (got, expected)]
            raise DeviceError(f"{self._name}: {what} {shown[0]} instead of {shown[1]}")

    def _tell(self, call: Callable[..., Any], *values: float) -> None:
        self._exchange(call, lambda: values, self._acknowledged)

    def _acknowledged(self, result: Any) -> bool:
        return bool(result) and self._port.answer == ACKNOWLEDGED  # the library takes any byte for it

    def _ask(self, call: Callable[..., Any]) -> tuple[Any, ...]:
        result: tuple[Any, ...] = self._exchange(call, tuple, lambda result: bool(result[0]))[1]
        return result[1:]

    def _exchange(
        self, call: Callable[..., Any], values: Callable[[], tuple[Any, ...]], good: Callable[[Any], bool]
    ) -> tuple[tuple[Any, ...], Any]:
        """Return what was sent in the end, and what the library returned for it; each attempt asks what to send."""
        for attempt in range(TRIES):
            if attempt:
                if self._hurries():
                    break
                time.sleep(QUIET)
            sent = values()
            try:
                self._port.begin()
                result = call(self._address, *sent)
            except (BasicmicroError, serial.SerialException, OSError, termios.error):
                continue
            if good(result):
                return sent, result
        raise DeviceError(f"{self._name}: no valid answer to {call.__name__}")
