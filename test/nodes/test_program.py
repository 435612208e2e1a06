"""Every node as its program: it starts, ends in order at any time, and says in one line what it cannot start with."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.processes import graph_environment, reserved_domain
from magnetosuture_thread.nodes.program import MAKERS
from test.nodes.programs import TIMEOUT

ROOT = Path(__file__).parent.parent.parent
PROGRAMS = (*MAKERS, "console")
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
SETUP = """
/**: {{ros__parameters: {{scene: dish_35mm}}}}
/**/vision_tracker: {{ros__parameters: {{thread_length: {tracker}}}}}
/**/thread_model: {{ros__parameters: {{thread_length: {model}, segments: 12}}}}
"""


@pytest.mark.parametrize("name", ["coil_bridge"])
def test_two_interruptions_at_any_time_end_a_node_in_order(name: str, environment: dict[str, str]):
    """As a terminal's Ctrl-C, which comes from launch too: amid imports, the making of a node, or its work."""
    moments = random.Random(name)
    command = [sys.executable, "-c", SCRIPT, name, "--ros-args", "-p", "scene:=dish_35mm"]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "begins\n"
            time.sleep(moments.uniform(0.0, 4.0))
            process.send_signal(signal.SIGINT)
            time.sleep(moments.uniform(0.0, 0.5))
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=TIMEOUT)
        finally:
            process.kill()
    assert process.returncode == 0, output
    assert "Traceback" not in output


@pytest.mark.parametrize(
    ("name", "which"),
    [*((name, signal.SIGINT) for name in PROGRAMS), ("perception", signal.SIGTERM)],
)
def test_a_node_reports_and_ends_when_it_is_asked_to(graph, programs, name: str, which: signal.Signals):
    reports = graph.listen_later(topics.DIAGNOSTICS)
    given = ["-p", "port:=0"] if name == "console" else []
    environment = graph_environment(graph.domain)
    process = programs.start(name, "-r", "__ns:=/lab1", "-p", "scene:=dish_35mm", *given, environment=environment)
    nodes = ("vision_tracker", "thread_model") if name == "perception" else (name,)

    def heard(node: str) -> bool:
        assert process.poll() is None, process.output
        return any(report.status[0].name == f"lab1/{node}: state" for report in reports)

    graph.wait(lambda: all(map(heard, nodes)), "its reports", TIMEOUT)
    process.send_signal(which)
    process.send_signal(which)
    assert process.wait() == 0, process.output
    assert "Traceback" not in process.output


