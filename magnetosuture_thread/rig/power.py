"""The rig's power stage: simulated RoboClaw boards, behind pseudo-terminals, in a process of their own.

Nothing here knows the maker's library. Real boards answer while the computer is busy. In the process of the rig's node
they could not: rclpy holds the interpreter while DDS publishes, for up to 0.3 s, where a process that reads the message
lost the processor. A driver takes such a board for dead.
"""

from __future__ import annotations

import binascii
import math
import os
import select
import struct
import threading
import time
import tty
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from enum import IntEnum
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import numpy as np

from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.settings.errors import ConfigurationError, GraphError

ACKNOWLEDGED = b"\xff"
ADDRESSES = range(0x80, 0x88)


class Command(IntEnum):
    """The commands of the maker's protocol that a driver of coils needs."""

    SET_TIMEOUT = 14
    GET_TIMEOUT = 15
    GET_VERSION = 21
    GET_MAIN_VOLTAGE = 24
    SET_DUTIES = 34
    GET_DUTIES = 48
    GET_CURRENTS = 49
    GET_STATUS = 90
    GET_VOLTAGES = 100
    SET_LIMIT_1 = 133
    SET_LIMIT_2 = 134
    GET_LIMIT_1 = 135
    GET_LIMIT_2 = 136


COMMANDS = frozenset(Command)
# What each command that changes something carries, between command and checksum. The others come without a checksum.
ARGUMENTS: dict[int, str] = {
    Command.SET_TIMEOUT: ">B",
    Command.SET_DUTIES: ">hh",
    Command.SET_LIMIT_1: ">II",
    Command.SET_LIMIT_2: ">II",
}

FULL = 32767  # duty of the whole supply voltage
FACTORY_LIMITS = (3000, 3000)  # of the currents, in units of 10 mA


