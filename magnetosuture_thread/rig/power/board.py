"""A simulated RoboClaw board and the two coils on it: packets in, answers out.

Nothing here knows the maker's library.
"""

from __future__ import annotations

import math
import struct
from collections import deque

ACKNOWLEDGED = b"\xff"
ADDRESSES = range(0x80, 0x88)
PACKET_GAP = 0.01  # s between two bytes, after which a packet that is not complete is forgotten

SET_TIMEOUT, GET_TIMEOUT, GET_VERSION = 14, 15, 21
GET_MAIN_VOLTAGE, GET_LOGIC_VOLTAGE, GET_VOLTAGES = 24, 25, 100
SET_DUTY_1, SET_DUTY_2, SET_DUTIES = 32, 33, 34
GET_DUTIES, GET_CURRENTS, GET_TEMPERATURE, GET_STATUS = 48, 49, 82, 90
SET_LIMIT_1, SET_LIMIT_2, GET_LIMIT_1, GET_LIMIT_2 = 133, 134, 135, 136
RESET_STOP = 200

# What each command that changes something carries, between command and checksum.
ARGUMENTS = {
    SET_TIMEOUT: ">B",
    SET_DUTY_1: ">h",
    SET_DUTY_2: ">h",
    SET_DUTIES: ">hh",
    SET_LIMIT_1: ">II",
    SET_LIMIT_2: ">II",
    RESET_STOP: ">",
}
# Those that only ask come without a checksum.
QUESTIONS = frozenset(
    {
        *(GET_TIMEOUT, GET_VERSION, GET_MAIN_VOLTAGE, GET_LOGIC_VOLTAGE, GET_VOLTAGES, GET_DUTIES, GET_CURRENTS),
        *(GET_TEMPERATURE, GET_STATUS, GET_LIMIT_1, GET_LIMIT_2),
    }
)

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
        self._parser = _Parser()
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
        self._parser = _Parser()

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
        if command in QUESTIONS:
            self.heard = self._time
            return answer(self.address, command, self._data(command))
        if checksum(packet[:-2]) != struct.unpack(">H", packet[-2:])[0]:
            return b""
        self.heard = self._time
        if command not in self.ignored:
            self._obey(command, struct.unpack(ARGUMENTS[command], packet[2:-2]))
        return ACKNOWLEDGED

    def _obey(self, command: int, values: tuple[int, ...]) -> None:
        if command == SET_TIMEOUT:
            self.timeout = values[0]
        elif command in (SET_LIMIT_1, SET_LIMIT_2):
            self.limits[command - SET_LIMIT_1] = values[0]
        elif command == RESET_STOP:
            self.errors &= ~EMERGENCY_STOP
        elif not self.errors:
            first = values[0] if command != SET_DUTY_2 else self.duties[0]
            second = values[-1] if command != SET_DUTY_1 else self.duties[1]
            self._set((first, second), self._time)

    def _data(self, command: int) -> bytes:
        """Return what the answer to a question says."""
        if command == GET_VERSION:
            return VERSION
        if command == GET_TIMEOUT:
            return bytes((self.timeout,))
        if command == GET_STATUS:
            return struct.pack(">I", self.warnings << 16 | self.errors)
        if command in (GET_LIMIT_1, GET_LIMIT_2):
            return struct.pack(">II", self.limits[command - GET_LIMIT_1], 0)
        if command == GET_DUTIES:
            return struct.pack(">hh", *self.outputs)
        if command == GET_CURRENTS:
            return struct.pack(">hh", *(self._reported(channel) for channel in (0, 1)))
        volts, logic = struct.pack(">H", round(10.0 * self.supply)), struct.pack(">H", 50)
        return {
            GET_MAIN_VOLTAGE: volts,
            GET_LOGIC_VOLTAGE: logic,
            GET_VOLTAGES: volts + logic,
            GET_TEMPERATURE: struct.pack(">H", 250),
        }[command]

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
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


def _length(command: int) -> int | None:
    """Return the number of bytes of a packet with a command, None if it is unknown."""
    if command in QUESTIONS:
        return 2
    return 4 + struct.calcsize(ARGUMENTS[command]) if command in ARGUMENTS else None


def answer(address: int, command: int, data: bytes) -> bytes:
    """Return the answer to a question: data, and the checksum over the question and the data."""
    return data + struct.pack(">H", checksum(bytes((address, command)) + data))


class _Parser:
    """Cuts a stream of bytes into packets."""

    def __init__(self) -> None:
        self._bytes = b""
        self._heard = 0.0

    def feed(self, data: bytes, time: float) -> list[bytes]:
        """Receive bytes at a time [s] and return the packets that they complete, checksums not yet verified."""
        if time - self._heard > PACKET_GAP:
            self._bytes = b""
        self._heard = time
        self._bytes += data
        packets: list[bytes] = []
        while True:
            while self._bytes and self._bytes[0] not in ADDRESSES:
                self._bytes = self._bytes[1:]
            if len(self._bytes) < 2:
                return packets
            size = _length(self._bytes[1])
            if size is None:  # nobody can tell where it ends
                self._bytes = b""
                return packets
            if len(self._bytes) < size:
                return packets
            packets.append(self._bytes[:size])
            self._bytes = self._bytes[size:]
