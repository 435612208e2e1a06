"""A measurement that the operator's page begins: the command `teach` or `commission`, as a process of its own."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from magnetosuture_thread.nodes.processes import end_with_parent
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, read_regular

MAX_LINES, MAX_CHARS = 40, 400  # that a page is sent
RUNNING, DONE, FAILED = "running", "done", "failed"
END_TIMEOUT = 10.0  # s for a command to give zero currents and disarm, once it is cancelled


class Measurement:
    """A command of this package as a process, which ends with this one.

    Args:
        name: of the command.

    Attributes:
        name: as given.
        lines: the latest that it has printed.
        state: `RUNNING`, `DONE` or `FAILED`.
        picture: file that it writes besides; None for none.
    """

    def __init__(self, name: str) -> None:
        self.name, self.state = name, RUNNING
        self.picture: Path | None = None
        self.lines: deque[str] = deque(maxlen=MAX_LINES)
        self._process: asyncio.subprocess.Process | None = None
        self._cancelled = False

    async def run(self, arguments: Sequence[str]) -> bool:
        """Run the command to its end; return whether it succeeded.

        Args:
            arguments: of the command.
        """
        if self._cancelled:
            return False
        # In a session of its own: Ctrl-C is ours to pass on.
        options: dict[str, Any] = {"start_new_session": True, "preexec_fn": end_with_parent}
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "100"}
        command = ("-m", "magnetosuture_thread.cli", self.name, *arguments)
        process = await asyncio.create_subprocess_exec(sys.executable, *command, env=environment, **streams, **options)
        self._process = process
        assert process.stdout is not None
        async for line in process.stdout:
            if text := line.decode(errors="replace").rstrip():
                self.lines.append(text[:MAX_CHARS])
        return await process.wait() == 0

    def cancel(self) -> None:
        """Interrupt the command, as Ctrl-C does."""
        self._cancelled = True
        if self._process is not None and self._process.returncode is None:
            with suppress(ProcessLookupError):  # it has ended by itself just now
                self._process.send_signal(signal.SIGINT)

    async def close(self) -> None:
        """Cancel the command, and wait for its end."""
        self.cancel()
        if self._process is not None:
            try:
                await asyncio.wait_for(self._process.wait(), END_TIMEOUT)
            except asyncio.TimeoutError:
                self._process.kill()

    def shown(self) -> dict[str, Any]:
        """Return what a page shows of it; see `console.client.Host`."""
        has_picture = self.picture is not None and self.picture.is_file()
        return {"name": self.name, "state": self.state, "lines": list(self.lines), "picture": has_picture}


def taught_values(path: Path) -> dict[str, Any]:
    """Return the parameters that `teach` has written for the tracker.

    Raises:
        OSError: the file cannot be read.
    """
    sections = yaml.safe_load(read_regular(path, MAX_TEXT_BYTES))
    return {name: value for section in sections.values() for name, value in section["ros__parameters"].items()}
