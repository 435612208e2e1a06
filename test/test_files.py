"""Files that a user names: only regular ones are opened."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from magnetosuture_thread.settings.files import read_regular


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_regular_file_is_not_even_opened(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch):
    """To open a device may do something to it."""
    path = {"pipe": tmp_path / "pipe", "device": Path("/dev/zero"), "folder": tmp_path}[kind]
    if kind == "pipe":
        os.mkfifo(path)
    monkeypatch.setattr(os, "open", lambda *given: pytest.fail("opened"))
    with pytest.raises(OSError, match="a folder, pipe or device"):
        read_regular(path, 100)


def test_a_regular_file_is_read_up_to_its_bound(tmp_path: Path):
    path = tmp_path / "file"
    path.write_bytes(bytes(100))
    assert read_regular(path, 100) == bytes(100)
    with pytest.raises(OSError, match="a larger file"):
        read_regular(path, 99)
