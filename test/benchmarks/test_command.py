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
from magnetosuture_thread.errors import GraphError

ROOT = Path(__file__).parents[2]
FIGURES = {
    *("seconds", "steps", "episodes", "driven", "pressed", "stalls", "faults", "violations"),
    *("deepest", "worst", "cpu_seconds"),
}


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["dance"],
        ["solver", "--json", "."],
        ["solver", "--json"],
        ["solver", "--peers", "all"],
        ["bridge", "--kills", "-1"],
        ["attack"],
        ["attack", "moon"],
        ["attack", "bags", "--count", "0"],
        ["vision", "--count", "0"],
        ["page", "--json", "/no/such/folder/x.json"],
    ],
)
def test_wrong_use_is_2(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert capsys.readouterr().err


def test_figures_go_to_a_file_and_the_words_to_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "figures.json"
    assert main(["keep-out", "--seconds", "1", "--json", str(file)]) == 0
    assert "0 violations" in capsys.readouterr().out
    assert set(json.loads(file.read_text())) == FIGURES


def test_figures_go_to_standard_output_alone():
    command = [sys.executable, "-m", "benchmarks", "keep-out", "--seconds", "0", "--json", "-"]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=True, cwd=Path(__file__).parents[2]
    )
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
