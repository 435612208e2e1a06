"""What `ros2 param dump` writes of a node, it takes back: by `ros2 param load`, and as the file it starts with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.scene_server import SceneServerNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.resources import find_setup_file

READ_ONLY = "Trying to set a read-only parameter"  # parameters of rclpy
NODES = (CoilBridgeNode, NeedlePlannerNode, PathFollowerNode, SceneServerNode, ThreadModelNode, VisionTrackerNode)


@dataclass(frozen=True)
class Dump:
    """A node, who asks its parameter services, and what was dumped of it."""

    node: Any
    client: AsyncParameterClient
    file: Path
    values: dict[str, Any]


def name_of(kind: Any) -> str:
    """Return the name of a class."""
    return str(kind.__name__)


def started(graph: Any, kind: Any, file: Path) -> Any:
    """Return a node that starts with a parameter file."""
    return graph.add(lambda context, **_: kind(context=context, cli_args=["--ros-args", "--params-file", str(file)]))


def answer(graph: Any, future: Any) -> Any:
    """Return what a parameter service answers."""
    graph.wait(future.done, "an answer of a parameter service")
    return future.result()


def dumped(graph: Any, client: AsyncParameterClient, name: str) -> dict[str, Any]:
    """Return what `ros2 param dump` writes: parameters by the parts of their names."""
    names = sorted(answer(graph, client.list_parameters()).result.names)
    values = answer(graph, client.get_parameters(names)).values
    nested: dict[str, Any] = {}
    for path, value in zip(names, map(parameter_value_to_python, values), strict=True):
        *folders, last = path.split(".")
        inner = nested
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[last] = list(value) if hasattr(value, "typecode") else value
    return {name: {"ros__parameters": nested}}


@pytest.fixture
def dump(graph, kind: Any, tmp_path: Path) -> Dump:
    """What is dumped of a running node."""
    node = started(graph, kind, find_setup_file("hernia_ring"))
    name = node.get_fully_qualified_name()
    client = AsyncParameterClient(graph.probe, name)
    graph.wait(client.services_are_ready, "the parameter services")
    values = dumped(graph, client, name)
    (tmp_path / "dumped.yaml").write_text(yaml.safe_dump(values))
    return Dump(node, client, tmp_path / "dumped.yaml", values)


@pytest.mark.parametrize("kind", NODES, ids=name_of)
def test_parameters_that_are_dumped_are_loaded_again(graph, dump: Dump):
    results = answer(graph, dump.client.load_parameter_file(str(dump.file))).results
    assert len(results) == len(answer(graph, dump.client.list_parameters()).result.names)
    refused = [result.reason for result in results if not result.successful]
    assert [reason for reason in refused if not reason.startswith(READ_ONLY)] == []
    assert dumped(graph, dump.client, dump.node.get_fully_qualified_name()) == dump.values


@pytest.mark.parametrize("kind", NODES, ids=name_of)
def test_a_node_starts_with_the_parameters_that_were_dumped(graph, kind: Any, dump: Dump):
    graph.remove(dump.node)
    again = started(graph, kind, dump.file)
    graph.wait(dump.client.services_are_ready, "the parameter services")
    assert dumped(graph, dump.client, again.get_fully_qualified_name()) == dump.values
