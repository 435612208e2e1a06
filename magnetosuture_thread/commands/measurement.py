"""A measurement that the operator's page begins: the command `teach` or `commission`, as a process of its own."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from magnetosuture_thread.nodes.processes import end_with_parent
from magnetosuture_thread.settings.configuration import to_mapping
from magnetosuture_thread.settings.errors import MAX_REASON_CHARS, shortened
from magnetosuture_thread.settings.shared_parameters import read_sections
from magnetosuture_thread.vision.settings import VisionTrackerSettings

# How a needle looks, which a tracker that runs is told. Its length stays, as the bridge keeps that needle off shapes;
# so does its view, with the check that the dish is where it was.
TAUGHT = ("needle_width", "max_needle_brightness", "needle_colour", "needle_is_blunt", "max_needle_bend")
MAX_LINES = 40  # that a page is sent
END_TIMEOUT = 20.0  # s for a command to end by itself, once it is cancelled: it starts nodes anew as they were


class Measurement:
    """A command of this package as a process, which ends with this one.

    Args:
        name: of the command.

    Attributes:
        name: as given.
        lines: the latest that it has printed.
        state: whether it runs, is done or has failed.
        picture: name and bytes of a PNG file that came of it; empty without one.
        cancelled: whether it is to end.
    """

    def __init__(self, name: str) -> None:
        self.name, self.cancelled = name, False
        self.state: Literal["running", "done", "failed"] = "running"
        self.picture = ("", b"")
        self._cancelled_at = math.inf  # monotonic [s]
        self.lines: deque[str] = deque(maxlen=MAX_LINES)
        self._process: asyncio.subprocess.Process | None = None

    async def run(self, arguments: Sequence[str]) -> bool:
        """Run the command to its end; return whether it succeeded.

        Args:
            arguments: of the command.
        """
        # In a session of its own: Ctrl-C is ours to pass on.
        options: dict[str, Any] = {"start_new_session": True, "preexec_fn": end_with_parent, "limit": 1 << 20}
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "100"}
        command = ("-m", "magnetosuture_thread.cli", self.name, *arguments)
        process = await asyncio.create_subprocess_exec(sys.executable, *command, env=environment, **streams, **options)
        self._process = process
        if self.cancelled:  # while it began
            self._signal(signal.SIGINT)
        assert process.stdout is not None
        async for line in process.stdout:
            if text := line.decode(errors="replace").strip():
                self.lines.append(shortened(text, MAX_REASON_CHARS))
        return await process.wait() == 0

    def cancel(self) -> None:
        """Interrupt the command, as Ctrl-C does; once more only if it does not end, and then for good."""
        if not self.cancelled:
            self.cancelled, self._cancelled_at = True, time.monotonic()
            self._signal(signal.SIGINT)
        elif time.monotonic() > self._cancelled_at + END_TIMEOUT:
            self._signal(signal.SIGKILL)

    async def close(self) -> bool:
        """Cancel the command, and wait for its end; return whether it had to be killed."""
        self.cancel()
        if self._process is None:
            return False
        try:
            await asyncio.wait_for(self._process.wait(), END_TIMEOUT)
        except asyncio.TimeoutError:
            self._signal(signal.SIGKILL)
            return True
        return False

    def shown(self) -> dict[str, Any]:
        """Return what a page shows of it; see `console.client.Host`."""
        return {"name": self.name, "state": self.state, "lines": list(self.lines), "picture": self.picture[0]}

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None and self._process.returncode is None:
            with suppress(ProcessLookupError):  # it has ended by itself just now
                self._process.send_signal(number)


def taught_values(path: Path) -> tuple[float, dict[str, Any]]:
    """Return the needle's length that `teach` has written [m], and `TAUGHT`, the usual values where it leaves them out.

    Raises:
        ConfigurationError: the file cannot be read.
    """
    usual = to_mapping(VisionTrackerSettings())
    written = {name: value for _, section in read_sections(path) for name, value in section.items()}
    return float(written["needle_length"]), {name: written.get(name, usual[name]) for name in TAUGHT}
