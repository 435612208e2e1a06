"""Node programs as processes, forked from one that has imported all of them: to import takes each of them seconds."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, NoReturn

from magnetosuture_thread.nodes import program
from magnetosuture_thread.nodes.processes import NodeProcesses

FORKS = multiprocessing.get_context("forkserver")
# pytest, as each process imports the main module of its parent.
FORKS.set_forkserver_preload(
    ["pytest", *(f"magnetosuture_thread.nodes.{name}" for name in (*program.MAKERS, "console"))]
)
TIMEOUT = 90.0  # s for a process on a busy machine


class Program:
    """A node that runs as its program.

    Args:
        process: that runs it.
        log: file that gets what it prints.
    """

    def __init__(self, process: ForkServerProcess, log: Path) -> None:
        self._process, self._log = process, log
        self.pid = process.pid or 0

    @property
    def output(self) -> str:
        """Return what it has printed."""
        return self._log.read_text(errors="replace")

    @property
    def errors(self) -> list[str]:
        """Return the lines that say why it ended."""
        return [line for line in self.output.splitlines() if line.startswith("error: ")]

    def send_signal(self, which: signal.Signals) -> None:
        """Send a signal, if it has not ended."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, which)

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        """Return the exit code, as a `Popen` has it."""
        return self.poll()

    def wait(self, timeout: float = TIMEOUT) -> int:
        """Return the exit code once it has ended, or raise `TimeoutExpired` with what it has printed."""
        self._process.join(timeout)
        if (code := self.poll()) is None:
            raise subprocess.TimeoutExpired(self.output, timeout)
        return code

    def wait_for(self, words: str, timeout: float = TIMEOUT) -> None:
        """Wait until it has printed something."""
        deadline = time.monotonic() + timeout
        while words not in self.output:
            assert self.poll() is None, self.output
            assert time.monotonic() < deadline, f"waited {timeout:g} s for {words!r}: {self.output}"
            time.sleep(0.005)

    def kill(self) -> None:
        """Kill it, as a crash would, if it has not ended."""
        if self.poll() is None:
            self.send_signal(signal.SIGKILL)
            self.wait()


class Programs:
    """Starts node programs.

    Args:
        folder: for what they print.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._numbers = folder, itertools.count()
        self._programs: list[Program] = []

    def start(self, name: str, *arguments: str, environment: Mapping[str, str], log: Path | None = None) -> Program:
        """Start the program of a name with ROS arguments; what it prints goes to a file of ours unless one is given."""
        log = log or self._folder / f"{next(self._numbers)}.log"
        log.write_bytes(b"")
        argv = [name, "--ros-args", *arguments]
        # By the path of this file: in a new process, the package `test` is that of Python.
        given = {"init_globals": {"GIVEN": (argv, dict(environment), str(log))}, "run_name": "__main__"}
        process = FORKS.Process(target=runpy.run_path, args=(__file__,), kwargs=given)
        process.start()
        started = Program(process, log)
        self._programs.append(started)
        return started

    def kill_all(self) -> None:
        """Kill those that still run, at the end of a test."""
        for each in self._programs:
            each.kill()
        self._programs.clear()


def start_forked(programs: Callable[[], Programs]) -> Callable[..., None]:
    """Return what stands in for `NodeProcesses.start`: a node of this package is forked, and not started anew."""
    start = NodeProcesses.start

    def fork(nodes: Any, name: str, *, module: str = "", arguments: Sequence[str] = ()) -> None:
        if module:
            return start(nodes, name, module=module, arguments=arguments)
        given, log = (*nodes._arguments, *arguments), nodes._logs / f"{name}.log"
        nodes._processes[name] = programs().start(name, *given, environment=nodes._environment, log=log)

    return fork


def run(argv: list[str], environment: dict[str, str], log: str) -> NoReturn:
    """Become a program."""
    os.environ.clear()
    os.environ.update(environment)
    output = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also where nohup runs the tests
    sys.argv = argv
    code = 1
    try:
        code = program.main()
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    run(*globals()["GIVEN"])