class RoboClawBoard:
    """A board: its answers to packets, and the currents that its duties give. Time comes in [s].

    A coil's current follows L di/dt = d U - R i, with the duty d from -1 to 1, the supply's voltage U, and
    resistance R and inductance L of the coil; the board takes back the duty of a coil at its current limit.
    Without a packet for longer than its serial timeout, it sets both duties to zero.

    Source: Basicmicro, "RoboClaw Series User Manual", packet serial. Deviation: the sign of a current that it
    reports is not documented; here it is positive while the board drives it and negative while it flows back.

    Args:
        address: on its line, 0x80 to 0x87.
        supply: [V]
        resistance: of each coil [ohm].
        inductance: of each coil [H].

    Attributes:
        duties: in force, from -32767 to 32767.
        currents: in the two coils [A].
        charges: that have flowed through them, the integrals of the currents [A s].
        timeout: of the serial line, in tenths of a second; 0 is none.
        limits: of the currents, in units of 10 mA.
        errors: bits that stop it, as in its status.
        warnings: bits that do not.
        ignored: commands that it acknowledges and does not obey.
        mismeasured: what it adds to the currents it reports [A].
        broken: channels, 0 or 1, whose coil has a broken wire and so no current.
        timeline: when the duties changed, and to what.
        heard: when the last packet for it came.
    """

    def __init__(
        self, address: int = 0x80, supply: float = 24.0, resistance: float = 1.0, inductance: float = 0.01
    ) -> None:
        self.address, self.supply, self.resistance, self.inductance = address, supply, resistance, inductance
        self.duties, self.currents, self.charges = (0, 0), (0.0, 0.0), (0.0, 0.0)
        self.timeout, self.limits = 0, [*FACTORY_LIMITS]
        self.errors = self.warnings = 0
        self.ignored, self.broken = set[int](), set[int]()
        self.mismeasured = 0.0
        self.timeline: deque[tuple[float, tuple[int, int]]] = deque(maxlen=10_000)
        self.heard = -math.inf
        self._buffer, self._received, self._time = b"", -math.inf, -math.inf

    def receive(self, data: bytes, time: float) -> bytes:
        """Receive bytes from the line and return the answers."""
        self.advance(time)
        # A packet that is not complete is forgotten after a gap of 10 ms.
        self._buffer = data if time - self._received > 0.01 else self._buffer + data
        self._received, answers = time, b""
        while len(self._buffer) > 1:
            address, command = self._buffer[:2]
            if address not in ADDRESSES:
                self._buffer = self._buffer[1:]
                continue
            if command not in COMMANDS:  # nobody can tell where it ends
                self._buffer = b""
                break
            size = 4 + struct.calcsize(ARGUMENTS[command]) if command in ARGUMENTS else 2
            if len(self._buffer) < size:
                break
            packet, self._buffer = self._buffer[:size], self._buffer[size:]
            if address == self.address:
                answers += self._handle(packet)
        return answers

    def advance(self, time: float) -> None:
        """Let the coils' currents follow up to a time; nothing happens for one that is past."""
        if self.errors:
            self._set((0, 0), self._time)
        off_at = self.heard + 0.1 * self.timeout
        if self.timeout and any(self.duties) and off_at <= time:
            self._move(off_at)
            self._set((0, 0), self._time)
        self._move(time)

    def power_cycle(self) -> None:
        """Let its supply go and come back at once: duties zero, timeout and limits as it was delivered."""
        self._set((0, 0), self._time)
        self.timeout, self.limits = 0, [*FACTORY_LIMITS]
        self._buffer = b""

    def _move(self, time: float) -> None:
        if time <= self._time:
            return
        span, currents, charges = time - self._time, [0.0, 0.0], [*self.charges]
        share = math.exp(-span * self.resistance / self.inductance)
        for channel in {0, 1} - self.broken:
            current, limit = self.currents[channel], 0.01 * self.limits[channel]
            goal = self.duties[channel] / FULL * self.supply / self.resistance
            currents[channel] = max(-limit, min(limit, goal + (current - goal) * share))
            if span < math.inf:
                charges[channel] += self._charge(current, goal, limit, span)
        self.currents, self.charges, self._time = (currents[0], currents[1]), (charges[0], charges[1]), time

    def _charge(self, current: float, goal: float, limit: float, span: float) -> float:
        """Return the charge of a coil whose current goes from one to a goal, as far as its limit [A s]."""
        tau, at_limit = self.inductance / self.resistance, math.copysign(limit, goal)
        rises = span
        if abs(goal) > limit:
            # Its limit may be lower than a current that flows.
            left = max(0.0, (at_limit - current) / (goal - current)) if goal != current else 0.0
            rises = min(span, -tau * math.log1p(-left))
        return goal * rises + (current - goal) * tau * -math.expm1(-rises / tau) + at_limit * (span - rises)

    def _set(self, duties: tuple[int, int], time: float) -> None:
        if duties != self.duties:
            self.duties = duties
            self.timeline.append((time, duties))

    def _handle(self, packet: bytes) -> bytes:
        """Return the answer to a packet, once it is done what it asks for; a question's has a checksum of both."""
        command = packet[1]
        if command not in ARGUMENTS:
            self.heard = self._time
            data = self._data(command)
            return data + struct.pack(">H", checksum(bytes((self.address, command)) + data))
        if checksum(packet[:-2]) != struct.unpack(">H", packet[-2:])[0]:
            return b""
        self.heard = self._time
        values = struct.unpack(ARGUMENTS[command], packet[2:-2])
        if command in self.ignored or (command == Command.SET_DUTIES and self.errors):
            return ACKNOWLEDGED
        if command == Command.SET_TIMEOUT:
            (self.timeout,) = values
        elif command == Command.SET_DUTIES:
            self._set(values, self._time)
        else:
            self.limits[command - Command.SET_LIMIT_1] = values[0]
        return ACKNOWLEDGED

    def _data(self, command: int) -> bytes:
        """Return what the answer to a question says."""
        volts = round(10.0 * self.supply)
        answers: dict[int, bytes] = {
            Command.GET_TIMEOUT: bytes((self.timeout,)),
            Command.GET_VERSION: b"RoboClaw simulated 2x15A v4.2.4\n\x00",
            Command.GET_MAIN_VOLTAGE: struct.pack(">H", volts),
            Command.GET_DUTIES: struct.pack(">hh", *map(self._output, (0, 1))),
            Command.GET_CURRENTS: struct.pack(">hh", *map(self._reported, (0, 1))),
            Command.GET_STATUS: struct.pack(">I", self.warnings << 16 | self.errors),
            Command.GET_VOLTAGES: struct.pack(">HH", volts, 50),
            Command.GET_LIMIT_1: struct.pack(">II", self.limits[0], 0),
            Command.GET_LIMIT_2: struct.pack(">II", self.limits[1], 0),
        }
        return answers[command]

    def _output(self, channel: int) -> int:
        """Return what is left of a duty where its coil is at the limit."""
        duty, limit = self.duties[channel], 0.01 * self.limits[channel]
        if abs(self.currents[channel]) < 0.999 * limit or duty * self.currents[channel] <= 0.0:
            return duty
        most = FULL * limit * self.resistance / self.supply
        return round(max(-most, min(most, duty)))

    def _reported(self, channel: int) -> int:
        """Return the current that it reports, in units of 10 mA."""
        current, duty = self.currents[channel], self.duties[channel]
        driven = math.copysign(current, current * duty) if duty else abs(current)
        return max(-0x8000, min(0x7FFF, round(100.0 * (driven + self.mismeasured))))


