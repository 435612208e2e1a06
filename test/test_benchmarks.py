"""Every benchmark that the pages name is run once, by its command; with small arguments those that take long."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.__main__ import BENCHMARKS, main
from benchmarks.page import BROWSERS
from test.shared import ROOT

DOCUMENTED = re.compile(r"python -m benchmarks ([\w-]+)")
SMALL = {
    "solver": "",
    "contact": "--motions 2 --segments 40",
    "forecast": "--repeats 2 --loops",
    "vision": "--count 1 --classes usual",
    "keep-out": "--seconds 20",
    "lies": "--seeds 1 --setup petri_35mm_polyamide --lie frozen",
    "estimator": "--count 1 --cases 'right, free'",
    "frame": "",
    "golden": "record DIR --only forecast",
    "attack": "bags --count 20",
}
GRAPHS = {
    "attack": "nodes --count 200",
    "bridge": "--trials 2 --kills 1 --hostile 50",
    "page": "--presses 4",
    "network": "--cuts 1 --impaired-cuts 1",
}
IS_ROOT = os.geteuid() == 0 and Path("/dev/net/tun").exists() and shutil.which("ip") is not None
TIMEOUT = 900.0  # s; the first run on a machine compiles


def run(name: str, arguments: str, folder: Path) -> None:
    """Run a benchmark; check that it passes and writes figures."""
    figures = folder / "figures.json"
    words = shlex.split(arguments.replace("DIR", str(folder / "made")))
    command = [sys.executable, "-m", "benchmarks", name, "--json", str(figures), *words]
    subprocess.run(command, timeout=TIMEOUT, check=True, cwd=ROOT)
    assert isinstance(json.loads(figures.read_text()), dict)


def test_the_pages_name_every_benchmark_and_no_other():
    pages = [ROOT / "docs/results.md", *sorted((ROOT / "docs/how_to").glob("*.md"))]
    named = {name for page in pages for name in DOCUMENTED.findall(page.read_text(encoding="utf-8"))}
    assert named == set(BENCHMARKS) == {*SMALL, *GRAPHS}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_benchmark_runs_as_its_page_says(name: str, tmp_path: Path):
    run(name, SMALL[name], tmp_path)


@pytest.mark.slow
@pytest.mark.whole_graph
@pytest.mark.parametrize("name", GRAPHS)
def test_a_benchmark_of_a_graph_runs_as_its_page_says(name: str, tmp_path: Path):
    if name == "page" and not any(map(shutil.which, BROWSERS)):
        pytest.skip("no chromium")
    if name == "network" and not IS_ROOT:
        pytest.skip("needs root and /dev/net/tun")
    run(name, GRAPHS[name], tmp_path)


def test_wrong_use_is_2_and_figures_go_to_standard_output_alone(capsys: pytest.CaptureFixture[str]):
    for wrong in ("dance", "solver --json .", "bridge --kills -1", "attack moon", "vision --count 0"):
        with pytest.raises(SystemExit) as ended:
            main(wrong.split())
        assert ended.value.code == 2
    capsys.readouterr()
    assert main(["keep-out", "--seconds", "0", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["deepest"] is None
