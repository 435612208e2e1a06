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


def ask(path: Path) -> bytes:
    """Return what comes back, once it is a whole answer or 10 s are over."""
    device = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(device, QUESTION)
        answer, until = b"", time.monotonic() + 10.0
        while len(answer) < 4 and (left := until - time.monotonic()) > 0.0:
            if select.select([device], [], [], left)[0]:
                answer += os.read(device, 100)
        return answer
    finally:
        os.close(device)


def test_a_board_answers_at_the_path(line):
    for _ in range(3):  # nobody has it open in between
        assert ask(line.path) == ANSWER


def test_what_a_killed_simulation_left_is_replaced_and_anything_else_stays(tmp_path):
    (tmp_path / "left").symlink_to("/dev/pts/999999")
    line = Line(tmp_path / "left", [RoboClawBoard()])
    line.plug()
    assert ask(line.path) == ANSWER
    line.unplug()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigurationError, match="a path for a symbolic link"):
        Line(tmp_path / "file", [RoboClawBoard()]).plug()
    assert (tmp_path / "file").read_text() == "mine"
