"""How the thread of a line leaves its boards."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import serial

from magnetosuture_thread.coils.drivers.roboclaw import board as board_module
from magnetosuture_thread.coils.drivers.roboclaw import line as line_module
from magnetosuture_thread.coils.drivers.roboclaw.driver import CLOSE_TIMEOUT
from magnetosuture_thread.coils.drivers.roboclaw.line import LineReport, LineThread, Mailbox
from magnetosuture_thread.coils.drivers.roboclaw.port import DeviceError, ExchangePort
from magnetosuture_thread.coils.drivers.roboclaw.protocol import Vector
from magnetosuture_thread.coils.settings import CoilBridgeSettings

ANSWER_TIMEOUT = CoilBridgeSettings().roboclaw_answer_timeout


class Stub:
    """A board that does not hear the first requests for zero, and a port."""

    def __init__(self, deaf: float = 0) -> None:
        self.requests = 0
        self.closed = False
        self._deaf = deaf

    def write_zero(self) -> None:
        """Take a request for zero."""
        self.requests += 1
        if self.requests <= self._deaf:
            raise DeviceError("nothing came")

    def reset_output_buffer(self) -> None:
        """Do nothing."""
        raise OSError("gone")

    def close(self) -> None:
        """Keep that it was closed."""
        self.closed = True


def left(*boards: Stub) -> LineThread:
    """Return a line that has left its boards."""
    line = LineThread(0, "/dev/none", {}, CoilBridgeSettings(), Mailbox(4, ["connecting"], 0.1))
    port = Stub()
    vars(line)["_boards"] = dict(enumerate(boards))
    assert not line._no_retry()
    vars(LineThread)["_leave"](line, port)
    assert port.closed
    return line


def test_a_board_that_did_not_hear_is_asked_for_zero_again():
    boards = Stub(), Stub(deaf=2), Stub()
    line = left(*boards)
    assert [board.requests for board in boards] == [1, 3, 1]
    assert line._no_retry()  # each request only once, as there are few milliseconds


def test_a_board_that_never_hears_keeps_nobody():
    boards = Stub(deaf=float("inf")), Stub()
    left(*boards)
    assert boards[1].requests == 1


class Clock:
    """A clock of the test's own, by which nothing takes time but what says so."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.slept: list[float] = []
        stub = SimpleNamespace(monotonic=lambda: self.now, sleep=self._sleep)
        for module in (board_module, line_module):
            patch.setattr(module, "time", stub)

    def _sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds


class DeadPort(serial.Serial):
    """A port where nobody answers, which each exchange waits for; tells how many there were."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()  # of no device
        self.is_open = True
        self._clock = clock
        self.answer = bytearray()
        self.exchanges = 0

    def begin(self, expires: float) -> None:
        """Begin an exchange."""
        self.exchanges += 1
        self._clock.now += ANSWER_TIMEOUT

    def write(self, data: Any, /) -> int:
        """Take bytes."""
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        """Return nothing."""
        return b""

    def reset_input_buffer(self) -> None:
        """Have nothing to forget."""

    def reset_output_buffer(self) -> None:
        """Have nothing to forget."""

    def close(self) -> None:
        """Have nothing to close."""


def connected(clock: Clock, *boards: int, ends: bool = False) -> tuple[LineThread, DeadPort]:
    """Return a line that has tried to connect, and its port."""
    line = LineThread(0, "/dev/none", {n: 128 + n for n in boards}, CoilBridgeSettings(), Mailbox(4, [""], 0.1))
    port = DeadPort(clock)
    if ends:
        line.stop()
    with pytest.raises(DeviceError, match=r"board 0 .*: no valid answer to ReadVersion"):
        vars(LineThread)["_connect"](line, port)
    return line, port


def test_a_line_that_is_ended_tries_nothing_twice(monkeypatch):
    clock = Clock(monkeypatch)
    assert connected(clock, 0, 1)[1].exchanges == 2
    assert clock.slept == [board_module.RETRY_DELAY]
    assert connected(clock, 0, 1, ends=True)[1].exchanges == 1
    assert clock.slept == [board_module.RETRY_DELAY]


def test_a_board_has_as_long_for_an_answer_as_is_set(bench):
    bench.stage.open()
    (path, *_), settings = bench.settings().roboclaw_ports, bench.settings(roboclaw_answer_timeout=0.25)
    line, opened = LineThread(0, path, {0: 128}, settings, Mailbox(2, [""], 0.1)), []

    def connect(port: ExchangePort) -> None:
        opened.append((port.timeout, port.answer_timeout))
        line.stop()

    vars(line)["_connect"] = connect
    line.start()
    line.join(10.0)
    assert opened == [(0.25, 0.25)]


@pytest.mark.parametrize("boards", [(0,), (0, 1)])
def test_boards_that_are_left_are_asked_for_zero_without_a_break(monkeypatch, boards: tuple[int, ...]):
    clock = Clock(monkeypatch)
    line, port = connected(clock, *boards)
    clock.slept.clear()
    began, before = clock.now, port.exchanges
    vars(LineThread)["_leave"](line, port)
    assert clock.slept == []  # nor is one tried twice before the other one's turn
    assert port.exchanges - before == round(line_module.SHUTDOWN_TIMEOUT / ANSWER_TIMEOUT)
    # An exchange that goes on when it ends may take twice the answer timeout.
    assert clock.now - began < CLOSE_TIMEOUT - 2.0 * ANSWER_TIMEOUT


class Hearing:
    """A board that tells what it is asked for, at each of two attempts."""

    voltage, currents, warnings = 24.0, (0.0, 0.0), ()

    def __init__(self, between: Callable[[], Any]) -> None:
        self.asked: list[list[float] | None] = []
        self._between = between

    def write(self, newest: Callable[[], tuple[Vector | None, float]]) -> None:
        """Take currents twice."""
        for _ in range(2):
            currents, _ = newest()
            self.asked.append(None if currents is None else currents.tolist())
            self._between()

    def poll(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize(("stop", "then"), [("zeros", [0.0, 0.0]), ("loss", None)])
def test_every_attempt_at_every_board_takes_what_is_newest(stop: str, then: list[float] | None):
    mailbox = Mailbox(4, ["", ""], 60.0)
    line = LineThread(0, "/dev/none", {}, CoilBridgeSettings(), mailbox)
    now = time.monotonic()
    for number in (0, 1):
        mailbox.set_ready(number, LineReport({}, {}, ()))
    mailbox.put(np.array([1.0, 2.0, 3.0, 4.0]), now)
    stops = {"zeros": lambda: mailbox.put(np.zeros(4), now), "loss": lambda: mailbox.set_failed(1, "gone")}
    first, second = Hearing(stops[stop]), Hearing(line.stop)
    vars(line)["_boards"] = {0: first, 1: second}
    vars(LineThread)["_serve"](line)
    assert first.asked == [[1.0, 2.0], then]
    assert second.asked == [then, then]


def test_each_board_has_its_own_two_coils(monkeypatch):
    line = LineThread(0, "/dev/none", {}, CoilBridgeSettings(), Mailbox(4, [""], 60.0))
    vars(line)["_mailbox"].put(np.array([1.0, 2.0, 3.0, 4.0]), time.monotonic())
    boards = Hearing(lambda: None), Hearing(line.stop)
    vars(line)["_boards"] = dict(enumerate(boards))
    vars(LineThread)["_serve"](line)
    assert [board.asked[0] for board in boards] == [[1.0, 2.0], [3.0, 4.0]]
