"""A simulated RoboClaw board and the two coils on it: bytes in, bytes out."""

from __future__ import annotations

import math
import struct
from collections import deque

from magnetosuture_thread.rig.power import packets
from magnetosuture_thread.rig.power.packets import Parser

FULL = 32767  # duty of the whole supply voltage
VERSION = b"RoboClaw simulated 2x15A v4.2.4\n\x00"
FACTORY_LIMIT = 3000  # in units of 10 mA
FACTORY_TIMEOUT = 0  # none
EMERGENCY_STOP = 0x0001
AT_LIMIT = 0.999
KEPT = 10_000


class RoboClawBoard:
    """What a board does with the packets for it, and what its coils do with the duties. Time comes in [s].

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
        self.address = address
        self.supply, self.resistance, self.inductance = supply, resistance, inductance
        self.duties = (0, 0)
        self.currents = (0.0, 0.0)
        self.timeout = FACTORY_TIMEOUT
        self.limits = [FACTORY_LIMIT, FACTORY_LIMIT]
        self.errors = self.warnings = 0
        self.ignored: set[int] = set()
        self.mismeasured = 0.0
        self.broken: set[int] = set()
        self.timeline: deque[tuple[float, tuple[int, int]]] = deque(maxlen=KEPT)
        self.heard = -math.inf
        self._parser = Parser()
        self._time = -math.inf

    def receive(self, data: bytes, time: float) -> bytes:
        """Receive bytes from the line and return the answers."""
        self.advance(time)
        answers = b""
        for packet in self._parser.feed(data, time):
            if packet[0] == self.address:
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
        self.timeout = FACTORY_TIMEOUT
        self.limits = [FACTORY_LIMIT, FACTORY_LIMIT]
        self._parser = Parser()

    @property
    def outputs(self) -> tuple[int, int]:
        """What is left of the duties where a coil is at its limit."""
        first, second = (self._output(channel) for channel in (0, 1))
        return first, second

    def _output(self, channel: int) -> int:
        duty, limit = self.duties[channel], 0.01 * self.limits[channel]
        if abs(self.currents[channel]) < AT_LIMIT * limit or duty * self.currents[channel] <= 0.0:
            return duty
        most = FULL * limit * self.resistance / self.supply
        return round(max(-most, min(most, duty)))

    def _move(self, time: float) -> None:
        if time <= self._time:
            return
        share = math.exp(-(time - self._time) * self.resistance / self.inductance)
        moved = []
        for channel, (current, duty, limit) in enumerate(zip(self.currents, self.duties, self.limits, strict=True)):
            goal = duty / FULL * self.supply / self.resistance
            limited = max(-0.01 * limit, min(0.01 * limit, goal + (current - goal) * share))
            moved.append(0.0 if channel in self.broken else limited)
        self.currents = (moved[0], moved[1])
        self._time = time

    def _set(self, duties: tuple[int, int], time: float) -> None:
        if duties != self.duties:
            self.duties = duties
            self.timeline.append((time, duties))

    def _handle(self, packet: bytes) -> bytes:
        command = packet[1]
        if command in packets.QUESTIONS:
            self.heard = self._time
            return packets.answer(self.address, command, self._data(command))
        if packets.checksum(packet[:-2]) != struct.unpack(">H", packet[-2:])[0]:
            return b""
        self.heard = self._time
        if command not in self.ignored:
            self._obey(command, struct.unpack(packets.ARGUMENTS[command], packet[2:-2]))
        return packets.ACKNOWLEDGED

    def _obey(self, command: int, values: tuple[int, ...]) -> None:
        if command == packets.SET_TIMEOUT:
            self.timeout = values[0]
        elif command in (packets.SET_LIMIT_1, packets.SET_LIMIT_2):
            self.limits[command - packets.SET_LIMIT_1] = values[0]
        elif command == packets.RESET_STOP:
            self.errors &= ~EMERGENCY_STOP
        elif not self.errors:
            first = values[0] if command != packets.SET_DUTY_2 else self.duties[0]
            second = values[-1] if command != packets.SET_DUTY_1 else self.duties[1]
            self._set((first, second), self._time)

    def _data(self, command: int) -> bytes:
        """Return what the answer to a question says."""
        if command == packets.GET_VERSION:
            return VERSION
        if command == packets.GET_TIMEOUT:
            return bytes((self.timeout,))
        if command == packets.GET_STATUS:
            return struct.pack(">I", self.warnings << 16 | self.errors)
        if command in (packets.GET_LIMIT_1, packets.GET_LIMIT_2):
            return struct.pack(">II", self.limits[command - packets.GET_LIMIT_1], 0)
        if command == packets.GET_DUTIES:
            return struct.pack(">hh", *self.outputs)
        if command == packets.GET_CURRENTS:
            return struct.pack(">hh", *(self._reported(channel) for channel in (0, 1)))
        volts, logic = struct.pack(">H", round(10.0 * self.supply)), struct.pack(">H", 50)
        return {
            packets.GET_MAIN_VOLTAGE: volts,
            packets.GET_LOGIC_VOLTAGE: logic,
            packets.GET_VOLTAGES: volts + logic,
            packets.GET_TEMPERATURE: struct.pack(">H", 250),
        }[command]

    def _reported(self, channel: int) -> int:
        """Return the current that it reports, in units of 10 mA."""
        current, duty = self.currents[channel], self.duties[channel]
        driven = math.copysign(current, current * duty) if duty else abs(current)
        return max(-0x8000, min(0x7FFF, round(100.0 * (driven + self.mismeasured))))
