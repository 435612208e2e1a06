"""Every code block of README and tutorials runs, in a folder of its own, in the order in which a reader meets it.

So does each command `magnetosuture` that how-to pages and results show, of those that end by themselves.

A comment before a block says what is special about it:

    <!-- file: NAME -->                     it is saved under that name
    <!-- runs: with the whole graph -->     it runs where nothing else does
    <!-- runs: until TEXT -->               the same, and is interrupted once it has printed that
    <!-- runs: not, REASON -->              it is left out
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from test.commands.test_calibrate_coils import probe
from test.shared import ROOT
from test.test_documentation import README, shell_lines

pytestmark = pytest.mark.slow

PAGES = [README, *sorted((ROOT / "docs/tutorials").glob("*.md"))]
BLOCK = re.compile(r"^(?:<!-- (file|runs): ([^\n]*) -->\n)?```(bash|python|yaml)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
TIMEOUT = 300.0  # s
GRAPH = "with the whole graph"


class Block(NamedTuple):
    """A block of code: a file to save under a name, or what is run and how."""

    file: str
    runs: str
    language: str
    text: str

    @property
    def on_the_graph(self) -> bool:
        """Return whether it starts the nodes in processes of their own."""
        return self.runs == GRAPH or self.runs.startswith("until ")


def blocks_of(page: Path) -> list[Block]:
    """Return the blocks of a page."""
    found = BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(m[2] if m[1] == "file" else "", m[2] if m[1] == "runs" else "", m[3], m[4]) for m in found]


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Return a folder that has the examples and setups as the clone has."""
    for name in ("config", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def run(block: Block, folder: Path) -> None:
    """Save a block, or run it."""
    if block.file:
        (folder / block.file).write_text(block.text, encoding="utf-8")
        return
    shell = ["bash", "-euo", "pipefail", "-c"]
    command = [*(shell if block.language == "bash" else [sys.executable, "-c"]), block.text]
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    if block.runs.startswith("until "):
        run_until(block.runs.removeprefix("until "), command, folder, environment)
        return
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def run_until(text: str, command: list[str], folder: Path, environment: dict[str, str]) -> None:
    """Run a command until it has printed a text, then press Ctrl-C; it has to end in order."""
    log = folder / "printed.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            deadline = time.monotonic() + TIMEOUT
            while text not in log.read_text() and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.1)
            assert text in log.read_text(), log.read_text()
            os.killpg(process.pid, signal.SIGINT)
            assert process.wait(TIMEOUT) == 0, log.read_text()
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_of_a_page_run_in_their_order(page: Path, clone: Path):
    for block in blocks_of(page):
        if not (block.on_the_graph or block.runs.startswith("not, ")):
            run(block, clone)


def check_example_bag(folder: Path) -> None:
    """Check that the example bag, replayed on the graph, was tracked in every frame."""
    summary = json.loads((folder / "output/live/summary.json").read_text())
    assert summary["frames"] == 240
    assert summary["tracked"] == summary["predicted"] == 238  # the first pose comes in the third frame
    assert summary["commands"] == 240
    assert summary["contact_frames"] > 100
    obstacle = next(margin for margin in summary["least_margins"] if margin["kind"] == "obstacle")
    assert obstacle["value"] > -1e-6
    assert obstacle["clearance"] > -25e-6  # the chord's dip between two nodes on the post
    assert summary["error_seen"]["maximum"] < 1.0


RESULTS = {"first_replay.md": check_example_bag}
ON_THE_GRAPH = [page for page in PAGES if any(block.on_the_graph for block in blocks_of(page))]


@pytest.mark.whole_graph
@pytest.mark.parametrize("page", ON_THE_GRAPH, ids=lambda page: page.name)
def test_blocks_on_the_graph_run(page: Path, clone: Path):
    for block in blocks_of(page):
        if block.file or block.on_the_graph:
            run(block, clone)
    if page.name in RESULTS:
        RESULTS[page.name](clone)


SHOWN = [ROOT / "docs/results.md", ROOT / "docs/reproduction.md", *sorted((ROOT / "docs/how_to").glob("*.md"))]
# Interactive, or on a robot, or after another command, or elsewhere: tested by other means.
VERBS = r"magnetosuture (coils|console|compile|commission-thread)"
NOT_HERE = re.compile(VERBS + r"|s3://|tcp://|BAG --output DIR$|--live|--bare|output/rig")
LIVE = re.compile(r"simulate|replay (?!.*--offline)|thread-behavior")
PLACES = {
    **dict.fromkeys(("BAG", "FRAMES_OR_BAG", "RUNS"), "examples/post_wrap"),
    **dict.fromkeys(("DIR", "NEW", "FOLDER_OR_VIDEO"), "made"),
    **dict.fromkeys(("PROCEDURE", "NAME"), "dead_end"),
    "D": "0.035",
}

NEEDLE_PX = {"--tail": ("505", "153"), "--tip": ("439", "97")}  # in the first frame of the example bag


def commands() -> list[str]:
    """Return the commands of the pages, each once."""
    lines = [line for page in SHOWN for line in shell_lines(page)]
    lines += [code for page in SHOWN for code in re.findall(r"`(magnetosuture [^`]* [^`]*)`", page.read_text())]
    lines = [
        line.partition("#")[0].strip().replace("BAG...", "BAG") for line in lines if line.startswith("magnetosuture ")
    ]
    return [line for line in dict.fromkeys(lines) if not NOT_HERE.search(line)]


@pytest.mark.parametrize(
    "line",
    [pytest.param(line, marks=[pytest.mark.whole_graph] * bool(LIVE.search(line))) for line in commands()],
)
def test_a_command_of_a_page_runs(line: str, clone: Path):
    words = [PLACES.get(word, word) for word in shlex.split(line)]
    if "FILE" in words:
        words[words.index("FILE")] = "made.json" if "--table" in words else "made.yaml"
    for end, place in NEEDLE_PX.items():
        if words[1] == "teach":
            words[words.index(end) + 1 : words.index(end) + 3] = place
    if "--seeds" in words:
        words[words.index("--seeds") + 1] = "1"
    post = {"type": "Point", "coordinates": [0.005, 0.0]}
    feature = {"type": "Feature", "geometry": post, "properties": {"name": "post", "radius": 0.002}}
    scene = {"type": "FeatureCollection", "dish": {"diameter": 0.035}, "features": [feature]}
    (clone / "lab.geojson").write_text(json.dumps(scene))
    probe(clone)
    run(Block("", "", "bash", shlex.join(words)), clone)
    assert "--output" not in words or (clone / words[words.index("--output") + 1]).exists()
