"""Every node of the package, by its name: its class and the parameters of a dish of 35 mm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.rig_simulator import RigSimulatorNode
from magnetosuture_thread.nodes.scene_server import SceneServerNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode

SCENE = {"scene": "dish_35mm"}
EVERY_NODE: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "scene_server": (SceneServerNode, SCENE),
    "vision_tracker": (VisionTrackerNode, SCENE),
    "thread_model": (ThreadModelNode, {**SCENE, "forecast_horizon": 1.0}),
    "coil_bridge": (CoilBridgeNode, {**SCENE, "driver": "simulated"}),
    "needle_planner": (NeedlePlannerNode, SCENE),
    "path_follower": (PathFollowerNode, {**SCENE, "waypoints": [0.01, 0.0]}),
    "rig_simulator": (RigSimulatorNode, SCENE),
}
