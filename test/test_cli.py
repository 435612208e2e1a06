"""The command: help, exit codes, errors in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from magnetosuture_thread import cli
from magnetosuture_thread.cli import COMMANDS
from magnetosuture_thread.thread.predictor import FORMULATIONS
from magnetosuture_thread.thread.solvers import SOLVERS
from test.shared import run_python


def test_help_names_every_command_and_the_exit_codes():
    shown = run_python("-m", "magnetosuture_thread.cli", "--help")
    for words in (*COMMANDS, "no medical device", "0 done, 1 the job failed, 2 wrong use"):
        assert words in shown


def test_help_waits_for_no_package_of_a_command():
    slow = "numpy", "numba", "cv2", "scipy", "osqp", "matplotlib", "rclpy"
    look = f"import sys; from magnetosuture_thread import cli; print([name for name in {slow} if name in sys.modules])"
    assert run_python("-c", look) == "[]\n"


WRONG = [
    *("", "dance", "replay bag", "replay bag --output out --rate fast", "replay bag --output out --rate nan"),
    *("render r.npz --output out --setup dish_50mm --seed -1", "simulate dish_50mm --output out --duration -1"),
    *("reproduce", "console --graph --replay bag", "console --port some"),
    *("track frames --centre 1", "track frames --needle-bright 0.5"),
    *("evaluate dir --formulation magic", "evaluate dir --segments 2", "evaluate dir --json /no/such/folder/x.json"),
]


@pytest.mark.parametrize("arguments", WRONG)
def test_wrong_use_is_2(arguments: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments.split())
    assert ended.value.code == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["replay", "nowhere"], 1, "error: nowhere: does not exist"),
        (["render", "no.npz", "--setup", "petri_35mm_polyamide"], 1, "error: no.npz: does not exist"),
        (["render", "no.npz", "--setup", "x" * 300], 2, "error: setup: got 'xxx"),
    ],
)
def test_a_failed_job_is_one_line(tmp_path: Path, monkeypatch, capsys, arguments: list[str], code: int, words: str):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*arguments, "--output", "out"]) == code
    errors = capsys.readouterr().err
    assert errors.startswith(words)
    assert errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_signs_that_a_terminal_lacks_end_nothing(encoding: str):
    """As of a container without a locale: results would be lost with them."""
    code = "import sys; from magnetosuture_thread.cli import exit_code; sys.exit(exit_code(lambda: print('µ ✓') or 0))"
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    shown = subprocess.run(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, timeout=300, check=True
    )
    assert shown.stdout.decode(encoding) == "µ ✓\n".encode(encoding, "backslashreplace").decode(encoding)


def test_without_ros_it_says_what_is_missing(monkeypatch, capsys, tmp_path: Path, short_bag: Path):
    with_ros = tuple(f"magnetosuture_thread.{name}" for name in ("nodes", "commands.live", "commands.simulate"))
    for name in [name for name in sys.modules if name.startswith(with_ros)]:
        monkeypatch.delitem(sys.modules, name)
    for name in ["rclpy", *(name for name in sys.modules if name.startswith("rclpy."))]:
        monkeypatch.setitem(sys.modules, name, None)
    assert cli.main(["replay", str(short_bag), "--output", str(tmp_path / "out")]) == 1
    assert "nodes and the live graph need ROS 2 Jazzy" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_words_of_the_command_are_those_of_the_model(capsys: pytest.CaptureFixture[str]):
    """They are written out in the command, whose help would be slow if it asked the model."""
    with pytest.raises(SystemExit):
        cli.main(["evaluate", "--help"])
    shown = capsys.readouterr().out
    assert "{" + ",".join(FORMULATIONS) + "}" in shown
    assert "{" + ",".join(SOLVERS) + "}" in shown
