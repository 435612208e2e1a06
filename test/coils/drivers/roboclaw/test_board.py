"""One board through the maker's library, with a test at the other end of the line."""

from __future__ import annotations

import itertools
import math
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.coils.drivers import roboclaw as board_module
from magnetosuture_thread.coils.drivers.roboclaw import Board, DeviceError, ExchangePort
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.rig import power as packets
from magnetosuture_thread.rig.power import RoboClawBoard

ANSWER_TIMEOUT = CoilBridgeSettings().roboclaw_answer_timeout


class Peer:
    """The other end of a line: what comes in, and a thread that answers."""

    def __init__(self) -> None:
        self.host, self._device = os.openpty()
        tty.setraw(self._device)
        self.path = os.ttyname(self._device)
        self.heard: list[bytes] = []
        self._ends = threading.Event()
        self._threads: list[threading.Thread] = []

    def answer(self, reply: Callable[[bytes], bytes], *, in_pieces: bool = False) -> None:
        """Answer each packet; in pieces, as they come, else once the packet is whole, however busy the machine is."""

        def serve() -> None:
            os.set_blocking(self.host, False)
            packet = b""
            while not self._ends.wait(0.0005):
                try:
                    packet += os.read(self.host, 1000)
                except BlockingIOError:
                    continue
                if in_pieces or len(packet) == 2 or packets.checksum(packet[:-2]) == int.from_bytes(packet[-2:], "big"):
                    self.heard.append(packet)
                    os.write(self.host, reply(packet))
                    packet = b""

        self._start(serve)

    def trickle(self, period: float) -> None:
        """Send a byte again and again."""

        def serve() -> None:
            while not self._ends.wait(period):
                os.write(self.host, b"A")

        self._start(serve)

    def _start(self, serve: Callable[[], None]) -> None:
        self._threads.append(threading.Thread(target=serve))
        self._threads[-1].start()

    def close(self) -> None:
        """End."""
        self._ends.set()
        for thread in self._threads:
            thread.join()
        os.close(self.host)
        os.close(self._device)


@pytest.fixture
def peer() -> Iterator[Peer]:
    """The other end of a line."""
    made = Peer()
    yield made
    made.close()


@pytest.fixture
def port(peer: Peer) -> Iterator[ExchangePort]:
    """Our end of it."""
    made = ExchangePort(peer.path, 115200, ANSWER_TIMEOUT)
    yield made
    made.close()


def wait_for(port: ExchangePort, answer_timeout: float) -> None:
    """Let a board have more time for an answer."""
    port.timeout = port.answer_timeout = answer_timeout


def board(port: ExchangePort) -> Board:
    """Return the board on a line."""
    settings = CoilBridgeSettings(driver_timeout=0.2, max_speed=0.005)
    return Board(port, 0, 128, "board 0", settings, lambda: False)


def simulated(made: RoboClawBoard) -> Callable[[bytes], bytes]:
    """Return what answers as a board does."""
    return lambda packet: made.receive(packet, time.monotonic())


def test_an_acknowledgement_that_came_too_late_is_not_one_for_the_next_command(peer, port):
    os.write(peer.host, b"\xff" * 8)
    with pytest.raises(DeviceError, match="board 0: no valid answer to DutyM1M2"):
        board(port).write_zero()


@pytest.mark.parametrize("reply", [b"\x00", b"\x7f", b"\xfe"])
def test_only_the_right_byte_acknowledges(peer, port, reply: bytes):
    peer.answer(lambda _: reply)
    with pytest.raises(DeviceError, match="no valid answer to DutyM1M2"):
        board(port).write_zero()


@pytest.mark.parametrize(
    ("command", "name"), [(packets.Command.SET_DUTIES, "DutyM1M2"), (packets.Command.SET_TIMEOUT, "SetTimeout")]
)
def test_an_acknowledgement_is_not_taken_for_that_of_the_next_request(peer, port, command: int, name: str):
    """Of a board that from some request on answers each packet only when the next one comes, however late that is."""
    wait_for(port, 2.0)
    answer, waiting = simulated(RoboClawBoard()), [b""]

    def late(packet: bytes) -> bytes:
        waiting.append(answer(packet))
        is_late = any(heard[1] == command for heard in peer.heard)
        return waiting.pop(0 if is_late else 1)

    peer.answer(late)
    with pytest.raises(DeviceError, match=f"no valid answer to {name}"):
        board(port).configure()


@pytest.mark.parametrize("stopped_before", [8, 7, 1], ids=["the clock", "the first bytes", "the last byte"])
def test_a_process_that_is_stopped_while_it_writes_currents_drives_no_board_later(
    peer, port, monkeypatch, stopped_before: int
):
    """As a stop between two instructions cannot be had at will, the thread sleeps there."""
    wait_for(port, 5.0)
    there = RoboClawBoard()
    peer.answer(simulated(there), in_pieces=True)
    made = board(port)
    made.voltage = 24.0
    expires = time.monotonic() + 0.2
    commanded = itertools.chain([(np.array([3.0, -6.0]), expires)], itertools.repeat((None, math.inf)))
    # On a busy machine the board may get a packet so slowly that it drops it; here it is asked until it answers.
    monkeypatch.setattr(board_module, "MAX_ATTEMPTS", 100)

    def stopped(size: int) -> None:
        if size == stopped_before and time.monotonic() < expires:
            time.sleep(expires - time.monotonic() + 0.02)

    def late_select(*arguments: Any) -> Any:
        stopped(8)
        return select.select(*arguments)

    def late_write(file: int, data: bytes, size: int) -> int:
        stopped(size)
        return os.write(file, data)

    monkeypatch.setattr(board_module, "select", SimpleNamespace(select=late_select))
    monkeypatch.setattr(board_module, "_write", late_write)
    made.write(lambda: next(commanded))
    assert not there.timeline
    assert there.heard > expires


def test_an_exchange_ends_however_slowly_bytes_come(peer, port):
    peer.trickle(0.02)
    with pytest.raises(DeviceError, match="no valid answer to ReadVersion"):
        board(port).identify()
    assert len(port.answer) < 48  # which the library would wait for
