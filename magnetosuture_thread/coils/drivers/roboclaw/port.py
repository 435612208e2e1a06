"""Serial port with a bounded time for each exchange."""

from __future__ import annotations

import ctypes
import errno
import math
import select
import time
from typing import Any

import serial

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
            raise DeviceError(_open_problem(path, error)) from error

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


def _open_problem(path: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return f"{path} is held by another process"
    if number == errno.ENOENT:
        return f"there is no {path}"
    if number == errno.EACCES:
        return f"no permission for {path}; its group is usually dialout"
    return f"cannot open {path}: {error}"
