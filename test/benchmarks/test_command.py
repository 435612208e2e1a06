"""The command `python -m benchmarks`: help, wrong use, and where the figures go."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import keep_out
from benchmarks.__main__ import main
from benchmarks.bridge import command as bridge
from magnetosuture_thread.settings.errors import GraphError

WRONG = ["", "dance", "solver --json .", "solver --peers all", "bridge --kills -1", "attack moon", "vision --count 0"]


@pytest.mark.parametrize("arguments", WRONG)
def test_wrong_use_is_2(arguments: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(arguments.split())
    assert ended.value.code == 2
    assert capsys.readouterr().err


def test_figures_go_to_standard_output_alone():
    command = [sys.executable, "-m", "benchmarks", "keep-out", "--seconds", "0", "--json", "-"]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, cwd=root)
    figures = json.loads(done.stdout, parse_constant=lambda word: pytest.fail(f"{word} in the JSON"))
    assert figures["deepest"] is None
    assert "0 violations" in done.stderr


def test_a_broken_promise_is_1(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(keep_out, "attack", lambda seed: keep_out.Tally(seconds=10.0, violations=1, deepest=1e-3))
    assert main(["keep-out", "--seconds", "1", "--json", str(tmp_path / "figures.json")]) == 1
    assert json.loads((tmp_path / "figures.json").read_text())["violations"] == 1


def test_an_error_is_one_line_and_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def fail(*_: object, **__: object) -> None:
        raise GraphError("the bridge cannot be armed")

    monkeypatch.setattr(bridge, "measure_bridge", fail)
    assert main(["bridge"]) == 1
    assert capsys.readouterr().err == "error: the bridge cannot be armed\n"
