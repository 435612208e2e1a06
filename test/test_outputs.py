"""Outputs never are inputs, replace regular files only, and no name reaches terminal, page or table raw."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from magnetosuture_thread import ConfigurationError, cli
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.evaluation.tables import failed_row, flat, table_csv
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene_files import write_scene
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_file
from magnetosuture_thread.settings.outputs import input_problem, output_problem
from test.bags.bags import STRING, read, texts, write_mcap, write_rosbag

NASTY = "a\x1b[31m\u202eb\x9b1m"


def test_an_output_that_is_the_input_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    bag = write_mcap(tmp_path / "a.mcap", texts(3), {"/text": STRING})
    before = bag.read_bytes()
    (tmp_path / "link.json").hardlink_to(bag)
    for output in ("a.mcap", "link.json"):
        assert cli.main(["bag", "check", str(bag), "--json", str(tmp_path / output)]) == 2
        assert "is the input" in capsys.readouterr().err
    assert bag.read_bytes() == before


def test_an_output_within_a_bag_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.MCAP, texts(3), {"/text": STRING})
    for output in ("found.json", "metadata.yaml"):
        assert cli.main(["bag", "check", str(folder), "--json", str(folder / output)]) == 2
        assert "is inside of the input" in capsys.readouterr().err
    assert cli.main(["bag", "repair", str(folder), "--output", str(folder / "new")]) == 2
    assert read(Bag(folder)) == texts(3)
    assert sorted(path.name for path in folder.iterdir()) == ["bag.mcap", "metadata.yaml"]
    # Beside bags in a folder of bags there is room.
    assert input_problem(tmp_path / "results", [tmp_path]) == ""


def test_two_outputs_are_two_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    bag = write_mcap(tmp_path / "a.mcap", texts(3), {"/text": STRING})
    output = str(tmp_path / "x.yaml")
    assert cli.main(["calibrate", str(bag), "--output", output, "--json", output]) == 2
    assert "named by another option" in capsys.readouterr().err


def other_things(folder: Path) -> dict[str, Path]:
    """Return paths that are no regular file."""
    os.mkfifo(folder / "pipe.json")
    (folder / "file.json").write_text("kept")
    (folder / "link.json").symlink_to(folder / "file.json")
    (folder / "null.json").symlink_to("/dev/null")
    return {name: folder / f"{name}.json" for name in ("pipe", "link", "null")} | {"device": Path("/dev/null")}


def test_only_new_and_regular_files_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    bag = write_mcap(tmp_path / "a.mcap", texts(3), {"/text": STRING})
    paths = other_things(tmp_path)
    before = {name: os.lstat(path) for name, path in paths.items()}
    for path in paths.values():
        assert output_problem(path)
        assert cli.main(["bag", "check", str(bag), "--json", str(path)]) == 2
        assert "expected a new file, or a regular one" in capsys.readouterr().err
        with pytest.raises(BagError, match="expected a new file"), whole_file(path):
            pytest.fail("written")
        with pytest.raises(ConfigurationError):
            write_scene(Scene(), path)
    after = {name: os.lstat(path) for name, path in paths.items()}
    assert {name: (each.st_ino, each.st_mode) for name, each in after.items()} == {
        name: (each.st_ino, each.st_mode) for name, each in before.items()
    }
    assert (tmp_path / "file.json").read_text() == "kept"
    assert cli.main(["bag", "check", str(bag), "--json", str(tmp_path / "file.json")]) == 0
    assert json.loads((tmp_path / "file.json").read_text())["messages"] == 3


def test_tables_show_names_escaped():
    row = failed_row(NASTY, NASTY, NASTY)
    table = table_csv([row])
    assert len(flat(row)) == table.splitlines()[0].count(",") + 1
    assert not set(table) & {"\x1b", "\u202e", "\x9b"}
    assert r"\x1b" in table
