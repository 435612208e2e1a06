"""Folders that a command makes whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_folder


def test_the_later_of_two_runs_to_one_output_is_refused(tmp_path: Path):
    def later() -> None:
        with whole_folder(tmp_path / "out") as second, whole_folder(tmp_path / "out") as first:
            (first / "mine").write_text("first")
            (second / "mine").write_text("second")

    with pytest.raises(BagError, match="cannot be written"):
        later()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "mine").read_text() == "first"


@pytest.mark.parametrize("where", [".", "/", "..", ""])
def test_an_output_that_exists_is_not_touched(tmp_path: Path, where: str):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("precious")
    for output in (Path(where), tmp_path / "out"):
        with pytest.raises(BagError, match="exists already"), whole_folder(output):
            pass
    assert (tmp_path / "out" / "mine").read_text() == "precious"


def test_an_interruption_leaves_nothing(tmp_path: Path):
    with pytest.raises(KeyboardInterrupt), whole_folder(tmp_path / "new" / "out"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
