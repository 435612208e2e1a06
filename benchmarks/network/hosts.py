"""Two hosts and the cable between them, as network namespaces of this machine."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from types import TracebackType

from magnetosuture_thread.errors import GraphError

_CLONE_NEWNET = 0x40000000
# Nodes of one machine exchange messages by shared memory, which two hosts do not have in common.
_OWN_SHARED_MEMORY = 'mount -t tmpfs tmpfs /dev/shm && exec "$0" "$@"'
COMMANDS = ("ip", "nsenter", "unshare", "mount")


class TwoHosts:
    """The rig's host, which this process joins, and the desk's, with a cable between them.

    It is meant for the main thread of a process of its own: threads that run already stay where they are.

    Raises:
        GraphError: this process may not make namespaces, or a command for that is missing.
    """

    def __init__(self) -> None:
        self._rig, self._desk = (f"{name}_{os.getpid()}" for name in ("rig", "desk"))
        self._network = os.open("/proc/self/ns/net", os.O_RDONLY)
        self._cable: _Cable | None = None

    def __enter__(self) -> TwoHosts:
        """Make the hosts and the cable, and join the rig's host."""
        missing = [name for name in COMMANDS if shutil.which(name) is None]
        if missing:
            raise GraphError(f"{', '.join(missing)}: not found; install iproute2 and util-linux")
        try:
            devices = [f"{host}_{os.getpid() % 100_000}" for host in ("r", "d")]
            self._cable = _Cable(devices)
            for number, (host, device) in enumerate(zip((self._rig, self._desk), devices, strict=True), 1):
                _run("ip", "netns", "add", host)
                _run("ip", "link", "set", device, "netns", host, "name", "eth0")
                for name in ("lo", "eth0"):
                    _run("ip", "-n", host, "link", "set", name, "up")
                _run("ip", "-n", host, "address", "add", f"10.0.0.{number}/24", "dev", "eth0")
                _run("ip", "-n", host, "route", "add", "default", "dev", "eth0")
            _join(f"/run/netns/{self._rig}")
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Join the machine's own network again, and remove the hosts."""
        _join(f"/proc/self/fd/{self._network}")
        self._remove()

    @property
    def at_the_desk(self) -> tuple[str, ...]:
        """What a command begins with that is to run on the desk's host."""
        enter = ("nsenter", f"--net=/run/netns/{self._desk}", "unshare", "--mount")
        return (*enter, "sh", "-c", _OWN_SHARED_MEMORY)

    def pull(self) -> None:
        """Pull the cable at the desk, whose host sees that; the rig's sees nothing but silence."""
        self._execute("pull")

    def plug(self) -> None:
        """Put it back."""
        self._execute("plug")

    def impair(self, delay: float, loss: float) -> None:
        """Delay and lose packets, in either direction.

        Args:
            delay: of each packet [s].
            loss: share of packets that is lost, 0 to 1; with 0 and no delay the cable is as before.
        """
        self._execute(f"impair {delay} {loss}")

    def _execute(self, command: str) -> str:
        assert self._cable is not None
        return self._cable.execute(command)

    def _remove(self) -> None:
        if self._cable is not None:
            self._cable.end()
        for host in (self._rig, self._desk):
            subprocess.run(("ip", "netns", "delete", host), capture_output=True, check=False)


class _Cable:
    """The process of a cable between two TAP devices, which are there once it is made."""

    def __init__(self, devices: list[str]) -> None:
        command = [sys.executable, "-m", "benchmarks.network.cable", *devices]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        if self._answer() != "ready":
            raise GraphError("no TAP device can be made; that takes root's rights and /dev/net/tun")

    def execute(self, command: str) -> str:
        """Execute a command; return the answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        return self._answer()

    def end(self) -> None:
        """End it; its devices end with it."""
        self._process.communicate()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise GraphError(f"{' '.join(command)}: {done.stderr.strip()}; making network namespaces takes root's rights")


def _join(path: str) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        if ctypes.CDLL(None, use_errno=True).setns(descriptor, _CLONE_NEWNET):
            raise GraphError(f"setns: {os.strerror(ctypes.get_errno())}")
    finally:
        os.close(descriptor)
