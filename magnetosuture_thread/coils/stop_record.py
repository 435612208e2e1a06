"""The emergency stop, and a bridge that did not end in order, remembered over a restart in a small file."""

from __future__ import annotations

import os
from contextlib import suppress
from enum import Enum
from pathlib import Path

from magnetosuture_thread.files import read_regular
from magnetosuture_thread.outputs import output_problem

MAX_BYTES = 1000  # of the file, which holds one word


class RecordedState(Enum):
    """What a bridge leaves behind."""

    SAFE = "disarmed"  # nothing to remember: it was disarmed, or has ended in order
    ARMED = "armed"  # or with a fault that was not reset
    STOPPED = "stopped"  # the emergency stop was pressed, and not reset


class StopRecord:
    """A file that holds the state of a bridge, on the disk when `write` returns.

    Args:
        path: of the file; its folder is made with the first `write`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._written: RecordedState | None = None

    def read(self) -> RecordedState:
        """Return the state that was left behind; without a file none, and of a damaged one the emergency stop."""
        try:
            return RecordedState(read_regular(self.path, MAX_BYTES).decode().strip())
        except FileNotFoundError:
            return RecordedState.SAFE
        except (OSError, ValueError):
            return RecordedState.STOPPED

    def write(self, state: RecordedState) -> None:
        """Replace the file, unless it holds this state already.

        Raises:
            OSError: it cannot be written.
        """
        if state is self._written:
            return
        self._written = None
        if problem := output_problem(self.path):
            raise OSError(problem)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            with partial.open("w", encoding="utf-8") as stream:
                stream.write(f"{state.value}\n")
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(self.path)
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)  # else the name may still be that of the file before, after a power failure
        finally:
            os.close(folder)
        self._written = state