def test_a_node_that_compiles_ends_in_order(programs, environment: dict[str, str], tmp_path: Path):
    command = [sys.executable, "-m", "magnetosuture_thread.nodes.program", "coil_bridge"]
    without_cache = {**environment, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    with subprocess.Popen(
        command, env=without_cache, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            assert process.stdout is not None
            output = ""
            while "compiling" not in output:
                line = process.stdout.readline()
                assert line, output
                output += line
            process.send_signal(signal.SIGTERM)
            output += process.communicate(timeout=TIMEOUT)[0]
        finally:
            process.kill()
    assert process.returncode == 0, output
    assert "Traceback" not in output


LAB1 = ("-r", "__ns:=/lab1")
REFUSED: list[tuple[str, str | None, tuple[str, ...], str]] = [  # program, parameter file, arguments, words
    ("thread_model", "thread_model: {ros__parameters: {segmens: 20}}", (), "thread_model.segmens: got 20"),
    ("coil_bridge", "coil_bridge: {ros__parameters: {rate: 50.0}}", LAB1, "got '/coil_bridge', expected one for"),
    ("path_follower", None, LAB1, "parameter file: got 'No such file or directory', expected a readable YAML file"),
    ("perception", SETUP.format(tracker=0.018, model=18.0), (), "thread_model.thread_length: got 18.0, expected a"),
    ("perception", SETUP.format(tracker=0.018, model=0.018), ("-r", "__node:=both"), "cannot both be named both"),
    ("scene_server", "/**: {ros__parameters: {scene: nowhere}}", (), "scene: got 'nowhere', expected a YAML"),
    ("console", "/**: {ros__parameters: {address: 0.0.0.0}}", (), "a token, as 0.0.0.0 can be reached"),
]


@pytest.mark.parametrize(("name", "text", "arguments", "words"), REFUSED)
def test_what_a_node_cannot_start_with_is_said_in_one_line(
    programs, environment, tmp_path: Path, name: str, text: str | None, arguments: tuple[str, ...], words: str
):
    path = tmp_path / "setup.yaml"
    if text is not None:
        path.write_text(text)
    process = programs.start(name, "--params-file", str(path), *arguments, environment=environment)
    assert process.wait() == 1
    assert len(process.errors) == 1, process.output
    assert words in process.errors[0]
    assert "Traceback" not in process.output


@pytest.mark.parametrize(("variable", "value"), [("ROS_LOG_DIR", "/dev/null/logs"), ("ROS_DOMAIN_ID", "two")])
@pytest.mark.parametrize("program", ["nodes.program scene_server", "cli coils state"])
def test_an_environment_in_which_ros_cannot_start_is_named_in_one_line(
    environment, program: str, variable: str, value: str
):
    command = [sys.executable, "-m", *f"magnetosuture_thread.{program}".split()]
    changed = {**environment, variable: value}
    done = subprocess.run(command, env=changed, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1, done.stderr
    assert variable in done.stderr


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_nodes_end_when_their_parent_is_killed(tmp_path: Path, environment: dict[str, str]):
    program = f"""
import os, time
from pathlib import Path
from magnetosuture_thread.nodes.processes import NodeProcesses
with NodeProcesses(["coil_bridge"], [], dict(os.environ), Path({str(tmp_path)!r})) as nodes:
    print(next(iter(nodes._processes.values())).pid, flush=True)
    time.sleep(60)
"""
    parent = subprocess.Popen([sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = Path(f"/proc/{parent.stdout.readline().strip()}")
    until(lambda: "driver" in (tmp_path / "coil_bridge.log").read_text())
    assert child.exists()
    parent.kill()
    parent.wait()
    parent.stdout.close()
    until(lambda: not child.exists())


def test_a_domain_is_given_once_and_not_where_somebody_is():
    with reserved_domain() as first, reserved_domain() as second:
        assert first != second
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as somebody:
            somebody.bind(("127.0.0.1", 7400 + 250 * (second % 100 + 1) + 10 + 2 * 119))
            with reserved_domain() as third:
                assert third not in (first, second, second % 100 + 1)


def test_nothing_leads_the_graph_out_of_this_machine(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_STATIC_PEERS", "192.0.2.1")
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "192.0.2.1:11811")
    environment = graph_environment(7)
    assert "ROS_STATIC_PEERS" not in environment
    assert "ROS_DISCOVERY_SERVER" not in environment
    assert environment["ROS_DOMAIN_ID"] == "7"
    assert environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"


def test_a_process_gets_its_priority_as_far_as_permitted_and_its_workers_are_ordinary():
    code = """
import os
from concurrent.futures import ThreadPoolExecutor
from magnetosuture_thread.nodes.processes import leave_priority, raise_priority, without_priority
said = raise_priority(5)
assert said == {os.SCHED_FIFO: "real time, priority 5"}.get(os.sched_getscheduler(0), said), said
assert os.sched_getscheduler(0) == os.SCHED_FIFO or "priority 5 refused" in said, said
with ThreadPoolExecutor(1, initializer=leave_priority) as workers:
    assert workers.submit(os.sched_getscheduler, 0).result() == os.SCHED_OTHER
before = os.sched_getscheduler(0)
with without_priority():
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
assert os.sched_getscheduler(0) == before
assert raise_priority(0) == "ordinary"
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
