"""The benchmark of two hosts: the cable between them, and what counts as passed."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator

import pytest
from rich.console import Console

from benchmarks.network.cable import Cable
from benchmarks.network.command import CutReport, network_table

pytestmark = pytest.mark.slow


class PluggedCable:
    """A cable between two sockets, each frame a packet, in a thread of its own."""

    def __init__(self) -> None:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
        self.hosts = [host for host, _ in pairs]
        self._ends = [end for _, end in pairs]
        for each in (*self.hosts, *self._ends):
            each.setblocking(False)
        self.carrier: list[bool] = []
        self.answers: list[str] = []
        self._answered = threading.Condition()
        reading, self._writing = os.pipe()
        self._reading = reading
        cable = Cable((self._ends[0].fileno(), self._ends[1].fileno()), self.carrier.append)
        self._thread = threading.Thread(target=cable.run, args=(reading, self._on_answer))
        self._thread.start()

    def execute(self, command: str) -> str:
        """Execute a command; return the answer."""
        with self._answered:
            count = len(self.answers)
            os.write(self._writing, f"{command}\n".encode())
            assert self._answered.wait_for(lambda: len(self.answers) > count, 10.0)
            return self.answers[-1]

    def receive(self, host: int) -> bytes:
        """Return the next frame at a host."""
        self.hosts[host].settimeout(10.0)
        return self.hosts[host].recv(2048)

    def close(self) -> None:
        """End the cable."""
        os.close(self._writing)
        self._thread.join()
        os.close(self._reading)
        for each in (*self.hosts, *self._ends):
            each.close()

    def _on_answer(self, text: str) -> None:
        with self._answered:
            self.answers.append(text)
            self._answered.notify_all()


@pytest.fixture
def cable() -> Iterator[PluggedCable]:
    """Connect two hosts."""
    plugged = PluggedCable()
    yield plugged
    plugged.close()


def test_frames_pass_either_way_and_are_counted(cable: PluggedCable):
    cable.hosts[0].send(b"a" * 100)
    cable.hosts[1].send(b"b" * 30)
    assert cable.receive(1) == b"a" * 100
    assert cable.receive(0) == b"b" * 30
    assert cable.execute("traffic") == "100 30"


def test_what_is_sent_while_it_is_pulled_is_lost_and_the_desk_sees_no_carrier(cable: PluggedCable):
    cable.execute("pull")
    cable.hosts[0].send(b"lost")
    assert cable.execute("traffic") == "0 0"
    cable.execute("plug")
    cable.hosts[0].send(b"found")
    assert cable.receive(1) == b"found"
    assert cable.carrier == [False, True]


def test_frames_are_delayed_in_their_order(cable: PluggedCable):
    cable.execute("impair 0.2 0.0")
    for number in range(3):
        cable.hosts[1].send(bytes([number]))
    while cable.execute("traffic") != "0 3":
        pass
    with pytest.raises(BlockingIOError):
        cable.hosts[0].recv(10)
    assert [cable.receive(0) for _ in range(3)] == [b"\0", b"\1", b"\2"]


def test_a_cut_that_is_late_or_a_stop_that_is_not_kept_does_not_pass():
    good = CutReport(0.05, 0.05, zero=[0.1, 0.19], resumed=[0.5], stops=2, stops_kept=2)
    assert good.passed
    assert not CutReport(0.0, 0.0, zero=[0.3], resumed=[0.5], late=1).passed
    assert not CutReport(0.0, 0.0, zero=[0.1], resumed=[0.5], stops=2, stops_kept=1).passed
    assert good.to_json()["zero_maximum"] == 0.19
    console = Console(record=True, width=160)
    console.print(network_table([good]))
    assert "50 ms, 5 % lost" in console.export_text()