def checksum(data: bytes) -> int:
    """Return the CRC-16 of a packet, of the polynomial x^16 + x^12 + x^5 + 1, from zero and not reflected.

    Source: Basicmicro, "RoboClaw Series User Manual", packet serial. Deviation: none.

    >>> hex(checksum(b"123456789"))
    '0x31c3'
    """
    return binascii.crc_hqx(data, 0)


class Line:
    """Serves boards on a pseudo-terminal, by a worker; the path is a symbolic link to it.

    It stands in for hardware, and so, unlike the rest of the rig, it reads a clock and waits.

    Args:
        path: where the line is to be found.
        boards: on it, each with an address of its own.

    Attributes:
        boards: on it; look at them while holding `lock`.
    """

    def __init__(self, path: str | Path, boards: Sequence[RoboClawBoard]) -> None:
        self.path, self.boards, self.lock = Path(path), tuple(boards), threading.Lock()
        self._ends = threading.Event()
        self._worker: threading.Thread | None = None
        self._host = self._device = -1

    def plug(self) -> None:
        """Let the line be found, and serve it; harmless if it already is.

        Raises:
            ConfigurationError: the path cannot be a symbolic link.
        """
        if self._worker is not None:
            return
        self._host, self._device = os.openpty()
        # Held open here, so that the line does not hang up while nobody else has it.
        tty.setraw(self._device)
        os.set_blocking(self._host, False)
        try:
            if self.path.exists() and not self.path.is_symlink():
                raise FileExistsError(17, "there is something else")
            link = self.path.with_name(f".{self.path.name}.{os.getpid()}")
            link.unlink(missing_ok=True)
            link.symlink_to(os.ttyname(self._device))
            link.replace(self.path)
        except OSError as error:
            self._shut()
            expectation = f"a path for a symbolic link ({error.strerror})"
            raise ConfigurationError("rig_simulator.power_stage_ports", str(self.path), expectation) from None
        self._ends.clear()
        self._worker = threading.Thread(target=self._serve, name=f"line {self.path}", daemon=True)
        self._worker.start()

    def unplug(self) -> None:
        """Remove the line; its boards keep their state. No effect if there is none."""
        if self._worker is None:
            return
        self._ends.set()
        self._worker.join()
        self._worker = None
        with suppress(OSError):
            if os.readlink(self.path) == os.ttyname(self._device):  # else somebody else has put his own there
                self.path.unlink()
        self._shut()

    def advance(self) -> None:
        """Let the boards be where they are now."""
        with self.lock:
            for board in self.boards:
                board.advance(time.monotonic())

    def _shut(self) -> None:
        os.close(self._host)
        os.close(self._device)

    def _serve(self) -> None:
        while not self._ends.is_set():
            # The boards' own timeouts are looked at every 10 ms.
            readable, _, _ = select.select([self._host], [], [], 0.01)
            if readable:
                with suppress(OSError):  # nobody reads, and the line is full
                    data, now = os.read(self._host, 4096), time.monotonic()
                    with self.lock:
                        answers = [board.receive(data, now) for board in self.boards]
                    for answer in filter(None, answers):
                        os.write(self._host, answer)
            self.advance()


def board_addresses(boards: int) -> list[int]:
    """Return the addresses of so many boards: different ones, as far as there are that many."""
    return [ADDRESSES[index % len(ADDRESSES)] for index in range(boards)]


