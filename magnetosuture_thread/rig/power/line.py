"""A serial line that is not there: boards behind a pseudo-terminal, at a path of one's choice."""

from __future__ import annotations

import os
import random
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.rig.power.board import RoboClawBoard

TICK = 0.01  # s between two looks at the boards' own timeouts
CHUNK = 4096


@dataclass
class LineFaults:
    """What goes wrong on a line; may be set at any time.

    Attributes:
        deaf: whether nothing gets to the boards, as if they were off.
        silent: whether nothing comes back from them.
        garbage: whether other bytes come back than they sent.
        wrong_checksum: whether the last bit of each answer is turned.
        lateness: how long an answer takes [s].
        lose_in: of the bytes to the boards, each of this number gets lost; 0 is none.
        lose_out: the same of the bytes from them.
        mute: addresses of boards that neither hear nor answer.
    """

    deaf: bool = False
    silent: bool = False
    garbage: bool = False
    wrong_checksum: bool = False
    lateness: float = 0.0
    lose_in: int = 0
    lose_out: int = 0
    mute: frozenset[int] = frozenset()


class Line:
    """Serves boards on a pseudo-terminal, in a thread; the path is a symbolic link to it.

    It stands in for hardware, and so, unlike the rest of the rig, it reads a clock and waits.

    Args:
        path: where the line is to be found.
        boards: on it, each with an address of its own.
        clock: tells the time [s].

    Attributes:
        faults: what goes wrong on it.
        boards: on it; look at them while holding `lock`.
    """

    def __init__(
        self, path: str | Path, boards: Sequence[RoboClawBoard], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.path = Path(path)
        self.boards = tuple(boards)
        self.faults = LineFaults()
        self.lock = threading.Lock()
        self._clock = clock
        self._random = random.Random(0)
        self._late: deque[tuple[float, bytes]] = deque()
        self._counts = {"in": 0, "out": 0}
        self._ends = threading.Event()
        self._thread: threading.Thread | None = None
        self._host = self._device = -1

    def plug(self) -> None:
        """Let the line be found, and serve it; harmless if it already is.

        Raises:
            ConfigurationError: the path cannot be a symbolic link.
        """
        if self._thread is not None:
            return
        self._host, self._device = os.openpty()
        # Held open here, so that the line does not hang up while nobody else has it.
        tty.setraw(self._device)
        os.set_blocking(self._host, False)
        try:
            self._link(os.ttyname(self._device))
        except OSError as error:
            self._shut()
            expectation = f"a path for a symbolic link ({error.strerror})"
            raise ConfigurationError("rig_simulator.power_stage_ports", str(self.path), expectation) from None
        self._ends.clear()
        self._thread = threading.Thread(target=self._serve, name=f"line {self.path}", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Remove the line; its boards keep their state. No effect if there is none."""
        if self._thread is None:
            return
        self._ends.set()
        self._thread.join()
        self._thread = None
        with suppress(OSError):
            if os.readlink(self.path) == os.ttyname(self._device):  # else somebody else has put his own there
                self.path.unlink()
        self._shut()

    def advance(self) -> None:
        """Let the boards be where they are now."""
        with self.lock:
            for board in self.boards:
                board.advance(self._clock())

    def _link(self, name: str) -> None:
        if self.path.exists() and not self.path.is_symlink():
            raise FileExistsError(17, "there is something else")
        new = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        new.unlink(missing_ok=True)
        new.symlink_to(name)
        new.replace(self.path)

    def _shut(self) -> None:
        os.close(self._host)
        os.close(self._device)
        self._late.clear()

    def _serve(self) -> None:
        while not self._ends.is_set():
            readable, _, _ = select.select([self._host], [], [], self._patience())
            if readable:
                with suppress(OSError):
                    self._receive(os.read(self._host, CHUNK))
            self.advance()
            while self._late and self._late[0][0] <= self._clock():
                with suppress(OSError):  # nobody reads, and the line is full
                    os.write(self._host, self._late.popleft()[1])

    def _patience(self) -> float:
        return max(0.0, min(TICK, self._late[0][0] - self._clock())) if self._late else TICK

    def _receive(self, data: bytes) -> None:
        now, faults = self._clock(), self.faults
        if faults.deaf:
            return
        data = self._lossy(data, "in", faults.lose_in)
        with self.lock:
            answers = [b.receive(data, now) for b in self.boards if b.address not in faults.mute]
        for answer in answers:
            if answer and not faults.silent:
                self._late.append((now + faults.lateness, self._distorted(answer)))

    def _distorted(self, answer: bytes) -> bytes:
        if self.faults.garbage:
            answer = self._random.randbytes(len(answer) + 3)
        if self.faults.wrong_checksum:
            answer = answer[:-1] + bytes((answer[-1] ^ 1,))
        return self._lossy(answer, "out", self.faults.lose_out)

    def _lossy(self, data: bytes, way: str, each: int) -> bytes:
        if not each:
            return data
        first = self._counts[way]
        self._counts[way] = first + len(data)
        return bytes(byte for at, byte in enumerate(data, first + 1) if at % each)
