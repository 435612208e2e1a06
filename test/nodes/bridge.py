"""What the tests of the coil bridge say to it, and ask it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from magnetosuture_msgs.msg import SafetyMargins
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.settings.interface import Service
from test.nodes import wire

EAST = np.array([1.0, 0.0])
TAIL = np.array([-0.0035, 0.0])
SCENE = "dish_35mm"
LONG = {"command_timeout": 1.0, "pose_timeout": 1.0}  # one command and one pose last through a test
READY = {"scene": SCENE, "prediction_timeout": 5.0}  # and so do the thread's margins


def armed(graph, **parameters: Any) -> Any:
    """Return a bridge that passes commands."""
    node = graph.add(CoilBridgeNode, autostart="armed", **{**READY, **parameters})
    graph.wait(lambda: node.system.latch.armed, "the bridge to be armed")
    predict(graph)
    return node


def predict(graph, slowdown: float = 1.0, version: str | None = None) -> None:
    """Publish the thread's margins, of the bridge's scene unless another version is named."""
    version = read_scene(SCENE).version if version is None else version
    margins = SafetyMargins(header=wire.header(graph.now()), valid=True, slowdown=slowdown, scene_version=version)
    graph.publish(topics.MARGINS, margins)


def command(graph, x: float = 0.01, y: float = 0.0) -> TwistStamped:
    """Return a velocity command made now."""
    return wire.twist_message(graph.now(), np.array([x, y]))


def drive(graph, x: float = 0.005, y: float = 0.0) -> TwistStamped:
    """Say where needle and thread are, then command a velocity; return that command."""
    predict(graph)
    graph.publish(topics.NEEDLE_POSE, wire.pose_message(graph.now(), TAIL, EAST))
    asked = command(graph, x, y)
    graph.publish(topics.NEEDLE_COMMAND, asked)
    return asked


def drive_until(graph, condition: Callable[[], Any], what: str) -> None:
    """Drive again and again until a condition holds: on a busy machine one pose or command may come too late."""

    def holds() -> bool:
        drive(graph)
        return bool(condition())

    graph.wait(holds, what)


def press(graph, name: str) -> Any:
    """Call emergency stop or reset."""
    return graph.call(Trigger, name)


def arm(graph, on: bool = True) -> Any:
    """Arm or disarm."""
    return graph.call(SetBool, Service.ARM, data=on)


def change(graph, transition: int) -> bool:
    """Ask for a transition of the bridge's lifecycle."""
    return bool(graph.change("coil_bridge", transition))


def stage(graph) -> str:
    """Return the state of the bridge's lifecycle."""
    return str(graph.stage("coil_bridge"))


def applied(node) -> list[np.ndarray]:
    """Return what the recording driver was told."""
    return list(node.system.driver.applied)


def driven(node) -> bool:
    """Return whether any current was on."""
    return any(currents.any() for currents in applied(node))


def reasons(states) -> str:
    """Return why the coils are at zero, by the last state."""
    return "; ".join(states[-1].reasons) if states else ""
