"""The rig's power stage: simulated boards behind pseudo-terminals, in a process of their own.

Real boards answer while the computer is busy. In the process of the rig's node they could not: rclpy holds the
interpreter while DDS publishes, for up to 0.3 s, where a process that reads the message lost the processor. A driver
takes such a board for dead.
"""

from __future__ import annotations

import json
import os
import random
import select
import subprocess
import sys
import threading
import time
import tty
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError, GraphError
from magnetosuture_thread.rig.power.board import ADDRESSES, RoboClawBoard

TICK = 0.01  # s between two looks at the boards' own timeouts
CHUNK = 4096
ASK = b"?"
TIMEOUT = 5.0  # s for the boards to be taken away
AHEAD = -10  # of the processes that boards would not share a processor with, where the user may say so


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
        by_path: dict[str, list[RoboClawBoard]] = defaultdict(list)
        self.boards = []
        for path, address in zip(ports, board_addresses(len(ports)), strict=True):
            board = RoboClawBoard(address, supply, resistance, inductance)
            by_path[path].append(board)
            self.boards.append(board)
        self.lines = [Line(path, boards) for path, boards in by_path.items()]

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

    def currents(self) -> NDArray[np.float64]:
        """Return the coils' currents now, shape (2 boards,) [A]."""
        for line in self.lines:
            line.advance()
        return np.array([current for board in self.boards for current in board.currents])


class StageProcess:
    """Runs a power stage elsewhere, and reads its currents; the boards go when this process does, whatever ends it.

    Args:
        ports: the path at which each board is to be found, as `PowerStage` takes them.
        supply: of each board [V].
        resistance: of each coil [ohm].
        inductance: of each coil [H].
    """

    def __init__(self, ports: Sequence[str], supply: float, resistance: float, inductance: float) -> None:
        self._arguments = json.dumps([list(ports), supply, resistance, inductance])
        self._bytes = 2 * len(ports) * np.dtype(float).itemsize
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._running().pid

    def open(self) -> None:
        """Start the process, and wait until its boards can be found.

        Raises:
            ConfigurationError: a path cannot be used.
            GraphError: the process ended.
        """
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, self._arguments],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the rig, which then takes the boards away
        )
        problem = json.loads(self._read())
        if problem is not None:
            self.close()
            raise ConfigurationError(*problem)

    def close(self) -> None:
        """Take the boards away; harmless if there are none."""
        if self._process is None:
            return
        process, self._process = self._process, None
        try:
            process.communicate(timeout=TIMEOUT)  # closes its input, which ends it
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()

    def currents(self) -> NDArray[np.float64]:
        """Return the coils' currents now, shape (2 boards,) [A].

        Raises:
            GraphError: the process ended.
        """
        with suppress(BrokenPipeError):  # reading tells
            cast(BinaryIO, self._running().stdin).write(ASK)
        return np.frombuffer(self._read(self._bytes))

    def _read(self, size: int | None = None) -> bytes:
        """Return so many bytes, or a line, of what the process says."""
        process = self._running()
        answers = cast(BinaryIO, process.stdout)
        said = answers.readline() if size is None else answers.read(size)
        if len(said) < (size or 1):
            raise GraphError(f"the process with the simulated boards ended (exit code {process.wait()})")
        return said

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise GraphError("the simulated boards are not open")
        return self._process


def serve(stage: PowerStage, asks: BinaryIO, answers: BinaryIO) -> int:
    """Open a stage, say how that went, and tell its currents as often as asked, until nobody can ask any more."""
    try:
        stage.open()
    except ConfigurationError as error:
        answers.write(json.dumps([error.name, error.value, error.expectation]).encode() + b"\n")
        return 1
    try:
        answers.write(json.dumps(None).encode() + b"\n")
        while asks.read(1):
            answers.write(stage.currents().tobytes())
    except BrokenPipeError:
        pass  # who asked is gone
    finally:
        stage.close()
    return 0


if __name__ == "__main__":
    with suppress(OSError):  # only some may
        os.nice(AHEAD)
    with open(sys.stdin.fileno(), "rb", 0) as asking, open(sys.stdout.fileno(), "wb", 0) as answering:
        sys.exit(serve(PowerStage(*json.loads(sys.argv[1])), asking, answering))
