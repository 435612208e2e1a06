"""How the thread of a line leaves its boards."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.coils.drivers.roboclaw.board import DeviceError, Vector
from magnetosuture_thread.coils.drivers.roboclaw.driver import LineReport, LineThread, Mailbox
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
