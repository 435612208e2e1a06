"""What the node `needle_planner` hears of the loop while it executes a procedure."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from magnetosuture_msgs.msg import EstimatedThread, PredictedThread, SafetyMargins, TrackerState
from std_msgs.msg import Header

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.messages import reading
from magnetosuture_thread.model.estimator.disturbance import disturbance_text
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.lifecycle import StandbyNode
from magnetosuture_thread.nodes.node import MAX_REASON_CHARS, PackageNode
from magnetosuture_thread.planning.session import ProcedureSession
from magnetosuture_thread.planning.settings import NeedlePlannerSettings
from magnetosuture_thread.texts import shortened

MAX_DISTURBANCES = 20  # that are read of a message
IDLE_PERIOD = 0.2  # s between two messages of a thread that are read while nothing is executed


class ProcedureInputs:
    """Registers tracker, thread and held page in the state of the loop.

    Args:
        node: that subscribes.
        session: in which it is registered.
        hold_timeout: age beyond which a message on `procedure/hold` does not count [s].
    """

    def __init__(
        self, node: StandbyNode[NeedlePlannerSettings], session: ProcedureSession, hold_timeout: float
    ) -> None:
        self._node, self._session, self._hold_timeout = node, session, hold_timeout
        self._known = session.known
        node.held(topics.TRACKER_STATE.subscribe(node, node.while_active(self.on_tracker)))
        for topic, handle in (
            (topics.PREDICTED_THREAD, self.on_prediction),
            (topics.ESTIMATED_THREAD, self.on_estimate),
            (topics.MARGINS, self.on_margins),
        ):
            sparing = _Sparing(node, topic, handle, lambda: session.is_active)
            node.held(topic.subscribe(node, node.while_active(sparing.take), raw=True))
        node.held(topics.PROCEDURE_HOLD.subscribe(node, node.while_active(self.on_hold)))

    def on_tracker(self, message: TrackerState) -> None:
        """Register whether the needle is tracked."""
        tracked = message.state == TrackerState.STATE_TRACKED
        self._known.on_tracker("" if tracked else _reason(message))

    def on_prediction(self, message: PredictedThread) -> None:
        """Register the tension of the thread."""
        tension = float(np.max(message.tension, initial=0.0))
        if not math.isfinite(tension):
            self._node.refuse(InvalidInputError("thread/predicted.tension", tension, "finite numbers"))
            return
        self._known.on_prediction(time.monotonic(), tension, lambda: _vertices(message))

    def on_estimate(self, message: EstimatedThread) -> None:
        """Register how sure the estimate is, and which forces the model does not know of."""
        found = {
            reading.seconds(each.since): disturbance_text(
                each.arc_length, each.force, (each.direction.x, each.direction.y)
            )
            for each in message.disturbances[:MAX_DISTURBANCES]
        }
        self._known.on_estimate(time.monotonic(), message.unmeasured_for, found, lambda: _vertices(message))

    def on_margins(self, message: SafetyMargins) -> None:
        """Register the thread's friction, and whether its margins are valid."""
        reason = "" if message.valid else _reason(message)
        if not reason and not 0.0 < message.slowdown <= 1.0:
            self._node.refuse(InvalidInputError("thread/margins.slowdown", message.slowdown, "above 0 and at most 1"))
            return
        nodes = len(message.friction_nodes)
        self._known.on_margins(time.monotonic(), reason, nodes, message.slowdown, message.scene_version)

    def on_hold(self, message: Header) -> None:
        """Register that somebody holds the page; a message that was on its way for too long does not count."""
        now = self._node.get_clock().now().nanoseconds * 1e-9
        if abs(now - reading.seconds(message.stamp)) <= self._hold_timeout:
            self._known.on_hold(time.monotonic())


class _Sparing:
    """Reads every message of a topic while a procedure is executed, and few while none is: to read them costs the most.

    Args:
        node: that reports messages which cannot be read.
        topic: of the messages.
        handle: called with each that is read.
        is_active: whether a procedure is executed.
    """

    def __init__(
        self, node: PackageNode, topic: topics.Topic, handle: Callable[[Any], None], is_active: Callable[[], bool]
    ) -> None:
        self._node, self._topic, self._handle, self._is_active = node, topic, handle, is_active
        self._due = -math.inf

    def take(self, data: bytes) -> None:
        """Take the bytes of a message."""
        now = time.monotonic()
        if now < self._due and not self._is_active():
            return
        self._due = now + IDLE_PERIOD
        try:
            message = self._topic.decode(data)
        except InvalidInputError as error:
            self._node.refuse(error)
        else:
            self._handle(message)


def _reason(message: Any) -> str:
    """Return the reason that a message gives, as it may be kept."""
    return shortened(message.reason, MAX_REASON_CHARS) or "no reason is given"


def _vertices(message: Any) -> Points | None:
    """Return the nodes of a predicted or estimated thread, shape (n + 1, 2) [m]; None where these are no thread."""
    found = np.array([(point.x, point.y) for point in message.positions])
    return found if len(found) >= 2 and np.isfinite(found).all() else None
