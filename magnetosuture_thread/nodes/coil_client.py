"""Asks a running coil bridge: its state, its switches, its lifecycle."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from magnetosuture_msgs.msg import CoilBridgeState
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, RESET
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_report import LOOP, SCHEDULING

TIMEOUT = 10.0  # s for the bridge to be found and to answer
FOUND = 0.5  # s after we have heard the bridge, for it to have found us
AGAIN = 0.5  # s without an answer, after which a switch is pressed again
SETTLE = 0.15  # s after an answer, in which the bridge says its new state

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}
_NAMES = {
    CoilBridgeState.STATE_UNCONFIGURED: "unconfigured",
    CoilBridgeState.STATE_INACTIVE: "inactive",
    CoilBridgeState.STATE_ACTIVE: "active",
    CoilBridgeState.STATE_FAULT: "fault",
}


class CoilClient:
    """Talks to the coil bridge of the ROS domain that the environment names."""

    def __init__(self) -> None:
        self._context = Context()
        self._state: CoilBridgeState | None = None
        self._values: dict[str, str] = {}

    def __enter__(self) -> CoilClient:
        """Join the graph."""
        rclpy.init(context=self._context, args=[])
        self._node = rclpy.create_node("coil_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        topics.BRIDGE_STATE.subscribe(self._node, self._take)
        topics.DIAGNOSTICS.subscribe(self._node, self._hear)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def do(self, action: str) -> None:
        """Do what a person asks for: a transition, arm, disarm, stop, or reset.

        Raises:
            GraphError: no bridge is there, or it refuses.
        """
        if action in TRANSITIONS:
            transition = Transition(id=TRANSITIONS[action])
            answer = self._call(ChangeState, "coil_bridge/change_state", ChangeState.Request(transition=transition))
            refusal = f"the bridge refuses to {action}: not possible in its state, or its log says why"
        elif action in ("arm", "disarm"):
            answer = self._call(SetBool, ARM, SetBool.Request(data=action == "arm"))
            refusal = answer.message
        else:
            answer = self._call(Trigger, {"stop": EMERGENCY_STOP, "reset": RESET}[action], Trigger.Request())
            refusal = answer.message
        if not answer.success:
            raise GraphError(refusal)
        self._spin(lambda: False, SETTLE)

    def state(self) -> dict[str, Any]:
        """Return what the bridge says of itself, for a person.

        Raises:
            GraphError: no bridge says anything.
        """
        self._spin(lambda: self._state is not None, TIMEOUT)
        state = self._state
        if state is None:
            raise GraphError(f"no coil_bridge says anything within {TIMEOUT:g} s on this ROS domain")
        return {
            "state": _NAMES[state.state] + (", armed" if state.armed else ""),
            "currents are zero because": "; ".join(state.reasons) or "they are not: a command is followed",
            "velocity commanded [mm/s]": _millimetres(state.commanded),
            "velocity filtered [mm/s]": _millimetres(state.filtered),
            "velocity applied [mm/s]": _millimetres(state.applied) + (", saturated" if state.saturated else ""),
            "currents [A]": _numbers(state.current),
            "measured currents [A]": _numbers(state.measured_current),
            "supplies [V]": _numbers(state.supply_voltage),
            "driver": state.driver + (", ready" if state.driver_ready else ", not ready"),
            "driver warnings": "; ".join(state.driver_warnings) or "none",
            "messages refused": str(state.refused),
        }

    def loop(self) -> tuple[tuple[float, float, float], str]:
        """Return by how much the bridge's intervals are off their period, and how its process is scheduled.

        Returns:
            Median, 99th percentile and greatest of the last some thousand intervals [ms]; words.

        Raises:
            GraphError: no bridge says so.
        """
        self._values = {}
        self._spin(lambda: SCHEDULING in self._values, TIMEOUT)
        if SCHEDULING not in self._values:
            raise GraphError(f"no coil_bridge says how its loop runs within {TIMEOUT:g} s")
        middle, high, most = (float(self._values[name]) for name in LOOP)
        return (middle, high, most), self._values[SCHEDULING]

    def _call(self, kind: Any, name: str, request: Any) -> Any:
        client = self._node.create_client(kind, name)
        self._spin(client.service_is_ready, TIMEOUT)
        if not client.service_is_ready():
            raise GraphError(f"no coil_bridge found within {TIMEOUT:g} s on this ROS domain (service {name})")
        deadline = time.monotonic() + TIMEOUT
        once = kind is ChangeState
        if once:
            # We have found the bridge; it must have found us, or its answer goes nowhere.
            self._spin(lambda: self._state is not None, TIMEOUT)
            self._spin(lambda: False, FOUND)
        while time.monotonic() < deadline:
            # A switch does no harm if it is pressed again: nothing waits for an answer that got lost.
            future = client.call_async(request)
            self._spin(future.done, TIMEOUT if once else AGAIN)
            if future.done():
                return future.result()
        raise GraphError(f"coil_bridge did not answer within {TIMEOUT:g} s (service {name})")

    def _spin(self, until: Callable[[], bool], longest: float) -> None:
        deadline = time.monotonic() + longest
        while not until() and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.02)

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith("coil_bridge:"):
                self._values = {value.key: value.value for value in status.values}

    def _take(self, message: CoilBridgeState) -> None:
        self._state = message


def _millimetres(vector: Any) -> str:
    return f"{1e3 * vector.x:.3f}, {1e3 * vector.y:.3f}"


def _numbers(values: Any) -> str:
    return ", ".join(f"{value:.2f}" for value in values) or "none"
