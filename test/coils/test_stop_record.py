"""The emergency stop and an unclean end, kept in a file over a restart."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from magnetosuture_thread.coils.coil_system import UNCLEAN_END, CoilSystem
from magnetosuture_thread.coils.latch import RecordedState, StopRecord
from magnetosuture_thread.settings.errors import InvalidInputError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file whose folder does not exist yet."""
    return tmp_path / "state" / "bridge.stop"


def recalled(path: Path) -> CoilSystem:
    """Return the system of a process that has just begun."""
    system = CoilSystem()
    system.recall(StopRecord(path))
    return system


@pytest.mark.parametrize("state", RecordedState)
def test_what_is_written_is_read_by_the_next_process(path, state):
    StopRecord(path).write(state)
    assert StopRecord(path).read() is state
    assert os.listdir(path.parent) == [path.name]


def test_it_is_on_the_disk_before_the_file_of_before_is_replaced(path, monkeypatch):
    StopRecord(path).write(RecordedState.SAFE)
    calls: list[str] = []
    replace = Path.replace

    def replaced(self: Path, to: Path) -> Path:
        calls.append("replace")
        return replace(self, to)

    monkeypatch.setattr(os, "fsync", lambda file: calls.append("sync"))
    monkeypatch.setattr(Path, "replace", replaced)
    StopRecord(path).write(RecordedState.STOPPED)
    assert calls == ["sync", "replace", "sync"]


@pytest.mark.parametrize("damage", [b"", b"\xff\xfe", b"stop", b"disarmed a b", b"disarmed -", b"x" * 100_000])
def test_a_damaged_file_is_an_emergency_stop(path, damage):
    path.parent.mkdir()
    path.write_bytes(damage)
    assert StopRecord(path).read() is RecordedState.STOPPED
    assert recalled(path).latch.emergency


def test_a_pipe_is_neither_waited_for_nor_replaced(path):
    path.parent.mkdir()
    os.mkfifo(path)
    assert StopRecord(path).read() is RecordedState.STOPPED
    with pytest.raises(OSError, match="pipe"):
        StopRecord(path).write(RecordedState.SAFE)


def test_a_stop_is_latched_in_the_next_process_until_a_reset(path):
    system = recalled(path)
    system.latch.stop()
    system.remember(ends=True)
    following = recalled(path)
    assert following.latch.emergency
    following.reset()
    assert not recalled(path).latch.latched_reason


def test_a_process_that_ended_while_armed_leaves_a_fault(path):
    system = recalled(path)
    system.latch.armed = True
    system.remember()
    following = recalled(path)
    assert following.latch.fault == UNCLEAN_END
    following.remember()
    assert recalled(path).latch.fault == UNCLEAN_END
    following.reset()
    assert not recalled(path).latch.latched_reason


def test_an_end_in_order_leaves_none(path):
    system = recalled(path)
    system.latch.armed = True
    system.remember()
    system.remember(ends=True)
    assert not recalled(path).latch.latched_reason


def test_what_cannot_be_written_is_not_reset(path):
    system = recalled(path)
    system.latch.stop()
    path.parent.write_text("a file in the place of the folder")
    with pytest.raises(InvalidInputError, match=r"stop_file: got .*bridge\.stop.*, expected a file that can"):
        system.reset()
    assert system.latch.emergency
