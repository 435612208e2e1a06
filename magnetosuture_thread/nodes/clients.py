"""Clients of a running graph: of its coil bridge, and of its needle planner."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import CoilBridgeState, ProcedureState
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from typing_extensions import Self

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, EXECUTE_PROCEDURE, RESET
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge import JITTER_KEYS, SCHEDULING
from magnetosuture_thread.nodes.diagnostics import read_status
from magnetosuture_thread.nodes.node import MAX_REASON_CHARS, GuardedNode
from magnetosuture_thread.texts import shortened

TIMEOUT = 10.0  # s for the bridge to be found and to answer
DISCOVERY_TIME = 1.0  # s after a node is found, for it to have discovered this client
CALL_PERIOD = 0.5  # s without an answer, after which a service is called again
SETTLE_TIME = 0.15  # s after an answer, for the bridge to publish its new state
GOAL_PERIOD = 2.0  # s after which a procedure that could not begin is sent again
MAX_CALLBACKS = 20  # of one poll

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}
_BRIDGE_STATES = {
    CoilBridgeState.STATE_UNCONFIGURED: "unconfigured",
    CoilBridgeState.STATE_INACTIVE: "inactive",
    CoilBridgeState.STATE_ACTIVE: "active",
    CoilBridgeState.STATE_FAULT: "fault",
}
DONE = "done"
_PROCEDURE_STATES = {
    ProcedureState.STATE_READY: "planned",
    ProcedureState.STATE_RUNNING: "running",
    ProcedureState.STATE_PAUSED: "paused",
    ProcedureState.STATE_DONE: DONE,
    ProcedureState.STATE_FAILED: "failed",
}


class _Client:
    """A node in a context of its own, on the ROS domain of the environment, whose callbacks run when it says.

    Args:
        name: of the node.
        namespace: of the node.
    """

    def __init__(self, name: str, namespace: str = "") -> None:
        self._name, self._namespace = name, namespace
        self._context = Context()

    def __enter__(self) -> Self:
        """Join the graph."""
        rclpy.init(context=self._context, args=[])
        options = {"context": self._context, "namespace": self._namespace, "start_parameter_services": False}
        self._node = GuardedNode(self._name, **options)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._join()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._leave()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _join(self) -> None:
        """Make what is needed to talk to the graph."""

    def _leave(self) -> None:
        """Destroy what the node does not."""


class CoilClient(_Client):
    """Client of the coil bridge on the ROS domain of the environment.

    Args:
        namespace: of the bridge, where it is in one.
    """

    def __init__(self, namespace: str = "") -> None:
        super().__init__("coil_client", namespace)
        self._state: CoilBridgeState | None = None
        self._values: dict[str, str] = {}

    def _join(self) -> None:
        self._bridge = f"{self._node.get_namespace()}/coil_bridge".lstrip("/")
        topics.BRIDGE_STATE.subscribe(self._node, self._on_state)
        topics.DIAGNOSTICS.subscribe(self._node, self._on_diagnostics)

    def execute(self, action: str) -> str:
        """Execute a command: a lifecycle transition, arm, disarm, stop, or reset.

        Returns:
            What is wrong although it was executed, as an emergency stop that is not kept over a restart; or nothing.

        Raises:
            GraphError: no bridge was found, or it rejects the command.
        """
        if action in TRANSITIONS:
            transition = Transition(id=TRANSITIONS[action])
            answer = self._call(ChangeState, "coil_bridge/change_state", ChangeState.Request(transition=transition))
            message = f"the bridge rejected {action}: not possible in its state, or see its log"
        elif action in ("arm", "disarm"):
            answer = self._call(SetBool, ARM, SetBool.Request(data=action == "arm"))
            message = answer.message
        else:
            answer = self._call(Trigger, {"stop": EMERGENCY_STOP, "reset": RESET}[action], Trigger.Request())
            message = answer.message
        if not answer.success:
            raise GraphError(shortened(message, MAX_REASON_CHARS))
        self._spin(lambda: False, SETTLE_TIME)
        return "" if action in TRANSITIONS else shortened(message, MAX_REASON_CHARS)

    def state(self) -> dict[str, Any]:
        """Return the state of the bridge as text for display.

        Raises:
            GraphError: no state was received.
        """
        self._spin(lambda: self._state is not None, TIMEOUT)
        state = self._state
        if state is None:
            raise GraphError(f"no coil_bridge state received within {TIMEOUT:g} s on this ROS domain")
        return {
            "state": _BRIDGE_STATES[state.state] + (", armed" if state.armed else ""),
            "currents are zero because": _listed(state.reasons) or "they are not: a command is followed",
            "velocity commanded [mm/s]": _millimetres(state.commanded),
            "velocity filtered [mm/s]": _millimetres(state.filtered),
            "velocity applied [mm/s]": _millimetres(state.applied) + (", saturated" if state.saturated else ""),
            "currents [A]": _numbers(state.current),
            "measured currents [A]": _numbers(state.measured_current),
            "supplies [V]": _numbers(state.supply_voltage),
            "driver": shortened(state.driver) + (", ready" if state.driver_ready else ", not ready"),
            "driver warnings": _listed(state.driver_warnings) or "none",
            "messages refused": str(state.refused),
        }

    def loop_timing(self) -> tuple[tuple[float, float, float], str]:
        """Return the jitter of the bridge's loop, and how its process is scheduled.

        Returns:
            Median, 99th percentile and maximum over the last intervals [ms]; scheduling as text.

        Raises:
            GraphError: no diagnostics were received.
        """
        self._values = {}
        self._spin(lambda: SCHEDULING in self._values, TIMEOUT)
        if SCHEDULING not in self._values:
            raise GraphError(f"no coil_bridge diagnostics received within {TIMEOUT:g} s")
        median, p99, maximum = (float(self._values[name]) for name in JITTER_KEYS)
        return (median, p99, maximum), self._values[SCHEDULING]

    def _call(self, kind: Any, name: str, request: Any) -> Any:
        client = self._node.create_client(kind, name)
        self._spin(client.service_is_ready, TIMEOUT)
        if not client.service_is_ready():
            raise GraphError(f"no coil_bridge found within {TIMEOUT:g} s on this ROS domain (service {name})")
        deadline = time.monotonic() + TIMEOUT
        is_transition = kind is ChangeState
        if is_transition:
            # The bridge must have discovered this client too, or its answer is lost.
            self._spin(lambda: self._state is not None, TIMEOUT)
            self._spin(lambda: False, DISCOVERY_TIME)
        while time.monotonic() < deadline:
            # The services may be called repeatedly: a lost answer blocks nothing.
            future = client.call_async(request)
            self._spin(future.done, TIMEOUT if is_transition else CALL_PERIOD)
            if future.done():
                return future.result()
        raise GraphError(f"coil_bridge did not answer within {TIMEOUT:g} s (service {name})")

    def _spin(self, until: Callable[[], bool], timeout: float) -> None:
        deadline = time.monotonic() + timeout
        while not until() and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.02)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(f"{self._bridge}:"):
                _, self._values = read_status(status)

    def _on_state(self, message: CoilBridgeState) -> None:
        self._state = message


def _millimetres(vector: Any) -> str:
    return f"{1e3 * vector.x:.3f}, {1e3 * vector.y:.3f}"


def _numbers(values: Any) -> str:
    return ", ".join(f"{value:.2f}" for value in values) or "none"


def _listed(texts: Any) -> str:
    return shortened("; ".join(texts), MAX_REASON_CHARS)


@dataclass(frozen=True)
class ProcedureReport:
    """What the planner reports of a procedure.

    Attributes:
        state: planned, running, paused, done or failed.
        reason: why it is paused or has failed; empty else.
        goals_met: how many goals are met.
        progress: completed share of the present goal's path, 0 to 1.
        clearance: minimum distance of the needle's axis from wall and shapes so far [m]; NaN if unknown.
    """

    state: str
    reason: str
    goals_met: int
    progress: float = 0.0
    clearance: float = math.nan


class ProcedureClient(_Client):
    """Client of the needle planner on the ROS domain of the environment; nothing happens but in `poll`.

    Args:
        procedure: name, path or YAML text.

    Attributes:
        status: of the procedure; None before it has begun.
        result: of the procedure; None before its end.
        refusal: why it could not begin the last time, as the needle may not be tracked yet.
    """

    def __init__(self, procedure: str) -> None:
        super().__init__("procedure_client")
        self._request = ExecuteProcedure.Goal(procedure=procedure)
        self._send_at: float | None = None  # None until the planner is found
        self._sent: Future | None = None
        self._ended: Future | None = None
        self.status: ProcedureReport | None = None
        self.result: ProcedureReport | None = None
        self.refusal = ""

    def _join(self) -> None:
        self._client = ActionClient(self._node, ExecuteProcedure, EXECUTE_PROCEDURE)

    def _leave(self) -> None:
        self._client.destroy()

    def poll(self) -> None:
        """Send the goal once the planner is there, and take what has come."""
        for _ in range(MAX_CALLBACKS):
            self._executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        if self._send_at is None:
            if self._client.server_is_ready():
                self._send_at = now + DISCOVERY_TIME
        elif self._sent is None:
            if now >= self._send_at:
                self._sent = self._client.send_goal_async(self._request, self._on_feedback)
        elif self._ended is None:
            if self._sent.done():
                self._ended = self._sent.result().get_result_async()
        elif self._ended.done() and self.result is None:
            self._end(self._ended.result().result, now)

    def _on_feedback(self, message: Any) -> None:
        status = message.feedback.status
        state = _PROCEDURE_STATES.get(status.state, "unknown")
        self.status = ProcedureReport(state, status.reason, status.goals_met, status.progress, status.clearance)

    def _end(self, result: ExecuteProcedure.Result, now: float) -> None:
        if self.status is not None or result.state == ProcedureState.STATE_DONE:
            self.result = ProcedureReport(
                _PROCEDURE_STATES.get(result.state, "unknown"), result.reason, result.goals_met
            )
            return
        self.refusal, self._sent, self._ended, self._send_at = result.reason, None, None, now + GOAL_PERIOD
