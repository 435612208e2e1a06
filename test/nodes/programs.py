"""Node programs as processes, forked from one that has imported all of them: to import takes each of them seconds."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from magnetosuture_thread.nodes import program
from magnetosuture_thread.nodes.processes import NodeProcesses

TIMEOUT = 90.0  # s for a process on a busy machine


class Program:
    """A node that runs as its program.

    Args:
        pid: of the process.
        log: file that gets what it prints.
        code: file that gets its exit code.
    """

    def __init__(self, pid: int, log: Path, code: Path) -> None:
        self.pid, self._log, self._code = pid, log, code

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
        return int(self._code.read_text()) if self._code.exists() else None

    @property
    def returncode(self) -> int | None:
        """Return the exit code, as a `Popen` has it."""
        return self.poll()

    def wait(self, timeout: float = TIMEOUT) -> int:
        """Return the exit code once it has ended, or raise `TimeoutExpired` with what it has printed."""
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(self.output, timeout)
            time.sleep(0.005)
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
        command = [sys.executable, __file__]
        self._server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def start(self, name: str, *arguments: str, environment: Mapping[str, str], log: Path | None = None) -> Program:
        """Start the program of a name with ROS arguments; what it prints goes to a file of ours unless one is given."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        number = next(self._numbers)
        log, code = log or self._folder / f"{number}.log", self._folder / f"{number}.code"
        log.write_bytes(b"")
        argv = [name, "--ros-args", *arguments]
        given = {"argv": argv, "environment": dict(environment), "log": str(log), "code": str(code)}
        self._server.stdin.write(json.dumps(given) + "\n")
        self._server.stdin.flush()
        started = Program(int(self._server.stdout.readline()), log, code)
        self._programs.append(started)
        return started

    def kill_all(self) -> None:
        """Kill those that still run, at the end of a test."""
        for each in self._programs:
            each.kill()
        self._programs.clear()

    def close(self) -> None:
        """End the process that forks them."""
        with self._server:  # which closes its pipes
            pass


def start_forked(programs: Callable[[], Programs]) -> Callable[..., None]:
    """Return what stands in for `NodeProcesses.start`: a node of this package is forked, and not started anew."""
    start = NodeProcesses.start

    def fork(nodes: Any, name: str, *, module: str = "", arguments: Sequence[str] = ()) -> None:
        if module:
            return start(nodes, name, module=module, arguments=arguments)
        given, log = (*nodes._arguments, *arguments), nodes._logs / f"{name}.log"
        nodes._processes[name] = programs().start(name, *given, environment=nodes._environment, log=log)

    return fork


def serve() -> None:
    """Fork a program for each line on standard input, and note exit codes."""
    for name in (*program.MAKERS, "console"):
        importlib.import_module(f"magnetosuture_thread.nodes.{name}")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a person who ends the tests
    codes: dict[int, Path] = {}
    ends = False
    while codes or not ends:
        if not ends and select.select([sys.stdin], [], [], 0.0 if codes else 0.2)[0]:
            line = sys.stdin.readline()
            ends = not line
            for pid in codes if ends else ():  # whoever started them is gone
                os.kill(pid, signal.SIGINT)
            if line:
                given = json.loads(line)
                pid = os.fork()
                if not pid:
                    run(given)
                codes[pid] = Path(given["code"])
                print(pid, flush=True)
        for pid in list(codes):
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                path = codes.pop(pid)
                path.with_suffix(".new").write_text(str(os.waitstatus_to_exitcode(status)))
                path.with_suffix(".new").rename(path)
        time.sleep(0.005)


def run(given: dict[str, Any]) -> NoReturn:
    """Become a program."""
    os.environ.clear()
    os.environ.update(given["environment"])
    log = os.open(given["log"], os.O_WRONLY | os.O_APPEND)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(log, 1)
    os.dup2(log, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = given["argv"]
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
    serve()
