"""Two hosts and the cable between them, as network namespaces of this machine.

As a program it is the cable, between two TAP devices, which can be pulled, delay packets and lose them: not every
kernel can delay and lose packets by itself (netem). Commands come in lines on standard input, and each is answered by
an empty line: `pull`, `plug`, `impair DELAY LOSS` (s, share).
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count

from magnetosuture_thread.settings.errors import GraphError

_CLONE_NEWNET, _TUNSETIFF, _TUNSETCARRIER, _IFF_TAP_NO_PI = 0x40000000, 0x400454CA, 0x400454E2, 0x1002
# Nodes of one machine exchange messages by shared memory, which two hosts do not have in common.
_OWN_SHARED_MEMORY = 'mount -t tmpfs tmpfs /dev/shm && exec "$0" "$@"'


@contextmanager
def two_hosts() -> Iterator[tuple[Callable[[str], None], tuple[str, ...]]]:
    """Make the rig's host, which this process joins, and the desk's, with a cable between them.

    It is meant for the main thread of a process of its own: threads that run already stay where they are.

    Yields:
        What executes a command of the cable, and what a command begins with that is to run on the desk's host. The
        cable is pulled at the desk, whose host sees that; the rig's sees nothing but silence.

    Raises:
        GraphError: this process may not make namespaces, or a command for that is missing.
    """
    missing = [name for name in ("ip", "nsenter", "unshare", "mount") if shutil.which(name) is None]
    if missing:
        raise GraphError(f"{', '.join(missing)}: not found; install iproute2 and util-linux")
    hosts = [f"{name}_{os.getpid()}" for name in ("rig", "desk")]
    devices = [f"{host}_{os.getpid() % 100_000}" for host in ("r", "d")]
    network = os.open("/proc/self/ns/net", os.O_RDONLY)
    with ExitStack() as stack:
        for host in hosts:
            stack.callback(subprocess.run, ("ip", "netns", "delete", host), capture_output=True, check=False)
        command = [sys.executable, "-m", "benchmarks.hosts", *devices]
        cable = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        stack.callback(cable.communicate)  # its devices end with it
        assert cable.stdin is not None
        assert cable.stdout is not None
        commands, answers = cable.stdin, cable.stdout
        if answers.readline() != "ready\n":
            raise GraphError("no TAP device can be made; that takes root's rights and /dev/net/tun")
        for number, (host, device) in enumerate(zip(hosts, devices, strict=True), 1):
            _run("ip", "netns", "add", host)
            _run("ip", "link", "set", device, "netns", host, "name", "eth0")
            for name in ("lo", "eth0"):
                _run("ip", "-n", host, "link", "set", name, "up")
            _run("ip", "-n", host, "address", "add", f"10.0.0.{number}/24", "dev", "eth0")
            _run("ip", "-n", host, "route", "add", "default", "dev", "eth0")

        def execute(command: str) -> None:
            commands.write(f"{command}\n")
            commands.flush()
            answers.readline()

        _join(f"/run/netns/{hosts[0]}")
        stack.callback(_join, f"/proc/self/fd/{network}")
        enter = ("nsenter", f"--net=/run/netns/{hosts[1]}", "unshare", "--mount")
        yield execute, (*enter, "sh", "-c", _OWN_SHARED_MEMORY)


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


def main(*names: str) -> None:
    """Make two TAP devices, which last as long as this process, and take frames from each to the other.

    Frames that are on their way when the cable is pulled arrive all the same. It ends with the commands.
    """
    ends = [os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK) for _ in names]
    for end, name in zip(ends, names, strict=True):
        fcntl.ioctl(end, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TAP_NO_PI))
    print("ready", flush=True)
    waiting: list[tuple[float, int, int, bytes]] = []  # due, order, end that gets it, frame
    pulled, delay, loss, commands, chance, order = False, 0.0, 0.0, b"", random.Random(1), count()
    inlet = sys.stdin.fileno()
    while True:
        left = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        ready, _, _ = select.select([*ends, inlet], [], [], left)
        for index in (0, 1):
            if ends[index] in ready:
                frame = os.read(ends[index], 65536)
                if not pulled and chance.random() >= loss and len(waiting) < 10_000:
                    heapq.heappush(waiting, (time.monotonic() + delay, next(order), ends[1 - index], frame))
        if inlet in ready:
            if not (read := os.read(inlet, 4096)):
                return
            *lines, commands = (commands + read).split(b"\n")
            for name, *values in (line.decode().split() for line in lines):
                if name == "impair":
                    delay, loss = map(float, values)
                else:
                    pulled = name == "pull"
                    fcntl.ioctl(ends[1], _TUNSETCARRIER, struct.pack("i", not pulled))
                print(flush=True)
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, end, frame = heapq.heappop(waiting)
            with suppress(OSError):  # the host has taken its device down
                os.write(end, frame)


if __name__ == "__main__":
    main(*sys.argv[1:])
