"""The action `execute_procedure`: each goal is one procedure, of which one at a time is executed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import ProcedureState as StateMessage
from rclpy.action import ActionServer, CancelResponse, GoalResponse

from magnetosuture_thread.interface import EXECUTE_PROCEDURE
from magnetosuture_thread.nodes.node import PackageNode, reason_of

ENDED = (StateMessage.STATE_DONE, StateMessage.STATE_FAILED)


class _DeferredServer(ActionServer):
    """An action server that calls back when a goal has ended, and not when it begins.

    A callback that waited for the end would keep rclpy's executor busy: it asks every task that waits in each turn.
    """

    def notify_execute(self, goal_handle: Any, execute_callback: Callable[[Any], Any] | None) -> None:
        """Begin nothing; with a callback, that a goal has ended, send its result."""
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)


class ProcedureAction:
    """Serves the action. Every goal is accepted, as a refusal could give no reason: one that cannot begin is aborted.

    Args:
        node: that executes procedures.
        begin: begins the procedure of a goal, or raises why it cannot.
        abort: gives the procedure up, for a reason.
    """

    def __init__(self, node: PackageNode, begin: Callable[[Any], None], abort: Callable[[str], object]) -> None:
        self._node, self._begin, self._abort = node, begin, abort
        self._goal: Any = None
        self._cancelled = False
        self._ended: StateMessage | None = None
        self._server = _DeferredServer(
            node,
            ExecuteProcedure,
            EXECUTE_PROCEDURE,
            lambda goal: ExecuteProcedure.Result(),
            goal_callback=lambda request: GoalResponse.ACCEPT,
            handle_accepted_callback=self.on_goal,
            cancel_callback=self.on_cancel,
        )

    def on_goal(self, goal: Any) -> None:
        """Begin the procedure of a goal."""
        goal.execute()  # it is marked so, and nothing is called
        try:
            self._begin(goal.request)
        except Exception as error:  # it would come out of `spin`
            self._node.refuse(error)
            result = ExecuteProcedure.Result(state=StateMessage.STATE_FAILED, reason=reason_of(error))
            self._send_result(goal, "abort", result)
        else:
            self._goal, self._cancelled, self._ended = goal, False, None

    def on_cancel(self, goal: Any) -> CancelResponse:
        """Give the procedure of a goal up."""
        if self._goal is None or goal != self._goal or self._ended is not None:
            return CancelResponse.REJECT
        self._cancelled = True
        self._abort("cancelled by the client of the action")
        return CancelResponse.ACCEPT

    def update(self, status: StateMessage) -> None:
        """Take the state of the procedure: feedback of the goal, or its end."""
        if self._goal is None or self._ended is not None:
            return
        if status.state in ENDED:
            self._ended = status
        else:
            self._goal.publish_feedback(ExecuteProcedure.Feedback(status=status))

    def finish(self) -> None:
        """Send the result of a procedure that has ended; of one that is cancelled once rclpy has marked it so."""
        goal, ended = self._goal, self._ended
        if ended is None or (self._cancelled and not goal.is_cancel_requested):
            return
        self._goal = self._ended = None
        end = "canceled" if self._cancelled else "abort" if ended.state == StateMessage.STATE_FAILED else "succeed"
        result = ExecuteProcedure.Result(state=ended.state, reason=ended.reason, goals_met=ended.goals_met)
        self._send_result(goal, end, result)

    def destroy(self) -> None:
        """Take the action out of the graph."""
        self._server.destroy()

    def _send_result(self, goal: Any, end: str, result: Any) -> None:
        def finished(handle: Any) -> Any:
            getattr(handle, end)()
            return result

        self._server.notify_execute(goal, finished)
