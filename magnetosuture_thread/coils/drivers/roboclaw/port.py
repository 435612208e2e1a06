"""A serial port whose exchanges take a bounded time."""

from __future__ import annotations

import errno
import os
import select
import time
from typing import Any

import serial


class DeviceError(Exception):
    """A board or its line that does not work; its text is for a person."""


class ExchangePort(serial.Serial):
    """A port for one question and one answer at a time, that only one process can have.

    What is written is kept until the answer is read, so that a packet goes out in one piece: a board drops one
    with a gap of 10 ms in it, and the maker's library writes a packet in up to five pieces.

    Args:
        path: of the port.
        baud_rate: of the line.
        answer_timeout: that a board has for an answer [s].

    Attributes:
        answer_timeout: as given.
        answer: the bytes that were read since `begin`.
    """

    def __init__(self, path: str, baud_rate: int, answer_timeout: float) -> None:
        self.answer_timeout = answer_timeout
        self._packet = bytearray()
        self.answer = bytearray()
        self._until = 0.0
        try:
            # The lock comes before anything is changed at the port, and so does not disturb who has it.
            super().__init__(path, baud_rate, timeout=answer_timeout, exclusive=True)
        except (serial.SerialException, ValueError) as error:
            raise DeviceError(_why_not(path, error)) from error

    def begin(self) -> None:
        """Begin an exchange: what came too late for the last one is not the answer to this one."""
        self.reset_input_buffer()
        self._packet.clear()
        self.answer.clear()
        self._until = time.monotonic() + self.answer_timeout

    def write(self, b: Any, /) -> int:
        """Keep bytes of a packet until the answer is read."""
        self._packet += b
        return len(b)

    def read(self, size: int = 1, /) -> bytes:
        """Send the packet if it has not been sent, and return up to `size` bytes of the answer.

        The board's time begins when the packet is out, and an exchange, however many reads it has, waits for at
        most twice that. What has come is taken even if this thread was held up and comes late for it: rclpy may
        keep the interpreter to itself for longer than a board has, and that is no fault of the board's. For the
        same reason a packet that is late by so much is not sent at all, as what it says may no longer be wanted.
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
        """Give a packet to the kernel in one piece, once there is room for it.

        The library's own write takes a packet that is out for one that is not, where this thread was held up on the
        way back from the kernel.
        """
        _, room, _ = select.select([], [self], [], max(0.0, self._until - time.monotonic()))
        if not room or os.write(self.fileno(), packet) < len(packet):
            raise serial.SerialTimeoutException("no room for a packet")


def _why_not(path: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return f"{path} is held by another process"
    if number == errno.ENOENT:
        return f"there is no {path}"
    if number == errno.EACCES:
        return f"no permission for {path}; its group is usually dialout"
    return f"cannot open {path}: {error}"
