"""What the node `needle_planner` publishes of a procedure: its state and its plan."""

from __future__ import annotations

import math
import time
from typing import Any

from magnetosuture_msgs.msg import ProcedureState as StateMessage

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.lifecycle import StandbyNode
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.node import MAX_REASON_CHARS
from magnetosuture_thread.planning.executor import ProcedureState
from magnetosuture_thread.planning.session import ProcedureSession, ProcedureStatus
from magnetosuture_thread.planning.settings import NeedlePlannerSettings
from magnetosuture_thread.texts import shortened

PERIOD = 0.1  # s between two messages of the state where only progress or clearance have changed
STATES = {
    None: StateMessage.STATE_IDLE,
    ProcedureState.READY: StateMessage.STATE_READY,
    ProcedureState.RUNNING: StateMessage.STATE_RUNNING,
    ProcedureState.PAUSED: StateMessage.STATE_PAUSED,
    ProcedureState.DONE: StateMessage.STATE_DONE,
    ProcedureState.FAILED: StateMessage.STATE_FAILED,
}


class ProcedureOutputs:
    """Publishes state and plan of a procedure when they change.

    Args:
        node: that publishes; its health reports the state too.
        session: whose procedure it is.
    """

    def __init__(self, node: StandbyNode[NeedlePlannerSettings], session: ProcedureSession) -> None:
        self._node, self._session = node, session
        self._states = node.held(topics.PROCEDURE_STATE.publisher(node))
        self._plans = node.held(topics.PROCEDURE_PLAN.publisher(node))
        self._published: tuple[Any, ...] = ()
        self._published_at = -math.inf

    def repeat(self) -> None:
        """Publish the state at the next call, also where it has not changed."""
        self._published = ()

    def publish(self) -> StateMessage | None:
        """Publish what has changed; return the state if it was published."""
        stamp = self._node.get_clock().now().to_msg()
        plan = self._session.new_plan()
        if plan is not None:
            self._plans.publish(MESSAGES.path_message(stamp, plan))
        status, now = self._session.status, time.monotonic()
        key = (status.state, status.procedure, status.goal, status.reason, status.resumes, status.hold_to_run)
        if key == self._published and (now - self._published_at < PERIOD or not self._session.is_running):
            return None
        self._published, self._published_at = key, now
        message = state_message(stamp, status)
        self._states.publish(message)
        self._report(status)
        return message

    def _report(self, status: ProcedureStatus) -> None:
        health, name = self._node.health, shortened(status.procedure)
        values = {"procedure": name, "goals met": f"{status.goals_met} of {len(status.goals)}"}
        if status.state is None:
            health.ok("no procedure", **values)
        elif status.state is ProcedureState.RUNNING:
            health.ok(f"{name}: {status.goals[status.goal]}, goal {status.goal + 1} of {len(status.goals)}", **values)
        elif status.state in (ProcedureState.PAUSED, ProcedureState.FAILED):
            health.warn(f"{name}: {status.state.value}: {status.reason}", **values)
        else:
            health.ok(f"{name}: {status.state.value}", **values)


def state_message(stamp: Any, status: ProcedureStatus) -> StateMessage:
    """Return the state of a procedure as a message."""
    return StateMessage(
        header=MESSAGES.header(stamp),
        state=STATES[status.state],
        procedure=shortened(status.procedure),
        goals=list(status.goals),
        goal=status.goal,
        goals_met=status.goals_met,
        progress=status.progress,
        reason=shortened(status.reason, MAX_REASON_CHARS),
        resumes=status.resumes,
        hold_to_run=status.hold_to_run,
        clearance=status.clearance,
    )
