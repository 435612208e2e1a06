"""Client of a running needle planner: begins a procedure and follows it to its end."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import rclpy
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import ProcedureState
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future

from magnetosuture_thread.interface import EXECUTE_PROCEDURE
from magnetosuture_thread.nodes.node import GuardedNode

DISCOVERY_TIME = 1.0  # s after the action is found, for the planner to have discovered this client
RETRY_PERIOD = 2.0  # s after which a procedure that could not begin is sent again
MAX_CALLBACKS = 20  # of one poll
DONE = "done"
STATES = {
    ProcedureState.STATE_READY: "planned",
    ProcedureState.STATE_RUNNING: "running",
    ProcedureState.STATE_PAUSED: "paused",
    ProcedureState.STATE_DONE: DONE,
    ProcedureState.STATE_FAILED: "failed",
}


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


class ProcedureClient:
    """Client of the needle planner on the ROS domain of the environment; nothing happens but in `poll`.

    Args:
        procedure: name, path or YAML text.

    Attributes:
        status: of the procedure; None before it has begun.
        result: of the procedure; None before its end.
        refusal: why it could not begin the last time, as the needle may not be tracked yet.
    """

    def __init__(self, procedure: str) -> None:
        self._request = ExecuteProcedure.Goal(procedure=procedure)
        self._context = Context()
        self._send_at: float | None = None  # None until the planner is found
        self._sent: Future | None = None
        self._ended: Future | None = None
        self.status: ProcedureReport | None = None
        self.result: ProcedureReport | None = None
        self.refusal = ""

    def __enter__(self) -> ProcedureClient:
        """Join the graph."""
        rclpy.init(context=self._context, args=[])
        self._node = GuardedNode("procedure_client", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._client = ActionClient(self._node, ExecuteProcedure, EXECUTE_PROCEDURE)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._client.destroy()
        self._node.destroy_node()
        self._context.try_shutdown()

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
        state = STATES.get(status.state, "unknown")
        self.status = ProcedureReport(state, status.reason, status.goals_met, status.progress, status.clearance)

    def _end(self, result: ExecuteProcedure.Result, now: float) -> None:
        if self.status is not None or result.state == ProcedureState.STATE_DONE:
            self.result = ProcedureReport(STATES.get(result.state, "unknown"), result.reason, result.goals_met)
            return
        self.refusal, self._sent, self._ended, self._send_at = result.reason, None, None, now + RETRY_PERIOD
