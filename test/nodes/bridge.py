"""What the tests of the coil bridge say to it, and ask it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from magnetosuture_msgs.msg import SafetyMargins
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.interface import ARM
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.scene import read_scene
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


def call(graph, kind: Any, name: str, request: Any) -> Any:
    """Call a service and return its answer."""
    client = graph.probe.create_client(kind, name)
    graph.wait(client.service_is_ready, f"the service {name}")
    future = client.call_async(request)
    graph.wait(future.done, f"an answer of {name}")
    graph.probe.destroy_client(client)
    return future.result()


def press(graph, name: str) -> Any:
    """Call emergency stop or reset."""
    return call(graph, Trigger, name, Trigger.Request())


def arm(graph, on: bool = True) -> Any:
    """Arm or disarm."""
    return call(graph, SetBool, ARM, SetBool.Request(data=on))


def change(graph, transition: int) -> bool:
    """Ask for a transition of the lifecycle."""
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(call(graph, ChangeState, "coil_bridge/change_state", request).success)


def stage(graph) -> str:
    """Return the lifecycle's state."""
    return str(call(graph, GetState, "coil_bridge/get_state", GetState.Request()).current_state.label)


def applied(node) -> list[np.ndarray]:
    """Return what the recording driver was told."""
    return list(node.system.driver.applied)


def driven(node) -> bool:
    """Return whether any current was on."""
    return any(currents.any() for currents in applied(node))


def reasons(states) -> str:
    """Return why the coils are at zero, by the last state."""
    return "; ".join(states[-1].reasons) if states else ""


def set_parameter(graph, name: str, value: float) -> Any:
    """Set a number among the bridge's parameters."""
    parameter = Parameter(name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value))
    request = SetParameters.Request(parameters=[parameter])
    return call(graph, SetParameters, "coil_bridge/set_parameters", request).results[0]
