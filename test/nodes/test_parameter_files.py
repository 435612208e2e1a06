"""Parameter files of nodes in namespaces and under other names: what is meant for a node applies, or is refused."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import parameter_value_to_python

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.nodes import parameter_files
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.processes import environment_of, graph_environment, reserved_domain
from magnetosuture_thread.resources import find_setup_file

COMMON = "/**: {ros__parameters: {needle_length: 0.006, thread_length: 0.05}}\n"
OWN = "/**/path_follower: {ros__parameters: {speed: 0.004}}\n"
LAB1, LEFT = ("-r", "__ns:=/lab1"), ("-r", "__node:=left_follower")


@pytest.fixture
def domain() -> Iterator[int]:
    """Keep the nodes on this machine, in a domain of their own."""
    with reserved_domain() as reserved, environment_of(graph_environment(reserved)):
        yield reserved


@pytest.fixture
def followed(tmp_path: Path, domain: int):
    """Makes a follower of the texts of files and of arguments; returns its name, speed and needle length."""

    def make(
        texts: Sequence[str], arguments: Sequence[str] = (), own: Sequence[str] = (), namespace: str = ""
    ) -> tuple[str, float, float]:
        files = [tmp_path / f"{index}.yaml" for index in range(len(texts))]
        for file, text in zip(files, texts, strict=True):
            file.write_text(text)
        given = [part for file in files for part in ("--params-file", str(file))]
        context, node = Context(), None
        try:
            parameter_files.init(["program", "--ros-args", *given, *arguments], context)
            cli_args = ["--ros-args", *own] if own else None
            node = PathFollowerNode(context=context, cli_args=cli_args, namespace=namespace)
            speed, length = (float(node.get_parameter(name).value) for name in ("speed", "needle_length"))
            return node.get_fully_qualified_name(), speed, length
        finally:
            if node is not None:
                node.destroy_node()
            context.try_shutdown()

    return make


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((), "/path_follower"),
        (LAB1, "/lab1/path_follower"),
        (LEFT, "/left_follower"),
        ((*LAB1, *LEFT), "/lab1/left_follower"),
        (("-r", "path_follower:__node:=left_follower", "--remap", "__ns:=/a/b"), "/a/b/left_follower"),
        (("-r", "other:__node:=left_follower"), "/path_follower"),
    ],
)
def test_a_setup_applies_in_any_namespace_and_under_any_name(followed, arguments: tuple[str, ...], name: str):
    assert followed([COMMON + OWN], arguments) == (name, 0.004, 0.006)
    assert followed([COMMON, OWN], arguments) == (name, 0.004, 0.006)


@pytest.mark.parametrize(
    ("text", "speed"),
    [
        ("path_follower: {ros__parameters: {speed: 0.002}}", 0.002),
        ("left_follower: {ros__parameters: {speed: 0.002}}", 0.002),
        ("/**/left_follower: {ros__parameters: {speed: 0.002}}", 0.002),
        (OWN + "/left_follower: {ros__parameters: {speed: 0.002}}", 0.002),
        ("/left_follower: {ros__parameters: {speed: 0.002}}\n" + OWN, 0.004),
        ("/right_follower: {ros__parameters: {speed: 0.001}}\n/**: {ros__parameters: {speed: 0.002}}", 0.002),
    ],
)
def test_a_renamed_node_takes_the_section_of_its_kind_and_that_of_its_name(followed, text: str, speed: float):
    assert followed([text], LEFT)[1] == speed


@pytest.mark.parametrize(
    ("texts", "arguments", "speed"),
    [
        # rcl merges all by key, and would take 0.004 in the first four.
        ([COMMON + OWN], ("-p", "speed:=0.003"), 0.003),
        ([COMMON + OWN, "/**: {ros__parameters: {speed: 0.003}}"], (), 0.003),
        ([COMMON + OWN], (*LAB1, "-p", "path_follower:speed:=0.003"), 0.003),
        ([COMMON + OWN], (*LAB1, *LEFT, "--param", "left_follower:speed:=0.003"), 0.003),
        ([COMMON + OWN], ("-p", "other:speed:=0.003"), 0.004),
        ([OWN, OWN.replace("0.004", "0.002")], (), 0.002),
        ([OWN + OWN.replace("**", "*").replace("0.004", "0.002")], LAB1, 0.002),
    ],
)
def test_what_comes_later_counts(followed, texts: list[str], arguments: tuple[str, ...], speed: float):
    assert followed(texts, arguments)[1] == speed


@pytest.mark.parametrize(
    ("text", "arguments", "words"),
    [
        ("path_follower: {ros__parameters: {speed: 0.002}}", LAB1, "got 'path_follower', expected one for /lab1/path_"),
        ("coil_bridge: {ros__parameters: {rate: 50.0}}", (), "got 'coil_bridge', expected one for /path_follower: "),
        ("/**/console: {ros__parameters: {rate: 50.0}}", LEFT, "or /left_follower or /**"),
        # The rest would be defaults, which is as bad as nothing that applies.
        (COMMON + "path_follower: {ros__parameters: {speed: 0.002}}", LAB1, "got '/**, path_follower', expected one"),
        (COMMON + "/lab2/path_follower: {ros__parameters: {speed: 0.002}}", LAB1, "got '/**, /lab2/path_follower'"),
        ("", (), "parameter file: got None, expected sections by node"),
        ("hello", (), "parameter file: got 'content of type str', expected sections by node"),
        ("[1, 2", (), "expected valid YAML"),
        ("/**: {ros__parameters: {speed: 0.1, speed: 0.2}}", (), "speed is given twice"),
        ("/**: {speed: 0.1}", (), "one key, ros__parameters"),
    ],
)
def test_a_file_of_which_nothing_applies_or_that_is_none_is_refused(
    followed, tmp_path: Path, text: str, arguments: tuple[str, ...], words: str
):
    with pytest.raises(ConfigurationError) as caught:
        followed([text], arguments)
    assert str(caught.value).startswith(str(tmp_path / "0.yaml"))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_sections_of_others_do_not_matter(followed):
    text = "/lab1/camera: {ros__parameters: {exposure: 3}}\n/**/coil_bridge: {ros__parameters: {rate: 50.0}}\n"
    assert followed([OWN + text], LAB1)[1] == 0.004


# As processes, as launch starts them.


def started(node: str, *arguments: str) -> subprocess.Popen[str]:
    """Start a node."""
    command = [sys.executable, "-m", f"magnetosuture_thread.nodes.{node}", "--ros-args", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def parameters_of(node: str, names: Sequence[str], process: subprocess.Popen[str]) -> dict[str, object]:
    """Ask a node for its parameters, once it answers."""
    context = Context()
    rclpy.init(context=context, args=[])
    asker = rclpy.create_node("asker", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(asker)
    try:
        client = asker.create_client(GetParameters, f"{node}/get_parameters")
        deadline = time.monotonic() + 120.0
        while not client.wait_for_service(0.2):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
        answer = None
        while answer is None:  # the node may have found the request's reader before that of the answer
            assert time.monotonic() < deadline
            future = client.call_async(GetParameters.Request(names=list(names)))
            executor.spin_until_future_complete(future, 5.0)
            answer = future.result()
        return dict(zip(names, map(parameter_value_to_python, answer.values), strict=True))
    finally:
        executor.shutdown()
        asker.destroy_node()
        context.try_shutdown()


@pytest.mark.parametrize("name", ["coil_bridge", "left_bridge"])
def test_a_bridge_that_is_pushed_into_a_namespace_has_its_setup(domain: int, name: str, tmp_path: Path):
    """Found from outside: it was active with no obstacles, another dish and another needle, without a warning."""
    extra = tmp_path / "launch.yaml"  # what launch writes of parameters that it is given itself
    extra.write_text("/**: {ros__parameters: {use_sim_time: false, max_speed: 0.011}}")
    files = ("--params-file", str(find_setup_file("hernia_ring")), "--params-file", str(extra))
    process = started("coil_bridge", "-r", f"__node:={name}", "-r", "__ns:=/lab1", *files)
    expected = {
        "scene": "hernia_ring",
        "needle_length": 0.0025,
        "keep_out": 0.00025,
        "needle_moment": 2.405e-4,
        "max_speed": 0.011,
        "driver": "recording",
    }
    try:
        assert parameters_of(f"/lab1/{name}", list(expected), process) == expected
    finally:
        process.terminate()
        process.communicate(timeout=20)


@pytest.mark.parametrize(
    ("node", "text", "words"),
    [
        ("coil_bridge", "coil_bridge: {ros__parameters: {max_speed: 0.01}}", "got 'coil_bridge', expected one for"),
        ("thread_model", "/thread_model: {ros__parameters: {segments: 20}}", "got 'thread_model', expected one for"),
        ("console", "console: {ros__parameters: {port: 0}}", "expected one for /lab1/console: "),
        ("rig_simulator", "/**/thread_model: {ros__parameters: {segments: 20}}", "got '/**/thread_model', expected"),
        ("vision_tracker", "", "parameter file: got None, expected sections by node"),
        ("path_follower", None, "parameter file: got 'No such file or directory', expected a readable YAML file"),
    ],
)
def test_a_node_of_whose_file_nothing_applies_does_not_start(
    domain: int, node: str, text: str | None, words: str, tmp_path: Path
):
    file = tmp_path / "old.yaml"
    if text is not None:
        file.write_text(text)
    process = started(node, "-r", "__ns:=/lab1", "--params-file", str(file))
    _, said = process.communicate(timeout=300)
    assert process.returncode == 1
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, said
    assert errors[0].startswith(f"error: {file}: ")
    assert words in errors[0]
    assert "Traceback" not in said
