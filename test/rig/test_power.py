"""Simulated boards behind pseudo-terminals, and in a process of their own."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.rig.power import ACKNOWLEDGED, Command, Line, RoboClawBoard, StageProcess, checksum
from magnetosuture_thread.settings.errors import ConfigurationError, GraphError
from test.shared import wait_until

# Of the supply: a half, and a quarter reversed.
HALF_AND_BACK = bytes((129, Command.SET_DUTIES, 0x40, 0x00, 0xE0, 0x00))
ZEROS = bytes((129, Command.SET_DUTIES, 0, 0, 0, 0))
RIG = """
import sys, time
from magnetosuture_thread.rig.power import StageProcess
StageProcess([sys.argv[1]], 24.0, 1.0, 0.01).open()
print("open", flush=True)
time.sleep(60.0)
"""


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[StageProcess]:
    """Two boards, open."""
    made = StageProcess([str(tmp_path / "a"), str(tmp_path / "b")], 24.0, 1.0, 0.01)
    made.open()
    yield made
    made.close()


@contextmanager
def opened(path: Path) -> Iterator[int]:
    """Open a board's line."""
    device = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        yield device
    finally:
        os.close(device)


def send(device: int, packet: bytes) -> None:
    """Send a packet to a board, which acknowledges it."""
    os.write(device, packet + checksum(packet).to_bytes(2, "big"))
    assert os.read(device, 1) == ACKNOWLEDGED


def test_boards_elsewhere_are_written_to_here_and_their_currents_read(stage, tmp_path):
    assert stage.currents()[0] == pytest.approx(4 * [0.0])
    with opened(tmp_path / "b") as device:
        send(device, HALF_AND_BACK)
        wait_until(lambda: stage.currents()[0] == pytest.approx([0.0, 0.0, 12.0, -6.0], abs=0.05), "the currents")
    stage.close()
    stage.close()
    assert not list(tmp_path.iterdir())


def test_a_look_that_comes_late_gets_all_that_has_flowed(stage, tmp_path):
    _, begin = stage.currents()
    with opened(tmp_path / "b") as device:
        for packet in (HALF_AND_BACK, ZEROS):
            send(device, packet)
            time.sleep(0.1)
    currents, end = stage.currents()
    flowed = (end - begin) * currents[2:]
    assert flowed[1] == pytest.approx(-0.5 * flowed[0], rel=1e-3)
    assert 0.1 * 12.0 <= flowed[0] < (end - begin - 0.1) * 12.0 + 0.01  # the fall lets flow what the rise did not


@pytest.mark.parametrize("limit", [30.0, 9.0])
def test_the_charge_of_a_coil_is_the_integral_of_its_current(limit: float):
    board, late, times, currents = RoboClawBoard(), RoboClawBoard(), np.arange(0.0, 0.2, 1e-4), []
    board.limits = late.limits = [round(100.0 * limit)] * 2
    for now in times:
        board.receive(b"", now)
        if now in (times[100], times[1200]):
            packet = HALF_AND_BACK if now == times[100] else ZEROS
            packet = bytes((board.address, *packet[1:]))
            for one in (board, late):
                one.receive(packet + checksum(packet).to_bytes(2, "big"), now)
        currents.append(board.currents)
    late.advance(times[-1])
    assert board.charges == pytest.approx(np.trapezoid(currents, times, axis=0), rel=1e-3)
    assert late.charges == pytest.approx(board.charges, rel=1e-3)


def test_ctrl_c_is_for_the_rig(stage):
    assert os.getsid(stage.pid) == stage.pid != os.getsid(0)


def test_a_path_that_cannot_be_used_is_said_here(tmp_path):
    stage = StageProcess([str(tmp_path / "nowhere" / "a")], 24.0, 1.0, 0.01)
    with pytest.raises(ConfigurationError, match=r"power_stage_ports: .*nowhere.*No such file"):
        stage.open()
    with pytest.raises(GraphError, match="are not open"):
        stage.currents()


def test_boards_that_died_have_no_current(stage):
    os.kill(stage.pid, signal.SIGKILL)
    os.waitid(os.P_PID, stage.pid, os.WEXITED | os.WNOWAIT)
    with pytest.raises(GraphError, match=r"simulated boards ended \(exit code -9\)"):
        stage.currents()


def test_boards_go_with_a_rig_that_is_killed(tmp_path):
    rig = subprocess.Popen([sys.executable, "-c", RIG, tmp_path / "a"], stdout=subprocess.PIPE)
    try:
        assert rig.stdout is not None
        assert rig.stdout.readline() == b"open\n"
        assert (tmp_path / "a").is_symlink()
    finally:
        rig.kill()
        rig.communicate()
    wait_until(lambda: not list(tmp_path.iterdir()), "the boards to be taken away")


def main_voltage(path: Path) -> float:
    """Return what the board at a path answers, once it has answered whole or 10 s are over [V]."""
    with opened(path) as device:
        os.write(device, question := bytes((128, Command.GET_MAIN_VOLTAGE)))
        answer, until = b"", time.monotonic() + 10.0
        while len(answer) < 4 and (left := until - time.monotonic()) > 0.0:
            if select.select([device], [], [], left)[0]:
                answer += os.read(device, 100)
    assert answer[2:] == checksum(question + answer[:2]).to_bytes(2, "big")
    return 0.1 * int.from_bytes(answer[:2], "big")


def test_what_a_killed_simulation_left_is_replaced_and_anything_else_stays(tmp_path):
    (tmp_path / "left").symlink_to("/dev/pts/999999")
    line = Line(tmp_path / "left", [RoboClawBoard()])
    line.plug()
    for _ in range(3):  # nobody has it open in between
        assert main_voltage(line.path) == 24.0
    line.unplug()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigurationError, match="a path for a symbolic link"):
        Line(tmp_path / "file", [RoboClawBoard()]).plug()
    assert (tmp_path / "file").read_text() == "mine"
