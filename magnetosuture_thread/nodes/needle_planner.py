"""The node `needle_planner`: takes the needle through the goals of a procedure."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from magnetosuture_msgs import msg
from magnetosuture_msgs.action import ExecuteProcedure
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future
from std_msgs.msg import Header

from magnetosuture_thread import InvalidInputError, Scene
from magnetosuture_thread.bags import reading
from magnetosuture_thread.bags.packing import packed_path, packed_pose_stamped, packed_twist
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.estimator.disturbance import disturbance_text
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import ManagedNode, SceneFollower, check_pressed, reason_of
from magnetosuture_thread.nodes.parameters import settings_of
from magnetosuture_thread.nodes.processes import leave_priority
from magnetosuture_thread.planning import session
from magnetosuture_thread.planning.executor import ProcedureState
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.procedure import read_procedure_text
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import MAX_REASON_CHARS, shortened

PERIOD = 0.1  # s between two messages of the state where only progress or clearance have changed


class NeedlePlannerNode(ManagedNode[session.NeedlePlannerSettings]):
    """Commands the needle along planned paths, at every pose; without poses the coil bridge times out.

    A worker plans, for up to some seconds, while the needle is kept in place. The operator is above it: any message on
    `operator/servo_cv` pauses the procedure until `procedure/resume`. Deactivated, the node gives the procedure up, the
    needle at rest.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(interface.PLANNER, session.NeedlePlannerSettings, **options)
        self._coils = settings_of(self, CoilBridgeSettings, options)
        self._model = settings_of(self, ThreadModelSettings, options)
        self._planning = ThreadPoolExecutor(1, initializer=leave_priority)
        self._moving = False  # whether the last command was not zero
        self._action: ProcedureAction | None = None
        self._scene = SceneFollower(self, self.on_scene)
        self.start()

    def allocate(self, settings: session.NeedlePlannerSettings) -> None:
        """Load the planner's kernels, and offer what it does."""
        scene = self._scene.load(settings.scene)
        self._session = session.ProcedureSession(settings, scene, self._planning.submit, self._coils, self._model)
        with self.health.load("the planner's kernels"):
            session.compile_planning()
        self._commands, self._setpoints = topics.NEEDLE_COMMAND.publisher(self), topics.TIP_SETPOINT.publisher(self)
        self._states, self._plans = topics.PROCEDURE_STATE.publisher(self), topics.PROCEDURE_PLAN.publisher(self)
        self._published: tuple[Any, ...] = ()
        self._published_at = -math.inf
        topics.BRIDGE_STATE.subscribe(self, self.on_bridge)
        for topic, handle in (
            (topics.TRACKER_STATE, self.on_tracker),
            (topics.PROCEDURE_HOLD, self.on_hold),
            (topics.NEEDLE_POSE, self.on_pose),
            (topics.OPERATOR_COMMAND, self.on_operator),
        ):
            topic.subscribe(self, self.while_active(handle))
        self._read_sparingly(topics.PREDICTED_THREAD, self.on_prediction)
        self._read_sparingly(topics.ESTIMATED_THREAD, self.on_estimate)
        self._read_sparingly(topics.MARGINS, self.on_margins)
        self.serve(interface.Service.PLAN_PROCEDURE, self.on_plan)
        for service, execute in (
            (interface.Service.PAUSE_PROCEDURE, lambda: self._session.pause("paused by a person")),
            (interface.Service.ABORT_PROCEDURE, lambda: self._session.abort("given up by a person")),
        ):
            self.serve(service, partial(self._switch, execute))
        self.serve(interface.Service.RESUME_PROCEDURE, partial(self._switch, self.resume_procedure), lambda _: True)
        self._action = ProcedureAction(self)
        self.every(PERIOD, self.while_active(self.on_timer))

    def release(self) -> None:
        """Offer the action no more."""
        if self._action is not None:
            self._action.destroy()
        self._action = None

    def activate(self) -> None:
        """Publish that there is no procedure, or how the last one ended."""
        self._published = ()
        self._publish()

    def deactivate(self) -> None:
        """Give the procedure up, the needle at rest."""
        if self.is_active:
            self.abort(f"the needle planner {'has ended' if self.is_shutting_down else 'was deactivated'}")

    def execute(self, request: Any) -> None:
        """Plan and begin a procedure; raise a `MagnetosutureError` where that cannot be, or the request is late."""
        self.require_active()
        if pressed := reading.seconds(request.stamp):
            check_pressed(interface.EXECUTE_PROCEDURE, pressed, self.get_clock().now().nanoseconds * 1e-9)
        self._check_bridge()
        self._plan(request)
        self._session.resume(time.monotonic())
        self._publish()

    def resume_procedure(self) -> bool:
        """Begin what is planned, or go on; raise an `InvalidInputError` where that cannot be."""
        self._check_bridge()
        self._session.resume(time.monotonic())
        return True

    def abort(self, reason: str) -> None:
        """Give the procedure up, the needle at rest."""
        self._session.abort(reason)
        self._publish()

    def on_plan(self, request: Any) -> dict[str, float]:
        """Plan a procedure; the plan is published, and nothing moves. Return the answer's fields."""
        self.require_active()
        length = sum(path.length for path in self._plan(request))
        self._publish()
        return {"length": length, "duration": self._session.planned_duration}

    def on_scene(self, scene: Scene) -> None:
        """Go by another scene; a procedure that does not fit it fails."""
        if self.is_active:
            self._rest()
        with self._deaf():
            self._session.set_scene(scene)
        if self.is_active:
            self._publish()

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Publish the motion that the procedure commands, if one runs."""
        pose, now = reading.needle_pose(message), self.get_clock().now().nanoseconds * 1e-9
        reading.check_pose_age(pose.stamp, now, self.configured_settings.pose_timeout)
        age = max(0.0, now - pose.stamp)
        velocity = self._session.on_pose(pose.stamp, pose.tail, pose.heading, time.monotonic(), age)
        if velocity is not None:
            self._commands.publish(packed_twist(self.get_clock().now().to_msg(), velocity))
            self._moving = bool(velocity.any())
        if (setpoint := self._session.setpoint) is not None:
            self._setpoints.publish(packed_pose_stamped(message.header.stamp, *setpoint))
        self._publish()

    def on_bridge(self, message: msg.CoilBridgeState) -> None:
        """Pause where the coil bridge is disarmed or stopped; register the pull that it compensates."""
        self._session.on_bridge(message.armed, (message.pull.x, message.pull.y))
        if self.is_active:
            self._publish()

    def on_operator(self, message: object) -> None:
        """Leave the needle to the operator, whatever is commanded."""
        self._session.pause("an operator commands the needle")
        self._publish()

    def on_tracker(self, message: msg.TrackerState) -> None:
        """Register whether the needle is tracked."""
        self._session.known.on_tracker("" if message.state == message.STATE_TRACKED else _reason(message))

    def on_prediction(self, message: msg.PredictedThread) -> None:
        """Register the tension of the thread."""
        tension = float(np.max(message.tension, initial=0.0))
        if not math.isfinite(tension):
            raise InvalidInputError("thread/predicted.tension", tension, "finite numbers")
        self._session.known.on_prediction(time.monotonic(), tension, lambda: _vertices(message))

    def on_estimate(self, message: msg.EstimatedThread) -> None:
        """Register how sure the estimate is, and which forces the model does not know of."""
        disturbances = {}
        for force in message.disturbances[:20]:
            text = disturbance_text(force.arc_length, force.force, (force.direction.x, force.direction.y))
            disturbances[reading.seconds(force.since)] = text
        now, unmeasured = time.monotonic(), message.unmeasured_for
        self._session.known.on_estimate(now, unmeasured, disturbances, lambda: _vertices(message))

    def on_margins(self, message: msg.SafetyMargins) -> None:
        """Register the thread's friction, and whether its margins are valid."""
        reason = "" if message.valid else _reason(message)
        if not reason and not 0.0 < message.slowdown <= 1.0:
            raise InvalidInputError("thread/margins.slowdown", message.slowdown, "above 0 and at most 1")
        nodes, version = len(message.friction_nodes), message.scene_version
        self._session.known.on_margins(time.monotonic(), reason, nodes, message.slowdown, version)

    def on_hold(self, message: Header) -> None:
        """Register that somebody holds the page; a message that was on its way for too long does not count."""
        age = self.get_clock().now().nanoseconds * 1e-9 - reading.seconds(message.stamp)
        if abs(age) <= self.configured_settings.hold_timeout:
            self._session.known.on_hold(time.monotonic())

    def on_timer(self) -> None:
        """Look after the graph, and after a needle of which no pose comes."""
        self._session.known.on_graph(self._graph_problem())
        self._session.check(time.monotonic())
        self._publish()

    def destroy_node(self) -> None:
        """Leave the graph."""
        self._planning.shutdown(wait=False, cancel_futures=True)
        super().destroy_node()

    def _read_sparingly(self, topic: topics.Topic, handle: Callable[[Any], None]) -> None:
        """Read every message of a topic while a procedure is executed, and few while none is, as that costs most."""
        due = 0.0  # when the next message is read while nothing is executed [s]

        def take(data: bytes) -> None:
            nonlocal due
            now = time.monotonic()
            if now >= due or self._session.is_active:
                due = now + 0.2
                topic.decoded(self, data, handle)

        topic.subscribe(self, self.while_active(take), raw=True)

    def _switch(self, execute: Callable[[], bool], request: Any) -> dict[str, Any]:
        self.require_active()
        success = execute()
        self._publish()
        return {"success": success, "message": "" if success else "no procedure is executed"}

    def _plan(self, request: Any) -> tuple[BodyPath, ...]:
        procedure = read_procedure_text(request.procedure)
        with self._deaf():
            return self._session.plan(procedure, time.monotonic(), hold_to_run=request.hold_to_run)

    def _check_bridge(self) -> None:
        if problem := self._graph_problem():
            raise InvalidInputError("needle/servo_cv", problem, "the coil bridge, and no other node that commands")
        self._session.check_armed()

    def _graph_problem(self) -> str:
        """Return why commands would not be followed, or not those of one planner alone."""
        if (subscribers := self._commands.get_subscription_count()) < self.configured_settings.audience:
            return f"{subscribers} of {self.configured_settings.audience} subscribers to velocity commands"
        count = self.count_publishers(self._commands.topic_name)
        return f"{count} nodes publish {topics.NEEDLE_COMMAND.name}" if count > 1 else ""

    def _publish(self) -> None:
        """Publish what has changed; bring the needle to rest where the procedure does not command it."""
        if not self._session.is_commanding:
            self._rest()
        stamp = self.get_clock().now().to_msg()
        if (plan := self._session.new_plan()) is not None:
            self._plans.publish(packed_path(stamp, plan))
        status, now = self._session.status, time.monotonic()
        key = (status.state, status.procedure, status.goal, status.reason, status.resumes, status.hold_to_run)
        if key != self._published or (now - self._published_at >= PERIOD and self._session.is_running):
            self._published, self._published_at = key, now
            message = state_message(stamp, status)
            self._states.publish(message)
            self._report(status)
            if self._action is not None:
                self._action.update(message)

    def _report(self, status: session.ProcedureStatus) -> None:
        name, state, text, level = shortened(status.procedure), status.state, "no procedure", self.health.ok
        if state is ProcedureState.RUNNING:
            text = f"{name}: {status.goals[status.goal]}, goal {status.goal + 1} of {len(status.goals)}"
        elif state in (ProcedureState.PAUSED, ProcedureState.FAILED):
            level, text = self.health.warn, f"{name}: {state.value}: {status.reason}"
        elif state is not None:
            text = f"{name}: {state.value}"
        level(text, procedure=name, **{"goals met": f"{status.goals_met} of {len(status.goals)}"})

    def _rest(self) -> None:
        """Stop the needle now, and not when its last command times out."""
        if self._moving:
            self._commands.publish(packed_twist(self.get_clock().now().to_msg(), np.zeros(2)))
            self._moving = False

    @contextmanager
    def _deaf(self) -> Iterator[None]:
        """While a path is planned, for up to some seconds, nothing is heard: what is known gets no older by that."""
        began = time.monotonic()
        try:
            yield
        finally:
            self._session.known.shift(time.monotonic() - began)


