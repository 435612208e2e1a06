"""Every node as its program: a terminal's Ctrl-C reaches it twice, at any time, and it ends in order."""

from __future__ import annotations

import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from magnetosuture_thread.nodes.processes import graph_environment, reserved_domain

ROOT = Path(__file__).parent.parent.parent
PROGRAMS = re.findall(
    r'^(\w+) = "magnetosuture_thread\.nodes\.program:main"$', (ROOT / "pyproject.toml").read_text(), re.M
)
# As an installed script does. It says when it loads: while Python itself starts, nobody can catch a signal.
SCRIPT = """
import sys
from magnetosuture_thread.nodes import program
sys.argv[0] = sys.argv.pop(1)
begin = program.import_module
def reported(name):
    print("begins", flush=True)
    return begin(name)
program.import_module = reported
sys.exit(program.main())
"""
WITHIN = 4.0  # s after the beginning: amid imports, the making of a node, or its work
TIMEOUT = 90.0  # s
# A compiler that lets no handler of Python run for hours; it says so once it is at work.


@pytest.fixture
def environment(tmp_path: Path) -> Iterator[dict[str, str]]:
    """An environment on a domain of its own."""
    with reserved_domain() as domain:
        yield {**graph_environment(domain), "XDG_STATE_HOME": str(tmp_path)}


@pytest.mark.parametrize("name", PROGRAMS)
def test_two_interruptions_at_any_time_end_a_node_in_order(name: str, environment: dict[str, str]):
    moments = random.Random(name)
    for _ in range(2):
        command = [sys.executable, "-c", SCRIPT, name, "--ros-args", "-p", "scene:=dish_35mm"]
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "begins\n"
            time.sleep(moments.uniform(0.0, WITHIN))
            process.send_signal(signal.SIGINT)
            time.sleep(moments.uniform(0.0, 0.5))
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=TIMEOUT)
        finally:
            process.kill()
        assert process.returncode == 0, output
        assert "Traceback" not in output


def ended(command: list[str], environment: dict[str, str], word: str, which: signal.Signals) -> tuple[int, str]:
    """Start a node, send it a signal as soon as it logs a word, and return its exit code and what it logged."""
    arguments = ["--ros-args", "-p", "scene:=dish_35mm"]
    process = subprocess.Popen(
        [sys.executable, *command, *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert process.stdout is not None
        before = ""
        while word not in before:
            line = process.stdout.readline()
            assert line, before
            before += line
        process.send_signal(which)
        output, _ = process.communicate(timeout=TIMEOUT)
    finally:
        process.kill()
    return process.returncode, before + output


@pytest.mark.parametrize("name", ["vision_tracker", "coil_bridge"])
@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_a_node_that_compiles_ends_in_order(name: str, which: signal.Signals, environment, tmp_path: Path):
    without_cache = {**environment, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    code, output = ended(["-m", f"magnetosuture_thread.nodes.{name}"], without_cache, "compiling", which)
    assert code == 0, output
    assert "Traceback" not in output
    assert "ready" not in output


@pytest.mark.parametrize("name", PROGRAMS)
def test_without_ros_a_node_ends_with_one_line_that_names_it(name: str):
    without = "import sys; sys.modules['rclpy'] = None; sys.argv[0] = sys.argv[1]; " + (
        "from magnetosuture_thread.nodes.program import main; sys.exit(main())"
    )
    run = subprocess.run(
        [sys.executable, "-c", without, name], capture_output=True, text=True, timeout=TIMEOUT, check=False
    )
    assert run.returncode == 1
    assert re.fullmatch(r"error: .*rclpy.*; nodes and the live graph need ROS 2 Jazzy: .*\n", run.stderr)
