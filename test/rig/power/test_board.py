"""The simulated board alone, by a clock of the test's own, against packets that are written out here."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from magnetosuture_thread.rig import power as packets
from magnetosuture_thread.rig.power import FULL, RoboClawBoard


def packet(command: int, *values: int, form: str = ">hh", address: int = 128) -> bytes:
    """Return a packet that changes something."""
    data = bytes((address, command)) + struct.pack(form, *values)
    return data + struct.pack(">H", packets.checksum(data))


def asked(board: RoboClawBoard, command: int, form: str, time: float) -> tuple[int, ...]:
    """Return what a board answers, its checksum verified."""
    question = bytes((board.address, command))
    answer = board.receive(question, time)
    assert struct.unpack(">H", answer[-2:])[0] == packets.checksum(question + answer[:-2])
    return struct.unpack(form, answer[:-2])


def test_what_is_not_right_is_not_answered():
    board = RoboClawBoard()
    good = packet(34, 1000, 0)
    for at in range(2, len(good)):
        bad = bytearray(good)
        bad[at] ^= 0x10
        assert board.receive(bytes(bad), float(at)) == b""
    assert board.receive(bytes((128, 77)), 20.0) == b""
    assert board.duties == (0, 0)
    assert board.receive(good, 21.0) == b"\xff"


def test_it_stops_by_itself_when_it_hears_nothing():
    board = RoboClawBoard()
    board.receive(packet(14, 3, form=">B"), 1.0)
    assert asked(board, 15, ">B", 1.0) == (3,)
    board.receive(packet(34, 1000, 0), 1.1)
    board.receive(bytes((128, 48)), 1.3)  # whatever it is asked keeps it going
    board.advance(1.59)
    assert board.duties == (1000, 0)
    board.advance(5.0)
    assert board.duties == (0, 0)
    assert board.timeline[-1][0] == pytest.approx(1.6)
    assert board.currents[0] == pytest.approx(0.0, abs=1e-6)


def test_a_current_follows_its_duty_with_the_coils_time_constant():
    board = RoboClawBoard(supply=24.0, resistance=2.0, inductance=0.02)
    board.receive(packet(34, FULL // 2, -FULL // 4), 1.0)
    board.advance(1.01)
    goal = np.array([FULL // 2, -FULL // 4]) / FULL * 12.0
    np.testing.assert_allclose(board.currents, goal * (1.0 - np.exp(-1.0)))
    often = RoboClawBoard(supply=24.0, resistance=2.0, inductance=0.02)
    often.receive(packet(34, FULL // 2, -FULL // 4), 1.0)
    for time in np.arange(1.001, 1.0105, 0.001):
        often.advance(float(time))
    np.testing.assert_allclose(often.currents, board.currents)


def test_an_error_stops_it_while_it_lasts():
    board = RoboClawBoard()
    board.receive(packet(34, 1000, 0), 1.0)
    board.errors, board.warnings = 0x0001, 0x0010
    board.advance(1.1)
    assert board.duties == (0, 0)
    assert asked(board, 90, ">I", 1.1) == (0x00100001,)
    assert board.receive(packet(34, 1000, 0), 1.2) == b"\xff"
    assert board.duties == (0, 0)
    board.errors = 0
    assert board.receive(packet(34, 1000, 0), 1.4) == b"\xff"
    assert board.duties == (1000, 0)