def _reason(message: Any) -> str:
    """Return the reason that a message gives, as it may be kept."""
    return shortened(message.reason, MAX_REASON_CHARS) or "no reason is given"


def _vertices(message: Any) -> Points | None:
    """Return the nodes of a predicted or estimated thread, shape (n + 1, 2) [m]; None where these are no thread."""
    vertices = np.array([(point.x, point.y) for point in message.positions])
    return vertices if len(vertices) >= 2 and np.isfinite(vertices).all() else None


def state_message(stamp: Any, status: session.ProcedureStatus) -> msg.ProcedureState:
    """Return the state of a procedure as a message, whose fields have the names of its own."""
    state = getattr(msg.ProcedureState, f"STATE_{'IDLE' if status.state is None else status.state.name}")
    fields = {**vars(status), "state": state, "goals": list(status.goals), "procedure": shortened(status.procedure)}
    fields["reason"] = shortened(status.reason, MAX_REASON_CHARS)
    return msg.ProcedureState(header=Header(stamp=stamp, frame_id=interface.DISH_FRAME), **fields)


class ProcedureAction:
    """Serves the action. Every goal is accepted, as a refusal could give no reason: one that cannot begin is aborted.

    Args:
        node: that executes procedures.
    """

    def __init__(self, node: NeedlePlannerNode) -> None:
        self._node = node
        self._goal: Any = None
        self._end: Future = Future()  # of the goal's procedure, with its last state
        callbacks = {"goal_callback": lambda request: GoalResponse.ACCEPT, "cancel_callback": self.on_cancel}
        server = ActionServer(node, ExecuteProcedure, interface.EXECUTE_PROCEDURE, self.on_goal, **callbacks)
        self.destroy = server.destroy

    async def on_goal(self, goal: Any) -> ExecuteProcedure.Result:
        """Begin the procedure of a goal, and return its result at its end."""
        try:
            self._node.execute(goal.request)
        except Exception as error:  # it would come out of `spin`
            self._node.refuse(error)
            goal.abort()
            return ExecuteProcedure.Result(state=msg.ProcedureState.STATE_FAILED, reason=reason_of(error))
        self._goal, self._end = goal, Future()
        status = await self._end
        if goal.is_cancel_requested:
            goal.canceled()
        elif status.state == msg.ProcedureState.STATE_FAILED:
            goal.abort()
        else:
            goal.succeed()
        return ExecuteProcedure.Result(state=status.state, reason=status.reason, goals_met=status.goals_met)

    def on_cancel(self, goal: Any) -> CancelResponse:
        """Give the procedure of a goal up."""
        if goal != self._goal or self._end.done():
            return CancelResponse.REJECT
        self._node.abort("cancelled by the client of the action")
        return CancelResponse.ACCEPT

    def update(self, status: msg.ProcedureState) -> None:
        """Take the state of the procedure: feedback of the goal, or its end."""
        if self._goal is None or self._end.done():
            return
        if status.state in (msg.ProcedureState.STATE_DONE, msg.ProcedureState.STATE_FAILED):
            self._end.set_result(status)
        else:
            self._goal.publish_feedback(ExecuteProcedure.Feedback(status=status))
