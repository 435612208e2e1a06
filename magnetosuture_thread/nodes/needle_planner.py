"""The node `needle_planner`: takes the needle through the goals of a procedure."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from magnetosuture_msgs.msg import CoilBridgeState
from magnetosuture_msgs.srv import PlanProcedure
from rclpy.clock import Clock, ClockType
from std_srvs.srv import Trigger

from magnetosuture_thread import InvalidInputError, Scene
from magnetosuture_thread.interface import ABORT_PROCEDURE, PAUSE_PROCEDURE, PLAN_PROCEDURE, PLANNER, RESUME_PROCEDURE
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.lifecycle import StandbyNode
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.procedure_action import ProcedureAction
from magnetosuture_thread.nodes.procedure_inputs import ProcedureInputs
from magnetosuture_thread.nodes.procedure_outputs import PERIOD, ProcedureOutputs
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.procedure import read_procedure_text
from magnetosuture_thread.planning.session import ProcedureSession, compile_planning
from magnetosuture_thread.planning.settings import NeedlePlannerSettings


class NeedlePlannerNode(StandbyNode[NeedlePlannerSettings]):
    """Commands the needle along planned paths, at every pose; without poses the coil bridge times out.

    A thread of its own plans, for up to some seconds, while the needle is kept in place. The operator is above it:
    any message on `operator/servo_cv` pauses the procedure until `procedure/resume`. Deactivated, the node gives the
    procedure up, the needle at rest.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(PLANNER, NeedlePlannerSettings, **options)
        self._planning = ThreadPoolExecutor(1)
        self._offers = False  # whether the action is there
        self._moving = False  # whether the last command was not zero
        self._scene = SceneFollower(self, self.health, None, self.on_scene)
        self.start()

    def allocate(self, settings: NeedlePlannerSettings) -> None:
        """Load the planner's kernels, and offer what it does."""
        self._session = ProcedureSession(settings, self._scene.load(settings.scene), self._planning.submit)
        with self.health.load("the planner's kernels"):
            compile_planning()
        self._commands = self.held(topics.NEEDLE_COMMAND.publisher(self))
        self._setpoints = self.held(topics.TIP_SETPOINT.publisher(self))
        self._outputs = ProcedureOutputs(self, self._session)
        self._inputs = ProcedureInputs(self, self._session, settings.hold_timeout)
        self.held(topics.NEEDLE_POSE.subscribe(self, self.while_active(self.on_pose)))
        self.held(topics.BRIDGE_STATE.subscribe(self, self.on_bridge))
        self.held(topics.OPERATOR_COMMAND.subscribe(self, self.while_active(self.on_operator)))
        self.held(self.create_service(PlanProcedure, PLAN_PROCEDURE, self.on_plan))
        self._offer(PAUSE_PROCEDURE, lambda: self._session.pause("paused by a person"))
        self._offer(RESUME_PROCEDURE, self.resume_procedure)
        self._offer(ABORT_PROCEDURE, lambda: self._session.abort("given up by a person"))
        self._action = ProcedureAction(self, self.execute, self.abort)
        self._offers = True
        # Where simulated time stands still, a goal can be cancelled all the same.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.held(self.create_timer(PERIOD, self.while_active(self.on_timer), clock=steady))

    def activate(self) -> None:
        """Publish that there is no procedure, or how the last one ended."""
        self._outputs.repeat()
        self._publish()

    def deactivate(self) -> None:
        """Give the procedure up, the needle at rest."""
        if self.is_active:
            self.abort(f"the needle planner {'has ended' if self.is_shutting_down else 'was deactivated'}")

    def release(self) -> None:
        """Offer nothing any more."""
        if self._offers:
            self._action.destroy()
        self._offers = False
        super().release()

    def execute(self, request: Any) -> None:
        """Plan and begin a procedure; raise a `MagnetosutureError` where that cannot be."""
        self.require_active()
        self._check_bridge()
        self._plan(request)
        self._session.resume()
        self._publish()

    def resume_procedure(self) -> bool:
        """Begin what is planned, or go on; raise an `InvalidInputError` where that cannot be."""
        self._check_bridge()
        self._session.resume()
        return True

    def abort(self, reason: str) -> None:
        """Give the procedure up, the needle at rest."""
        self._session.abort(reason)
        self._publish()

    def on_plan(self, request: Any, answer: Any) -> Any:
        """Plan a procedure; the plan is published, and nothing moves."""
        self.require_active()
        paths = self._plan(request)
        length = sum(path.length for path in paths)
        answer.success, answer.length, answer.duration = True, length, self._session.planned_duration
        self._publish()
        return answer

    def on_scene(self, scene: Scene) -> None:
        """Go by another scene; a procedure that does not fit it fails."""
        if self.settings is None:
            return
        if self.is_active:
            self._rest()
        with self._deaf():
            self._session.set_scene(scene)
        if self.is_active:
            self._publish()

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Publish the velocity command of the procedure, if one runs."""
        try:
            pose = reading.needle_pose(message)
            reading.check_pose_age(
                pose.stamp, self.get_clock().now().nanoseconds * 1e-9, self.configured_settings.pose_timeout
            )
        except InvalidInputError as error:
            return self.refuse(error)
        velocity = self._session.on_pose(pose.stamp, pose.tail, pose.heading, time.monotonic())
        if velocity is not None:
            self._commands.publish(MESSAGES.twist_message(self.get_clock().now().to_msg(), velocity))
            self._moving = bool(velocity.any())
        if (setpoint := self._session.setpoint) is not None:
            self._setpoints.publish(MESSAGES.placed(message.header.stamp, *setpoint))
        self._publish()

    def on_bridge(self, message: CoilBridgeState) -> None:
        """Pause where the coil bridge is disarmed or stopped; register the drift that it compensates."""
        self._session.on_bridge(message.armed, message.drift)
        if self.is_active:
            self._publish()

    def on_operator(self, message: TwistStamped) -> None:
        """Leave the needle to the operator, whatever is commanded."""
        self._session.pause("an operator commands the needle")
        self._publish()

    def on_timer(self) -> None:
        """Look after the graph, and after a needle of which no pose comes."""
        self._session.known.on_graph(self._graph_problem())
        self._session.check(time.monotonic())
        self._publish()

    def destroy_node(self) -> None:
        """Leave the graph."""
        self._planning.shutdown(wait=False, cancel_futures=True)
        super().destroy_node()

    def _offer(self, name: str, execute: Callable[[], bool]) -> None:
        self.held(self.create_service(Trigger, name, partial(self._serve, execute)))

    def _serve(self, execute: Callable[[], bool], request: Any, answer: Any) -> Any:
        self.require_active()
        answer.success = execute()
        answer.message = "" if answer.success else "no procedure is executed"
        self._publish()
        return answer

    def _plan(self, request: Any) -> tuple[BodyPath, ...]:
        procedure = read_procedure_text(request.procedure)
        with self._deaf():
            return self._session.plan(procedure, time.monotonic(), hold_to_run=request.hold_to_run)

    def _check_bridge(self) -> None:
        problem = self._graph_problem()
        if problem:
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
        if (message := self._outputs.publish()) is not None:
            self._action.update(message)
        self._action.finish()

    def _rest(self) -> None:
        """Stop the needle now, and not when its last command times out."""
        if self._moving:
            self._commands.publish(MESSAGES.twist_message(self.get_clock().now().to_msg(), np.zeros(2)))
            self._moving = False

    @contextmanager
    def _deaf(self) -> Iterator[None]:
        """While a path is planned, for up to some seconds, nothing is heard: what is known gets no older by that."""
        began = time.monotonic()
        try:
            yield
        finally:
            self._session.known.shift(time.monotonic() - began)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(NeedlePlannerNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
