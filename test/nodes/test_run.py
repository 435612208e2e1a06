"""Nodes as programs: they start, end cleanly, and say in one line what they cannot start with."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import NODES
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    """An environment on a domain of its own."""
    with reserved_domain() as domain:
        yield graph_environment(domain)


def heard(name: str, environment: dict[str, str]) -> bool:
    """Wait until a node says on /diagnostics that it is there."""
    context = Context()
    with environment_of(environment):
        rclpy.init(context=context, domain_id=int(environment["ROS_DOMAIN_ID"]), args=[])
        listener = rclpy.create_node("listener", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(listener)
    names: list[str] = []
    topic = topics.DIAGNOSTICS
    listener.create_subscription(topic.message, topic.name, lambda m: names.append(m.status[0].name), topic.qos)
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and f"{name}: state" not in names:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    listener.destroy_node()
    context.try_shutdown()
    return f"{name}: state" in names


@pytest.mark.parametrize("name", NODES)
def test_a_node_runs_until_it_is_interrupted(name: str, tmp_path: Path, environment: dict[str, str]):
    command = [sys.executable, "-m", f"magnetosuture_thread.nodes.{name}"]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        assert heard(name, environment)
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0
    assert "Traceback" not in (tmp_path / "log").read_text()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("vision_tracker", "needle_width: 35.0", "vision_tracker.needle_width: got 35.0, expected a number from"),
        ("thread_model", "segmens: 20", "thread_model.segmens: got 20, expected one of"),
        ("coil_bridge", "command_timeout: 0.0", "coil_bridge.command_timeout: got 0.0, expected a number from 0.01"),
        ("coil_bridge", "command_timeout: [oops", "expected valid YAML"),
    ],
)
def test_a_bad_parameter_file_ends_the_node_with_one_line(
    tmp_path: Path, environment: dict[str, str], name: str, text: str, words: str
):
    path = tmp_path / "bad.yaml"
    path.write_text(f"{name}:\n  ros__parameters:\n    {text}\n")
    command = [sys.executable, "-m", f"magnetosuture_thread.nodes.{name}", "--ros-args", "--params-file", str(path)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=30, check=False)
    assert ended.returncode == 1
    errors = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert words in errors[0]
    assert "Traceback" not in ended.stderr


def test_a_node_that_ends_is_noticed_with_its_last_words(tmp_path: Path, environment: dict[str, str]):
    path = tmp_path / "bad.yaml"
    path.write_text("thread_model: {ros__parameters: {thread_length: 19.0}}\n")
    arguments = ["--params-file", str(path)]

    def watch(nodes: NodeProcesses) -> None:
        for _ in range(1500):
            nodes.check()
            time.sleep(0.02)

    with (
        NodeProcesses(["thread_model"], arguments, environment, tmp_path / "logs") as nodes,
        pytest.raises(GraphError, match=r"thread_model ended with exit code 1: error: thread_model\.thread_length"),
    ):
        watch(nodes)


def test_processes_are_ended_whatever_happens(tmp_path: Path, environment: dict[str, str]):
    nodes = NodeProcesses(NODES, [], environment, tmp_path / "logs")

    def interrupted() -> None:
        with nodes:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(GraphError, match="ended"):
        nodes.check()


@pytest.mark.parametrize("participant", [0, 20, 119])
def test_a_domain_is_given_once_and_not_where_somebody_is(participant: int):
    with reserved_domain() as first, reserved_domain() as second:
        assert first != second
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as somebody:
            somebody.bind(("127.0.0.1", 7400 + 250 * (second % 100 + 1) + 10 + 2 * participant))
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
    assert heard("coil_bridge", environment)
    assert child.exists()
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 10.0
    while child.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not child.exists()
