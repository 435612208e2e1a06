"""The packets of RoboClaw's packet serial mode: their checksum and their lengths."""

from __future__ import annotations

import struct

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


def length(command: int) -> int | None:
    """Return the number of bytes of a packet with a command, None if it is unknown."""
    if command in QUESTIONS:
        return 2
    return 4 + struct.calcsize(ARGUMENTS[command]) if command in ARGUMENTS else None


def answer(address: int, command: int, data: bytes) -> bytes:
    """Return the answer to a question: data, and the checksum over the question and the data."""
    return data + struct.pack(">H", checksum(bytes((address, command)) + data))


class Parser:
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
            size = length(self._bytes[1])
            if size is None:  # nobody can tell where it ends
                self._bytes = b""
                return packets
            if len(self._bytes) < size:
                return packets
            packets.append(self._bytes[:size])
            self._bytes = self._bytes[size:]
