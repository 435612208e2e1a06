"""The needle planner in a graph: its action, its services, and all that pauses or ends a procedure."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Vector3
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import (
    CoilBridgeState,
    EstimatedThread,
    PredictedThread,
    ProcedureState,
    SafetyMargins,
    ThreadDisturbance,
    TrackerState,
)
from rclpy.action import ActionClient
from std_srvs.srv import Trigger

from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.settings.interface import EXECUTE_PROCEDURE, Service
from test.nodes import wire

NEEDLE = NeedleKinematics(0.0025)
RATE = 20.0  # Hz; of the poses, by their stamps: they come as fast as the test runs
OPEN = read_scene("dish_35mm")
ANSWER_TIMEOUT = 1.0  # s
THREAD = [Point(), Point(x=-0.01)]
NEAR = "goals: [{go_to: {position: [0.002, 0.001]}}]"
FAR = "goals: [{go_to: {position: [-0.012, 0.0]}}]"


class Bench:
    """An ideal needle that moves as the planner commands, and a thread that is known as the test wants it."""

    def __init__(self, graph: Any, scene: Scene = OPEN, **parameters: Any) -> None:
        own = {"needle_length": NEEDLE.length, "keep_out": 2.5e-4, "settle": 0.0}
        given: dict[str, Any] = {**own, "pose_timeout": 1.0, **parameters}  # a busy machine shows it slowly
        self.graph, self.scene = graph, scene
        self.node = graph.add(NeedlePlannerNode, **given)
        self.commands, self.states = graph.listen(topics.NEEDLE_COMMAND), graph.listen(topics.PROCEDURE_STATE)
        self.plans = graph.listen(topics.PROCEDURE_PLAN)
        self.client = ActionClient(graph.probe, ExecuteProcedure, EXECUTE_PROCEDURE)
        self.feedback: list[Any] = []
        self.tail, self.heading = np.array([-0.006, 0.0]), np.array([1.0, 0.0])
        self.frame, self.moved = 0, 0
        self.begin = int(time.time()) + 3600  # s; late poses are refused, however slowly the test runs
        self.margins = SafetyMargins(valid=True, slowdown=1.0)
        graph.publish(topics.SCENE, wire.scene_message(0, scene))
        graph.wait(lambda: self.node._scene.version == scene.version, "the scene")

    def show(self) -> None:
        """Move the needle by the last command, and show where it is and that the thread is known."""
        if len(self.commands) > self.moved:
            velocity = self.commands[-1].twist.linear
            along = NEEDLE.body_velocity(self.heading, np.array([velocity.x, velocity.y]))
            self.tail, self.heading = NEEDLE.moved(self.tail, self.heading, *along, 1.0 / RATE)
            self.moved = len(self.commands)
        stamp = Time(sec=self.begin + self.frame // 20, nanosec=50_000_000 * (self.frame % 20))
        self.frame += 1
        self.margins.scene_version = self.scene.version
        self.graph.publish(
            topics.PREDICTED_THREAD, PredictedThread(positions=[Point(), Point(x=-0.01)], tension=[1e-5])
        )
        self.graph.publish(topics.MARGINS, self.margins)
        runs, count = self.is_in(ProcedureState.STATE_RUNNING), len(self.commands)
        self.graph.publish(topics.NEEDLE_POSE, wire.pose_message(stamp, self.tail, self.heading))
        # A needle that went on meanwhile would be controlled late; a pose that got lost has no answer.
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while runs and len(self.commands) == count and self.is_in(ProcedureState.STATE_RUNNING):
            if time.monotonic() > deadline:
                return
            time.sleep(0.001)

    def until(self, condition: Any, what: str) -> None:
        """Show frames until a condition holds."""

        def shown() -> bool:
            if condition():
                return True
            self.show()
            return False

        self.graph.wait(shown, what, timeout=60.0)

    def state(self) -> Any:
        """Return the latest state."""
        return self.states[-1]

    def is_in(self, state: int, reason: str = "") -> bool:
        """Return whether the procedure is in a state, for a reason."""
        return bool(self.states) and self.states[-1].state == state and reason in self.states[-1].reason

    def send(self, procedure: str, goal_uuid: Any = None, **fields: Any) -> Any:
        """Send a goal, once the needle is known, and return its handle."""
        self.graph.wait(self.client.server_is_ready, "the action")
        self.until(lambda: self.node._session.known.has_pose(time.monotonic()), "the needle to be known")
        goal = ExecuteProcedure.Goal(procedure=procedure, **fields)
        future = self.client.send_goal_async(goal, lambda message: self.feedback.append(message.feedback), goal_uuid)
        self.until(future.done, "the goal's answer")
        return future.result()

    def result(self, goal: Any) -> tuple[int, Any]:
        """Return status and result of a goal."""
        assert goal.accepted
        future = goal.get_result_async()
        self.until(future.done, "the result")
        return future.result().status, future.result().result

    def call(self, name: str, kind: Any = Trigger, **fields: Any) -> Any:
        """Call a service and return its answer."""
        client = self.graph.probe.create_client(kind, name)
        self.graph.wait(client.service_is_ready, name)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done, f"the answer of {name}")
        return future.result()

    def run(self, procedure: str = FAR, **fields: Any) -> Any:
        """Send a goal and return it once the needle moves."""
        goal, before = self.send(procedure, **fields), self.tail.copy()
        self.until(lambda: self.is_in(ProcedureState.STATE_RUNNING) and math.dist(before, self.tail) > 1e-4, "motion")
        return goal

    def rests(self) -> bool:
        """Return whether the needle does not move over some frames, once it is commanded to rest."""
        self.graph.wait(lambda: not self.commands or not self.is_commanded(), "a command to rest")
        self.moved = len(self.commands)
        before = self.tail.copy()
        for _ in range(5):
            self.show()
        return bool(np.array_equal(before, self.tail))

    def is_commanded(self) -> bool:
        """Return whether the last command moves the needle."""
        last = self.commands[-1].twist.linear
        return bool(last.x or last.y)

    def close(self) -> None:
        """Take the client of the action out of the graph."""
        with self.graph.between_callbacks():
            self.client.destroy()


@pytest.fixture
def make_bench(graph: Any) -> Iterator[Callable[..., Bench]]:
    """Make a bench; its client leaves the graph at the end of the test."""
    made: list[Bench] = []

    def make(*arguments: Any, **parameters: Any) -> Bench:
        made.append(Bench(graph, *arguments, **parameters))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


def test_a_procedure_is_executed_with_feedback_and_a_result(graph, make_bench):
    bench = make_bench()
    goal = bench.send(NEAR)
    status, result = bench.result(goal)
    assert (status, result.state, result.reason) == (GoalStatus.STATUS_SUCCEEDED, ProcedureState.STATE_DONE, "")
    assert result.goals_met == 1
    middle = bench.tail + 0.5 * NEEDLE.chord * bench.heading
    assert math.dist(middle, (0.002, 0.001)) < 5e-4
    assert any(each.status.state == ProcedureState.STATE_RUNNING for each in bench.feedback)
    assert len(bench.plans[0].poses) > 10
    assert not bench.is_commanded()


@pytest.mark.parametrize(
    ("procedure", "reason"),
    [
        ("goals: [{go_to: {position: [0.05, 0.0]}}]", "goals[0].go_to.position"),
        ("goals: [{wrap: {around: [}}]", "valid YAML"),
    ],
)
def test_what_cannot_be_executed_is_aborted_at_once_with_the_reason(graph, make_bench, procedure: str, reason: str):
    bench = make_bench()
    status, result = bench.result(bench.send(procedure))
    assert (status, result.state) == (GoalStatus.STATUS_ABORTED, ProcedureState.STATE_FAILED)
    assert reason in result.reason
    assert not bench.commands
    assert not bench.node._session.is_active


def test_a_cancel_brings_the_needle_to_rest_and_another_while_cancelling_does_no_harm(graph, make_bench):
    bench = make_bench()
    goal = bench.run()
    first, second = goal.cancel_goal_async(), goal.cancel_goal_async()
    bench.until(lambda: first.done() and second.done(), "the answers")
    status, result = bench.result(goal)
    assert (status, result.reason) == (GoalStatus.STATUS_CANCELED, "cancelled by the client of the action")
    assert bench.rests()
    late = goal.cancel_goal_async()
    bench.until(late.done, "the answer")
    assert not late.result().goals_canceling
    assert bench.result(bench.send(NEAR))[0] == GoalStatus.STATUS_SUCCEEDED


def test_any_command_of_the_operator_pauses_until_it_is_resumed(graph, make_bench):
    bench = make_bench()
    goal = bench.run()
    graph.publish(topics.OPERATOR_COMMAND, wire.twist_message(graph.now(), np.zeros(2)))
    bench.until(lambda: bench.is_in(ProcedureState.STATE_PAUSED, "an operator commands"), "the pause")
    assert not bench.state().resumes
    assert bench.rests()
    assert bench.call(Service.RESUME_PROCEDURE).success
    assert bench.result(goal)[0] == GoalStatus.STATUS_SUCCEEDED


def test_what_is_late_neither_begins_nor_goes_on_and_pauses_all_the_same(graph, make_bench):
    bench = make_bench(pose_timeout=5.0, thread_timeout=5.0)
    pressed = graph.now()
    pressed.sec -= 2
    status, result = bench.result(bench.send(FAR, stamp=pressed))
    assert status == GoalStatus.STATUS_ABORTED
    assert "execute_procedure: got a request 2." in result.reason
    assert not bench.commands
    goal = bench.run(stamp=graph.now())
    assert graph.call_late(Trigger, Service.PAUSE_PROCEDURE).success
    answer = graph.call_late(Trigger, Service.RESUME_PROCEDURE)
    assert not answer.success
    assert "procedure/resume: got a request 1." in answer.message
    assert bench.is_in(ProcedureState.STATE_PAUSED)
    assert bench.rests()
    assert bench.call(Service.RESUME_PROCEDURE).success
    assert bench.result(goal)[0] == GoalStatus.STATUS_SUCCEEDED


def disturbed(calm: bool) -> EstimatedThread:
    found = [] if calm else [ThreadDisturbance(arc_length=0.01, force=2e-4, direction=Vector3(x=1.0))]
    return EstimatedThread(positions=THREAD, disturbances=found)


def unmeasured(measured: bool) -> EstimatedThread:
    return EstimatedThread(positions=THREAD, unmeasured_for=0.0 if measured else 1.5)


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        (disturbed, "an unmodelled contact: the thread is held at 10 mm of the thread: 0.2 mN to the right"),
        (unmeasured, "the thread has not been measured for 1.5 s"),
        (None, "the thread is not known: the residual is too large"),
    ],
)
def test_what_is_not_known_pauses_and_it_goes_on_by_itself_once_it_is(graph, make_bench, report: Any, reason: str):
    bench = make_bench()
    goal = bench.run()
    for known in (False, True):
        if report is None:
            bench.margins = SafetyMargins(valid=known, slowdown=1.0, reason="the residual is too large")
        else:
            graph.publish(topics.ESTIMATED_THREAD, report(known))
        if not known:
            bench.until(lambda: bench.is_in(ProcedureState.STATE_PAUSED, reason), "the pause")
            assert bench.state().resumes
            assert bench.rests()
    assert bench.result(goal)[0] == GoalStatus.STATUS_SUCCEEDED


SILENT = "no needle pose for more than 1 s"


@pytest.mark.parametrize(
    ("without", "reason"),
    [("silent", SILENT), ("late", SILENT), ("lost", "the needle is not tracked: two needles")],
)
def test_without_poses_it_pauses(graph, make_bench, without: str, reason: str):
    """Late ones are as none: their commands would be stamped as of now."""
    bench = make_bench()
    goal, ahead = bench.run(), bench.begin
    if without == "lost":
        graph.publish(topics.TRACKER_STATE, TrackerState(state=TrackerState.STATE_LOST, reason="two needles"))
    if without == "late":
        bench.begin = int(time.time()) - 3600
        bench.until(lambda: bench.is_in(ProcedureState.STATE_PAUSED, reason), "the pause")
    graph.wait(lambda: bench.is_in(ProcedureState.STATE_PAUSED, reason), "the pause")
    assert not bench.commands[-1].twist.linear.x
    bench.begin = ahead
    bench.until(lambda: bench.is_in(ProcedureState.STATE_RUNNING), "the needle to be known again")
    assert bench.result(goal)[0] == GoalStatus.STATUS_SUCCEEDED


def test_after_a_long_time_without_poses_it_waits_for_a_person(graph, make_bench):
    bench = make_bench()
    bench.run()
    graph.wait(lambda: bench.is_in(ProcedureState.STATE_PAUSED, "was not seen for more than 3 s"), "the pause")
    assert not bench.state().resumes
    refusal = graph.call(Trigger, Service.RESUME_PROCEDURE)
    assert refusal.message == "resume: got the needle was not seen for more than 3 s, expected a needle that is tracked"
    assert bench.rests()  # the needle is known again
    assert bench.is_in(ProcedureState.STATE_PAUSED, "was not seen for more than 3 s: look, then resume")
    assert bench.call(Service.RESUME_PROCEDURE).success
    bench.until(lambda: bench.is_in(ProcedureState.STATE_RUNNING), "it to go on")


def test_a_bridge_that_is_disarmed_pauses_until_it_is_resumed(graph, make_bench):
    bench = make_bench()
    bench.run()
    graph.publish(topics.BRIDGE_STATE, CoilBridgeState(armed=False))
    bench.until(lambda: bench.is_in(ProcedureState.STATE_PAUSED, "the coil bridge is not armed"), "the pause")
    assert "not armed" in bench.call(Service.RESUME_PROCEDURE).message
    graph.publish(topics.BRIDGE_STATE, CoilBridgeState(armed=True))
    graph.wait(lambda: bench.node._session._armed, "the bridge to be armed")
    assert bench.rests()
    assert bench.call(Service.RESUME_PROCEDURE).success
    bench.until(lambda: bench.is_in(ProcedureState.STATE_RUNNING), "it to go on")


def test_a_page_has_to_be_held_where_that_is_asked_for(graph, make_bench):
    bench = make_bench(hold_timeout=0.3, pose_timeout=5.0, thread_timeout=5.0)
    hold = graph.probe.create_publisher(topics.PROCEDURE_HOLD.message, topics.PROCEDURE_HOLD.name, 1)
    goal = bench.send(f"{{limits: {{speed: 0.0005}}, {FAR}}}", hold_to_run=True)
    bench.until(lambda: bench.is_in(ProcedureState.STATE_PAUSED, "nobody holds the page"), "the pause")
    old = wire.header(graph.now())
    old.stamp.sec -= 10
    hold.publish(old)
    assert bench.rests()

    def held() -> None:
        hold.publish(wire.header(graph.now()))

    def runs() -> bool:
        held()
        return bench.is_in(ProcedureState.STATE_RUNNING)

    bench.until(runs, "the needle to go on")
    graph.wait(lambda: bench.is_in(ProcedureState.STATE_PAUSED, "nobody holds the page"), "the pause")
    assert bench.rests()

    def ends() -> bool:
        held()
        return bench.is_in(ProcedureState.STATE_DONE)

    bench.until(ends, "the end")
    assert bench.result(goal)[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_second_node_that_commands_pauses_and_nothing_is_begun(graph, make_bench):
    bench = make_bench()
    bench.run()
    other = graph.probe.create_publisher(topics.NEEDLE_COMMAND.message, topics.NEEDLE_COMMAND.name, 1)
    bench.until(lambda: bench.is_in(ProcedureState.STATE_PAUSED, "2 nodes publish needle/servo_cv"), "the pause")
    assert bench.call(Service.ABORT_PROCEDURE).success
    _, result = bench.result(bench.send(NEAR))
    assert "2 nodes publish needle/servo_cv" in result.reason
    graph.probe.destroy_publisher(other)
