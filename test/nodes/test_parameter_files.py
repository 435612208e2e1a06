"""Parameter files of nodes in namespaces and under other names: what is meant for a node applies, or is refused."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from rclpy.context import Context

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.nodes.parameters import init, settings_of
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.perception import perception
from magnetosuture_thread.nodes.processes import environment_of, graph_environment, reserved_domain
from magnetosuture_thread.settings.errors import ConfigurationError

COMMON = "/**: {ros__parameters: {needle_length: 0.006, thread_length: 0.05}}\n"
OWN = "/**/path_follower: {ros__parameters: {speed: 0.004}}\n"
LAB1, LEFT = ("-r", "__ns:=/lab1"), ("-r", "__node:=left_follower")


@pytest.fixture
def domain() -> Iterator[int]:
    """Keep the nodes on this machine, in a domain of their own."""
    with reserved_domain() as reserved, environment_of(graph_environment(reserved)):
        yield reserved


@contextmanager
def follower(files: Sequence[Path], arguments: Sequence[str]) -> Iterator[PathFollowerNode]:
    """Give a follower with parameter files and arguments."""
    context, given = Context(), [part for file in files for part in ("--params-file", str(file))]
    try:
        init(["program", "--ros-args", *given, *arguments], context)
        node = PathFollowerNode(context=context)
        yield node
        node.destroy_node()
    finally:
        context.try_shutdown()


@pytest.fixture
def followed(tmp_path: Path, domain: int):
    """Makes a follower of the texts of files and of arguments; returns its name, speed and needle length."""

    def make(texts: Sequence[str], arguments: Sequence[str] = ()) -> tuple[str, float, float]:
        files = [tmp_path / f"{index}.yaml" for index in range(len(texts))]
        for file, text in zip(files, texts, strict=True):
            file.write_text(text)
        with follower(files, arguments) as node:
            speed, length = (float(node.get_parameter(name).value) for name in ("speed", "needle_length"))
            return node.get_fully_qualified_name(), speed, length

    return make


@pytest.mark.parametrize(
    ("texts", "arguments", "name", "speed"),
    [
        # A setup applies in any namespace and under any name.
        ([COMMON + OWN], (), "/path_follower", 0.004),
        ([COMMON, OWN], (*LAB1, *LEFT), "/lab1/left_follower", 0.004),
        ([COMMON + OWN], ("-r", "path_follower:__node:=left", "--remap", "__ns:=/a/b"), "/a/b/left", 0.004),
        # A renamed node takes the section of its kind and that of its name.
        ([COMMON + OWN + "/left_follower: {ros__parameters: {speed: 0.002}}"], LEFT, "/left_follower", 0.002),
        ([COMMON + "/left_follower: {ros__parameters: {speed: 0.002}}\n" + OWN], LEFT, "/left_follower", 0.004),
        # What comes later counts; rcl merges all by key, and would take 0.004 in the first four.
        ([COMMON + OWN], ("-p", "speed:=0.003"), "/path_follower", 0.003),
        ([COMMON + OWN], (*LAB1, "-p", "path_follower:speed:=0.003"), "/lab1/path_follower", 0.003),
        ([COMMON + OWN], ("-p", "other:speed:=0.003"), "/path_follower", 0.004),
    ],
)
def test_what_files_and_command_line_give_a_node(
    followed, texts: list[str], arguments: tuple[str, ...], name: str, speed: float
):
    assert followed(texts, arguments) == (name, speed, 0.006)


@pytest.mark.parametrize(
    ("text", "arguments", "words"),
    [
        (
            "path_follower: {ros__parameters: {speed: 0.002}}",
            LAB1,
            "got '/path_follower', expected one for /lab1/path_",
        ),
        # The rest would be defaults, which is as bad as nothing that applies.
        (COMMON + "/lab2/path_follower: {ros__parameters: {speed: 0.002}}", LAB1, "got '/**, /lab2/path_follower'"),
        ("", (), "parameter file: got None, expected sections by node"),
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


def test_a_node_knows_the_settings_of_another_by_the_same_files(tmp_path: Path, domain: int):
    bridge = "/**/coil_bridge: {ros__parameters: {needle_moment: 5.0e-4}}\n"
    own = "/**/path_follower: {ros__parameters: {pose_timeout: 0.06}}\n"  # of a name that the bridge has too
    for text, moment in ((COMMON + bridge + own, 5e-4), (COMMON + own, CoilBridgeSettings().needle_moment)):
        file = tmp_path / "setup.yaml"
        file.write_text(text)
        with follower([file], LAB1) as node:
            found = settings_of(node, CoilBridgeSettings, {"context": node.context})
            assert (found.needle_length, found.needle_moment) == (0.006, moment)
            assert found.pose_timeout == CoilBridgeSettings().pose_timeout


def test_a_model_in_one_process_with_the_tracker_hears_the_topic_that_it_is_remapped_to(domain: int):
    context, remap = Context(), "thread_model:needle/measured_cp:=other/measured_cp"
    init(["program"], context)
    nodes = perception(context=context, cli_args=["--ros-args", "-r", remap, "-p", "scene:=dish_35mm"])
    heard = {entry.topic_name for entry in nodes[1].subscriptions}
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()
    assert {"/other/measured_cp", "/thread/observation"} <= heard
