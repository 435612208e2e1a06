"""What the reference says of topics and services is what the nodes have."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from rclpy.node import Node

from magnetosuture_thread import interface
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.rig_simulator import RigSimulatorNode
from magnetosuture_thread.nodes.scene_server import SceneServerNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from test.nodes.conftest import Graph

SCENE = {"scene": "dish_35mm_post"}
MAKERS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "vision_tracker": (VisionTrackerNode, SCENE),
    "thread_model": (ThreadModelNode, {**SCENE, "forecast_horizon": 1.0}),
    "coil_bridge": (CoilBridgeNode, {**SCENE, "driver": "simulated"}),
    "scene_server": (SceneServerNode, SCENE),
    "needle_planner": (NeedlePlannerNode, SCENE),
    "rig_simulator": (RigSimulatorNode, SCENE),
    "path_follower": (PathFollowerNode, {**SCENE, "waypoints": [0.0, 0.0, 0.005, 0.0]}),
}
CHANNELS = {name: value for name, value in vars(interface).items() if isinstance(value, interface.Channel)}


def reference() -> ModuleType:
    """Return the module that writes the reference."""
    path = Path(__file__).parents[2] / "docs" / "generated_reference.py"
    spec = importlib.util.spec_from_file_location("generated_reference", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def channels_of(names: set[str]) -> set[str]:
    """Return the names in `interface` of topics by their names in the graph."""
    return {key for key, channel in CHANNELS.items() if channel.recorded in names}


def served(node: Node) -> dict[str, str]:
    """Return the type of each of our services that a node offers."""
    own = {service.srv_name.lstrip("/"): service.srv_type for service in node.services}
    return {
        name: f"{kind.__module__.split('.')[0]}/srv/{kind.__name__}"
        for name, kind in own.items()
        if name in interface.SERVICES
    }


@pytest.mark.parametrize("name", MAKERS)
def test_topics_and_services_of_a_node_are_those_of_the_reference(graph: Graph, name: str):
    make, parameters = MAKERS[name]
    node = graph.add(make, **parameters)
    published, received = reference().traffic_of(name)
    assert channels_of({each.topic_name for each in node.publishers}) <= published
    assert channels_of({each.topic_name for each in node.subscriptions}) - {"CLOCK"} <= received
    described = {key: each.type_name for key, each in interface.SERVICES.items() if each.node == name}
    assert served(node) == described


def test_every_topic_has_an_end_in_the_graph():
    traffic = [reference().traffic_of(name) for name in (*MAKERS, "console")]
    used = {name for published, received in traffic for name in published | received}
    assert used == set(CHANNELS)