class PowerStage:
    """Boards with two coils each, in the order of their ports.

    Args:
        ports: the path at which each board is to be found; boards with the same path share a line. Their addresses
            are `board_addresses`.
        supply: of each board [V].
        resistance: of each coil [ohm].
        inductance: of each coil [H].

    Attributes:
        boards: in the order of their ports.
        lines: in the order of their first boards.
    """

    def __init__(self, ports: Sequence[str], supply: float, resistance: float, inductance: float) -> None:
        coil = supply, resistance, inductance
        self.boards = [RoboClawBoard(address, *coil) for address in board_addresses(len(ports))]
        paths = list(zip(ports, self.boards, strict=True))
        self.lines = [Line(path, [board for at, board in paths if at == path]) for path in dict.fromkeys(ports)]

    def open(self) -> None:
        """Let the boards be found.

        Raises:
            ConfigurationError: a path cannot be used.
        """
        try:
            for line in self.lines:
                line.plug()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the lines."""
        for line in self.lines:
            line.unplug()

    def charges(self) -> tuple[float, list[float]]:
        """Return a monotonic time [s], and the charges that have flowed through the coils until then [A s]."""
        with ExitStack() as locks:
            for line in self.lines:
                locks.enter_context(line.lock)
            now = time.monotonic()
            for board in self.boards:
                board.advance(now)
            return now, [charge for board in self.boards for charge in board.charges]


class StageProcess:
    """Runs a power stage elsewhere, and reads its currents; the boards go when this process does, whatever ends it.

    They are read as charges: what reads late, or at odd times, loses nothing of what has flowed meanwhile.

    Args:
        ports: the path at which each board is to be found, as `PowerStage` takes them.
        supply: of each board [V].
        resistance: of each coil [ohm].
        inductance: of each coil [H].
    """

    def __init__(self, ports: Sequence[str], supply: float, resistance: float, inductance: float) -> None:
        self._arguments = list(ports), supply, resistance, inductance
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._read = (0.0, np.zeros(2 * len(ports)))  # last time [s], and the charges until then

    @property
    def pid(self) -> int | None:
        """Number of the process, None without one."""
        return self._process.pid if self._process else None

    def open(self) -> None:
        """Start the process, and wait until its boards can be found.

        Raises:
            ConfigurationError: a path cannot be used.
            GraphError: the process ended.
        """
        context = get_context("spawn")
        self._pipe, end = context.Pipe()
        self._process = context.Process(target=_serve, args=(end, *self._arguments), daemon=True)
        self._process.start()
        end.close()
        if (problem := self._receive()) is not None:
            self.close()
            raise ConfigurationError(*problem)
        self._read = time.monotonic(), np.zeros(2 * len(self._arguments[0]))

    def close(self) -> None:
        """Take the boards away; harmless if there are none."""
        if self._process is None or self._pipe is None:
            return
        self._pipe.close()  # which ends it
        self._process.join(5.0)  # s
        self._process.kill()
        self._process.join()
        self._process = self._pipe = None

    def currents(self) -> tuple[Vector, float]:
        """Return the coils' mean currents since the last call, shape (2 boards,) [A], and until when [s].

        Raises:
            GraphError: the boards are not open, or the process ended.
        """
        if self._pipe is not None:
            with suppress(OSError):  # receiving tells
                self._pipe.send(None)
        now, flowed = self._receive()
        (before, known), self._read = self._read, (now, np.asarray(flowed))
        return (self._read[1] - known) / (now - before), now

    def _receive(self) -> Any:
        if self._pipe is None or self._process is None:
            raise GraphError("the simulated boards are not open")
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode
            raise GraphError(f"the process with the simulated boards ended (exit code {code})") from None


def _serve(pipe: Connection, ports: Sequence[str], supply: float, resistance: float, inductance: float) -> None:
    """Open a stage, send how that went, and its charges as often as asked, until nobody can ask any more."""
    os.setsid()  # Ctrl-C is for the rig, which then takes the boards away
    with suppress(OSError):  # only some may
        # Above what nodes have by default, with which boards would not share a processor; threads inherit it.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(11))
    stage = PowerStage(ports, supply, resistance, inductance)
    try:
        stage.open()
    except ConfigurationError as error:
        pipe.send((error.name, error.value, error.expectation))
        return
    with suppress(EOFError, OSError):  # who asked is gone
        pipe.send(None)
        while True:
            pipe.recv()
            pipe.send(stage.charges())
    stage.close()
