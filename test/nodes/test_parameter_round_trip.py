"""What `ros2 param dump` writes of a node, it takes back: by `ros2 param load`, and as the file it starts with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.settings.files import find_file

READ_ONLY = "Trying to set a read-only parameter"  # parameters of rclpy


def started(graph: Any, kind: Any, file: Path) -> Any:
    """Return a node that starts with a parameter file."""
    return graph.add(lambda context, **_: kind(context=context, cli_args=["--ros-args", "--params-file", str(file)]))


def dumped(graph: Any, client: AsyncParameterClient, name: str) -> dict[str, Any]:
    """Return what `ros2 param dump` writes: parameters by the parts of their names."""

    def answer(future: Any) -> Any:
        graph.wait(future.done, "an answer of a parameter service")
        return future.result()

    names = sorted(answer(client.list_parameters()).result.names)
    values = answer(client.get_parameters(names)).values
    nested: dict[str, Any] = {}
    for path, value in zip(names, map(parameter_value_to_python, values), strict=True):
        *folders, last = path.split(".")
        inner = nested
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[last] = list(value) if hasattr(value, "typecode") else value
    return {name: {"ros__parameters": nested}}


@pytest.mark.parametrize("kind", [CoilBridgeNode, ThreadModelNode], ids=lambda kind: kind.__name__)
def test_parameters_that_are_dumped_are_loaded_again_and_started_with(graph, kind: Any, tmp_path: Path):
    node = started(graph, kind, find_file("setup", "hernia_ring"))
    name, file = node.get_fully_qualified_name(), tmp_path / "dumped.yaml"
    client = AsyncParameterClient(graph.probe, name)
    graph.wait(client.services_are_ready, "the parameter services")
    values = dumped(graph, client, name)
    file.write_text(yaml.safe_dump(values))
    loaded = client.load_parameter_file(str(file))
    graph.wait(loaded.done, "an answer")
    refused = [result.reason for result in loaded.result().results if not result.successful]
    assert [reason for reason in refused if not reason.startswith(READ_ONLY)] == []
    assert dumped(graph, client, name) == values
    graph.remove(node)
    again = started(graph, kind, file)
    graph.wait(client.services_are_ready, "the parameter services")
    assert dumped(graph, client, again.get_fully_qualified_name()) == values
