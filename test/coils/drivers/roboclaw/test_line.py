"""How the thread of a line leaves its boards."""

from __future__ import annotations

from magnetosuture_thread.coils.drivers.roboclaw.line import LineThread
from magnetosuture_thread.coils.drivers.roboclaw.mailbox import Mailbox
from magnetosuture_thread.coils.drivers.roboclaw.port import DeviceError
from magnetosuture_thread.coils.settings import CoilBridgeSettings


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
    assert not line._hurries()
    vars(LineThread)["_leave"](line, port)
    assert port.closed
    return line


def test_a_board_that_did_not_hear_is_asked_for_zero_again():
    boards = Stub(), Stub(deaf=2), Stub()
    line = left(*boards)
    assert [board.requests for board in boards] == [1, 3, 1]
    assert line._hurries()  # each request only once, as there are few milliseconds


def test_a_board_that_never_hears_keeps_nobody():
    boards = Stub(deaf=float("inf")), Stub()
    left(*boards)
    assert boards[1].requests == 1
