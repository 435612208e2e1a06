"""Files: only regular ones of a bounded size are read, only new or regular ones written, whole or not at all."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from magnetosuture_thread import ConfigurationError, cli
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene_files import write_scene
from magnetosuture_thread.settings.errors import BagError, RecordingEndedError
from magnetosuture_thread.settings.files import input_problem, output_problem, read_regular, whole_file, whole_folder
from test.bags.bags import STRING, read, texts, write_mcap, write_rosbag
from test.shared import run_python


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_regular_file_is_not_even_opened(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch):
    """To open a device may do something to it; to open a pipe may block."""
    path = {"pipe": tmp_path / "pipe", "device": Path("/dev/zero"), "folder": tmp_path}[kind]
    if kind == "pipe":
        os.mkfifo(path)
    monkeypatch.setattr(Path, "open", lambda *given: pytest.fail("opened"))
    with pytest.raises(OSError, match="a folder, pipe or device"):
        read_regular(path)


BOMB = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))


def test_what_cannot_be_a_setup_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "binary.yaml").write_bytes(bytes(range(256)))
    (tmp_path / "huge.yaml").write_text("a: " + "x" * 4_000_000)
    (tmp_path / "bomb.yaml").write_text(BOMB)
    (tmp_path / "deep.yaml").write_text("[" * 100_000)
    for name in ("pipe", "binary", "huge", "bomb", "deep"):
        assert cli.main(["scene", "check", str(tmp_path / f"{name}.yaml")]) == 2
        errors = capsys.readouterr().err
        assert errors.count("\n") == 1
        assert len(errors) < 500


def test_an_output_that_is_or_is_inside_of_an_input_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "one").mkdir()
    bag = write_mcap(tmp_path / "one" / "a.mcap", texts(3), {"/text": STRING})
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.MCAP, texts(3), {"/text": STRING})
    before = bag.read_bytes()
    (tmp_path / "link.json").hardlink_to(bag)
    for source, output, words in (
        (bag, bag, "is the input"),
        (bag, tmp_path / "link.json", "is the input"),
        (folder, folder / "found.json", "is inside of the input"),
        (folder, folder / "metadata.yaml", "is inside of the input"),
    ):
        assert cli.main(["bag", "check", str(source), "--json", str(output)]) == 2
        assert words in capsys.readouterr().err
    assert cli.main(["bag", "repair", str(folder), "--output", str(folder / "new")]) == 2
    assert bag.read_bytes() == before
    assert read(Bag(folder)) == texts(3)
    assert sorted(path.name for path in folder.iterdir()) == ["bag.mcap", "metadata.yaml"]
    # Beside bags in a folder of bags there is room.
    assert input_problem(tmp_path / "results", [tmp_path]) == ""


def test_two_outputs_are_two_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = str(tmp_path / "x.yaml")
    assert cli.main(["calibrate", str(tmp_path), "--output", output, "--json", output]) == 2
    assert "named by another option" in capsys.readouterr().err


def test_only_new_and_regular_files_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    bag = write_mcap(tmp_path / "a.mcap", texts(3), {"/text": STRING})
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "file.json").write_text("kept")
    (tmp_path / "link.json").symlink_to(tmp_path / "file.json")
    (tmp_path / "null.json").symlink_to("/dev/null")
    paths = [*(tmp_path / f"{name}.json" for name in ("pipe", "link", "null")), Path("/dev/null")]
    before = [(os.lstat(path).st_ino, os.lstat(path).st_mode) for path in paths]
    for path in paths:
        assert cli.main(["bag", "check", str(bag), "--json", str(path)]) == 2
        assert "expected a new file, or a regular one" in capsys.readouterr().err
        with pytest.raises(BagError, match="expected a new file"), whole_file(path):
            pytest.fail("written")
        with pytest.raises(ConfigurationError):
            write_scene(Scene(), path)
    assert [(os.lstat(path).st_ino, os.lstat(path).st_mode) for path in paths] == before
    assert (tmp_path / "file.json").read_text() == "kept"
    assert cli.main(["bag", "check", str(bag), "--json", str(tmp_path / "file.json")]) == 0
    assert json.loads((tmp_path / "file.json").read_text())["messages"] == 3


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK or path != tmp_path)  # whoever runs this
    assert "cannot be written" in output_problem(tmp_path / "a.json")
    assert "cannot be written" in output_problem(tmp_path / "new" / "a.json")


# Prints the modes of a file and of a folder with a file, made under a umask.
MODES = """
import os, sys
from pathlib import Path
from magnetosuture_thread.settings.files import whole_file, whole_folder
os.umask(int(sys.argv[2], 8))
file, folder = Path(sys.argv[1]) / "file", Path(sys.argv[1]) / "folder"
with whole_file(file) as partial:
    partial.write_text("new")
with whole_folder(folder) as partial:
    (partial / "file").touch()
print(*(oct(path.stat().st_mode & 0o777) for path in (file, folder, folder / "file")))
"""


@pytest.mark.parametrize(("umask", "modes"), [("077", "0o600 0o700 0o600"), ("002", "0o664 0o775 0o664")])
def test_outputs_have_the_permissions_that_the_umask_says(tmp_path: Path, umask: str, modes: str):
    assert run_python("-c", MODES, tmp_path, umask).strip() == modes


def test_the_later_of_two_runs_to_one_output_is_refused(tmp_path: Path):
    def later() -> None:
        with whole_folder(tmp_path / "out") as second, whole_folder(tmp_path / "out") as first:
            (first / "mine").write_text("first")
            (second / "mine").write_text("second")

    with pytest.raises(BagError, match="cannot be written"):
        later()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "mine").read_text() == "first"
    for output in (tmp_path / "out", *map(Path, (".", "/", "..", ""))):
        with pytest.raises(BagError, match="exists already"), whole_folder(output):
            pass
    assert (tmp_path / "out" / "mine").read_text() == "first"


@pytest.mark.parametrize("stays", [True, False])
def test_a_recording_stays_when_the_disk_is_full_and_nothing_else_does(tmp_path: Path, stays: bool):
    output = tmp_path / "run"

    def record() -> None:
        with whole_folder(output, is_recording=stays) as folder:
            (folder / "run_0.mcap").write_text("recorded")
            raise RecordingEndedError(folder, "the disk is full", folder / "run_0.mcap")

    with pytest.raises(BagError, match="the disk is full") as caught:
        record()
    assert list(tmp_path.rglob("*.mcap")) == [output / "run_0.mcap"] * stays
    assert list(tmp_path.iterdir()) == [output] * stays
    assert (str(output / "run_0.mcap") in str(caught.value)) == stays


def test_an_interruption_leaves_nothing(tmp_path: Path):
    for output in (whole_folder(tmp_path / "new" / "out"), whole_file(tmp_path / "file")):
        with pytest.raises(KeyboardInterrupt), output:
            raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
