"""Boards behind a pseudo-terminal."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from magnetosuture_thread.rig.power import Line, RoboClawBoard, checksum
from magnetosuture_thread.settings.errors import ConfigurationError

QUESTION = bytes((128, 24))
ANSWER = b"\x00\xf0" + checksum(QUESTION + b"\x00\xf0").to_bytes(2, "big")


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    """A line with one board."""
    made = Line(tmp_path / "board", [RoboClawBoard()])
    made.plug()
    yield made
    made.unplug()


def ask(path: Path, enough: int, patience: float = 10.0, question: bytes = QUESTION) -> bytes:
    """Return what comes back, once it is enough or the patience is over."""
    device = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(device, question)
        answer, until = b"", time.monotonic() + patience
        while len(answer) < enough and (left := until - time.monotonic()) > 0.0:
            if select.select([device], [], [], left)[0]:
                answer += os.read(device, 100)
        return answer
    finally:
        os.close(device)


def test_a_board_answers_at_the_path(line):
    for _ in range(3):  # nobody has it open in between
        assert ask(line.path, 4) == ANSWER


def test_a_line_that_is_taken_away_hangs_up_and_can_come_back(line):
    device = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
    line.unplug()
    line.unplug()
    assert not line.path.is_symlink()
    with pytest.raises(OSError, match="error"):
        os.write(device, QUESTION)
    os.close(device)
    line.plug()
    line.plug()
    assert ask(line.path, 4) == ANSWER


def test_what_a_killed_simulation_left_is_replaced_and_anything_else_stays(tmp_path):
    (tmp_path / "left").symlink_to("/dev/pts/999999")
    line = Line(tmp_path / "left", [RoboClawBoard()])
    line.plug()
    assert ask(line.path, 4) == ANSWER
    line.unplug()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigurationError, match="a path for a symbolic link"):
        Line(tmp_path / "file", [RoboClawBoard()]).plug()
    assert (tmp_path / "file").read_text() == "mine"
    with pytest.raises(ConfigurationError, match="No such file"):
        Line(tmp_path / "nowhere" / "board", [RoboClawBoard()]).plug()
