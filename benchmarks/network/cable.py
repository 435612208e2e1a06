"""Program: a cable between two TAP devices, which can be pulled, delay packets and lose them.

Not every kernel can delay and lose packets by itself (netem). Commands come in lines on standard input, and each is
answered by a line with the bytes that went either way: `pull`, `plug`, `impair DELAY LOSS` (s, share), `count`.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import random
import selectors
import struct
import sys
import time
from collections.abc import Callable
from itertools import count

_TUNSETIFF, _TUNSETCARRIER = 0x400454CA, 0x400454E2
_IFF_TAP, _IFF_NO_PI = 0x0002, 0x1000
_LARGEST_FRAME = 65536  # bytes
_QUEUE = 10_000  # frames on their way; those beyond are lost


class Cable:
    """Takes frames from each of two TAP devices to the other; those on their way when it is pulled arrive all the same.

    Args:
        ends: file descriptors of the devices, which do not block.
        set_carrier: tells the second device whether it is connected.
    """

    def __init__(self, ends: tuple[int, int], set_carrier: Callable[[bool], None]) -> None:
        self._ends, self._set_carrier = ends, set_carrier
        self._random = random.Random(1)
        self._order = count()
        self._waiting: list[tuple[float, int, int, bytes]] = []  # due, order, end that gets it, frame
        self._pulled, self._delay, self._loss = False, 0.0, 0.0
        self._bytes = [0, 0]

    def run(self, inlet: int, answer: Callable[[str], None]) -> None:
        """Carry frames until the commands end.

        Args:
            inlet: file descriptor that the commands come from.
            answer: called with the answer to each.
        """
        with selectors.DefaultSelector() as selector:
            for end, descriptor in enumerate(self._ends):
                selector.register(descriptor, selectors.EVENT_READ, end)
            selector.register(inlet, selectors.EVENT_READ, None)
            commands = b""
            while True:
                for key, _ in selector.select(self._until_due()):
                    if key.data is not None:
                        self._take(key.data)
                        continue
                    read = os.read(inlet, 4096)
                    if not read:
                        return
                    *lines, commands = (commands + read).split(b"\n")
                    for line in lines:
                        answer(self._execute(line.decode().split()))
                self._deliver()

    def _execute(self, words: list[str]) -> str:
        if words[0] in ("pull", "plug"):
            self._pulled = words[0] == "pull"
            self._set_carrier(not self._pulled)
        elif words[0] == "impair":
            self._delay, self._loss = float(words[1]), float(words[2])
        return " ".join(map(str, self._bytes))

    def _take(self, end: int) -> None:
        frame = os.read(self._ends[end], _LARGEST_FRAME)
        if self._pulled or self._random.random() < self._loss or len(self._waiting) >= _QUEUE:
            return
        self._bytes[end] += len(frame)
        heapq.heappush(self._waiting, (time.monotonic() + self._delay, next(self._order), 1 - end, frame))

    def _deliver(self) -> None:
        now = time.monotonic()
        while self._waiting and self._waiting[0][0] <= now:
            _, _, end, frame = heapq.heappop(self._waiting)
            try:
                os.write(self._ends[end], frame)
            except OSError:  # the host has taken its device down
                continue

    def _until_due(self) -> float | None:
        return max(0.0, self._waiting[0][0] - time.monotonic()) if self._waiting else None


def _make_device(name: str) -> int:
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TAP | _IFF_NO_PI))
    return descriptor


def main(names: tuple[str, str]) -> None:
    """Make two TAP devices, which last as long as this process, and connect them."""
    ends = _make_device(names[0]), _make_device(names[1])
    print("ready", flush=True)
    cable = Cable(ends, lambda present: _set_carrier(ends[1], present))
    cable.run(sys.stdin.fileno(), lambda text: print(text, flush=True))


def _set_carrier(device: int, present: bool) -> None:
    fcntl.ioctl(device, _TUNSETCARRIER, struct.pack("i", present))


if __name__ == "__main__":
    main((sys.argv[1], sys.argv[2]))
