"""The power stage in a process of its own, as hardware has its own clock and processor.

Real boards answer while the computer is busy. In the process of the rig's node they could not: rclpy holds the
interpreter while DDS publishes, for up to 0.3 s here, where a process that reads the message lost the processor. A
driver takes such a board for dead.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError, GraphError
from magnetosuture_thread.rig.power.stage import PowerStage

ASK = b"?"
TIMEOUT = 5.0  # s for the boards to be taken away
AHEAD = -10  # of the processes that boards would not share a processor with, where the user may say so


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
