"""Nodes as processes: on a ROS domain of their own, their priority, and signals that interrupt who started them."""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

from magnetosuture_thread.settings.errors import GraphError

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_LIBC = ctypes.CDLL(None)  # loaded here, and not between fork and exec


def graph_environment(domain: int) -> dict[str, str]:
    """Return the environment for a graph of its own on this machine alone."""
    leads_elsewhere = (  # out of this machine, or to another graph
        *("CYCLONEDDS_URI", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_DISCOVERY_SERVER"),
        *("ROS_NAMESPACE", "ROS_STATIC_PEERS", "ROS_SUPER_CLIENT"),
    )
    environment = {key: value for key, value in os.environ.items() if key not in leads_elsewhere}
    environment["ROS_DOMAIN_ID"] = str(domain)
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # Camera frames over shared memory and TCP: Fast DDS's defaults lose most large best-effort messages.
    large_data = "LARGE_DATA?max_msg_size=2MB&sockets_size=2MB&non_blocking=true"
    environment.setdefault("FASTDDS_BUILTIN_TRANSPORTS", large_data)
    environment["PYTHONSAFEPATH"] = "1"  # not the package of a clone that a person is in; from 3.11 on
    return environment


@contextmanager
def environment_of(environment: dict[str, str]) -> Iterator[None]:
    """Give this process an environment, and its own back at the end."""
    before = dict(os.environ)
    os.environ.clear()
    os.environ.update(environment)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def reserved_domain() -> Iterator[int]:
    """Yield a ROS domain that is unused on this machine.

    A bag that is replayed must never reach a robot's coils, so it gets a domain of its own: one whose discovery ports
    nobody has bound, and that no other call, in any process, holds at the time. All its ports are looked at: Fast DDS
    counts the participants of a process over all domains, so the only one of a domain can have any of them.

    Raises:
        GraphError: all are in use.
    """
    for offset in range(100):
        domain = 1 + (os.getpid() + offset) % 100
        path = Path(tempfile.gettempdir()) / f"magnetosuture_domain_{domain}_{os.getuid()}.lock"
        with path.open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if is_empty(domain):
                yield domain
                return
    raise GraphError("no free ROS domain from 1 to 100")


def is_empty(domain: int) -> bool:
    """Return whether no process on this machine uses a discovery port of a ROS domain."""
    for port in range(7400 + 250 * domain + 10, 7400 + 250 * domain + 250, 2):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                return False
    return True


class NodeProcesses:
    """Starts nodes of this package as processes, and ends them.

    They end with this process, however it ends: nobody would stop their coils otherwise.

    Args:
        names: of the nodes.
        arguments: for each, after `--ros-args`.
        environment: for each.
        logs: folder that gets a log file of each.

    Attributes:
        prefix: of each command, as of one that runs it on another host; it has to become the process itself.
    """

    prefix: Sequence[str] = ()

    def __init__(self, names: Sequence[str], arguments: Sequence[str], environment: dict[str, str], logs: Path) -> None:
        self._names, self._arguments = names, arguments
        # What a node keeps over a restart is of this run: an emergency stop of another one does not hold here.
        self._state = tempfile.TemporaryDirectory(prefix="magnetosuture_state_")
        self._environment = {**environment, "XDG_STATE_HOME": self._state.name}
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> NodeProcesses:
        """Start the nodes."""
        self._logs.mkdir(parents=True, exist_ok=True)
        try:
            for name in self._names:
                self.start(name)
        except BaseException:
            self.end()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        """End the nodes, politely first."""
        self.end()

    def check(self) -> None:
        """Raise `GraphError`, with its last line of output, if a node has ended."""
        for name, process in self._processes.items():
            if process.poll() is not None:
                lines = (self._logs / f"{name}.log").read_text(errors="replace").strip().splitlines()
                last = lines[-1] if lines else "it said nothing"
                raise GraphError(f"{name} ended with exit code {process.returncode}: {last}")

    def start(self, name: str, *, module: str = "", arguments: Sequence[str] = ()) -> None:
        """Start one more node, or one again that has ended.

        Args:
            name: what it and its log are called here.
            module: that runs it; the one of that name in this subpackage if empty.
            arguments: besides those for all, after `--ros-args`.
        """
        program = [module] if module else ["magnetosuture_thread.nodes.program", name]
        command = [*self.prefix, sys.executable, "-m", *program, "--ros-args", *self._arguments, *arguments]
        with (self._logs / f"{name}.log").open("wb") as log:
            streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": subprocess.STDOUT}
            # In a session of its own: Ctrl-C is ours to pass on.
            options: dict[str, Any] = {"start_new_session": True, "preexec_fn": end_with_parent}
            self._processes[name] = subprocess.Popen(command, env=self._environment, **streams, **options)

    def kill(self, name: str) -> None:
        """Kill a node, as a crash would."""
        process = self._processes.pop(name)
        process.kill()
        process.wait()

    def ended(self, name: str) -> bool:
        """Return whether a node has ended."""
        return self._processes[name].poll() is not None

    def end(self) -> None:
        """End the nodes, politely first, and wait until they have ended."""
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in self._processes.values():
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._state.cleanup()


def end_with_parent() -> None:
    """Ask Linux to interrupt this process when its parent dies.

    A shell lets what it runs in the background ignore SIGINT, and that is inherited; it is undone here.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _LIBC.prctl(1, signal.SIGINT)  # PR_SET_PDEATHSIG


def raise_priority(priority: int) -> str:
    """Give all threads of this process a real-time priority, and return the result as text.

    Under the ordinary scheduling a process that wakes up waits for others that are busy, here by up to some
    milliseconds. Threads that begin later inherit the priority. What computes most of the time must not have any:
    ordinary threads of the kernel pass on the bytes of serial lines, and stand still while all processors are taken.

    Args:
        priority: of SCHED_FIFO, 1 to 99; with 0 all stays as it is.

    Returns:
        How the process is scheduled now, for a person.
    """
    if not priority:
        return "ordinary"
    try:
        for thread in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):  # a thread that has just ended
                os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return f"ordinary; real-time priority {priority} refused ({error.strerror}), see `ulimit -r`"
    return f"real time, priority {priority}"


@contextmanager
def without_priority() -> Iterator[None]:
    """Leave the real-time priority of this thread meanwhile: who compiles for a minute must not take a processor."""
    scheduling = os.sched_getscheduler(0), os.sched_getparam(0)
    leave_priority()
    try:
        yield
    finally:
        if scheduling[0] == os.SCHED_FIFO:
            with suppress(OSError):
                os.sched_setscheduler(0, *scheduling)


def leave_priority() -> None:
    """Schedule this thread as ordinary ones, if it has inherited a real-time priority.

    For a worker that takes long, which must not hold up other processes. Where these keep it from running while it has
    Python's lock, its own process waits with it.
    """
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


class Interruption:
    """Keeps the signals that interrupt this process until it is asked whether one came.

    The library behind rclpy calls Python to make and convert messages, and has its own idea of an exception there: a
    KeyboardInterrupt comes out as another error, or is lost. Signals that are ignored, or that end the process
    without a word to Python, are left as they are, and outside the main thread, which gets none, so are all.
    """

    def __init__(self) -> None:
        self._asked = False
        self._before: dict[signal.Signals, Any] = {}  # handlers

    def __enter__(self) -> Interruption:
        """Begin to keep signals."""
        if threading.current_thread() is threading.main_thread():
            kept = [which for which in STOPS if callable(signal.getsignal(which))]
            self._before = {which: signal.signal(which, self._keep) for which in kept}
        return self

    def __exit__(self, *error: object) -> None:
        """Keep no more; raise for one that came, unless something was raised already.

        Raises:
            KeyboardInterrupt: a signal came.
        """
        for which, handler in self._before.items():
            signal.signal(which, handler)
        if error[0] is None:
            self.check()

    def check(self) -> None:
        """Raise if a signal came.

        Raises:
            KeyboardInterrupt: one came.
        """
        if self._asked:
            self._asked = False
            raise KeyboardInterrupt

    def _keep(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
