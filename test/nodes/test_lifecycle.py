"""The lifecycle of the nodes that hold no boards: what each does and says in its states, and how it comes back."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import ProcedureState
from magnetosuture_msgs.srv import PlanProcedure
from std_srvs.srv import Trigger

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import INACTIVE, Health
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.interface import STANDBY_NODES, Service
from test.nodes import wire
from test.nodes.conftest import Graph
from test.nodes.makers import EVERY_NODE
from test.nodes.test_needle_planner import FAR, Bench
from test.nodes.test_path_follower import pose

CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE
NODES = {name: EVERY_NODE[name] for name in STANDBY_NODES}
ACTIVE = {  # how the first report of each begins while it is active
    "vision_tracker": "no camera frame yet",
    "thread_model": "no needle pose yet",
    "needle_planner": "no procedure",
    "path_follower": "no needle pose yet",
    "scene_server": "scene ",
}


def state_of(reports: list[Any]) -> str:
    """Return what a node said of itself last on /diagnostics."""
    return str(reports[-1].status[0].message) if reports else ""


def values_of(reports: list[Any]) -> dict[str, str]:
    """Return the values that a node reported last on /diagnostics."""
    return {each.key: each.value for each in reports[-1].status[0].values} if reports else {}


@pytest.mark.parametrize("name", NODES)
def test_it_goes_as_far_as_autostart_says_through_its_states_twice_and_ends(graph: Graph, name: str):
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    node = graph.add(make, autostart="unconfigured", **parameters)
    before = entities(node)
    graph.wait(lambda: state_of(reports) == "unconfigured", "the report")
    for _ in range(2):
        assert graph.stage(name) == "unconfigured"
        assert graph.change(name, CONFIGURE, CONFIGURE)  # again, as a lifecycle manager does
        assert graph.stage(name) == "inactive"
        graph.wait(lambda: state_of(reports) == INACTIVE, "the report")
        assert graph.change(name, ACTIVATE)
        assert graph.stage(name) == "active"
        graph.wait(lambda: state_of(reports).startswith(ACTIVE[name]), "another report")
        assert graph.change(name, DEACTIVATE)
        graph.wait(lambda: state_of(reports) == INACTIVE, "the report")
        assert graph.change(name, ACTIVATE, DEACTIVATE, CLEANUP)
        graph.wait(lambda: state_of(reports) == "unconfigured", "the report")
        assert entities(node) == before
    graph.add(make, autostart="inactive", namespace="second", **parameters)
    assert graph.stage(f"second/{name}") == "inactive"
    third = graph.add(make, namespace="third", **parameters)
    assert graph.stage(f"third/{name}") == "active"
    assert not third.has_ended
    assert graph.change(f"third/{name}", Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert third.has_ended
    graph.wait(lambda: state_of(reports) == "finalized", "the report")
    with graph.between_callbacks():
        third.finish()  # as its process does then


def test_an_inactive_model_predicts_nothing(graph: Graph):
    graph.add(ThreadModelNode, autostart="inactive", initial_shape="straight")
    predicted = graph.listen(topics.PREDICTED_THREAD)
    for second in (1, 2):
        message = wire.pose_message(Time(sec=second), np.zeros(2), np.array([1.0, 0.0]))
        graph.publish(topics.NEEDLE_POSE, message)
        assert second == 2 or graph.change("thread_model", ACTIVATE)
    graph.wait(lambda: bool(predicted), "a prediction")
    assert [each.header.stamp.sec for each in predicted] == [2]


def entities(node: Any) -> list[str]:
    """Return the names of all that a node has in the graph."""
    topic_names = [each.topic_name for each in (*node.publishers, *node.subscriptions)]
    return sorted([*topic_names, *(each.srv_name for each in node.services), *["timer" for _ in node.timers]])


@pytest.fixture
def bench(graph: Graph) -> Iterator[Bench]:
    """A planner with an ideal needle; the client leaves the graph at the end of the test."""
    made = Bench(graph)
    yield made
    made.close()


def test_a_procedure_is_given_up_when_its_planner_is_deactivated(graph: Graph, bench: Bench):
    running = bench.send(FAR)
    bench.until(lambda: any(c.twist.linear.x for c in bench.commands), "a motion")
    assert graph.change("needle_planner", DEACTIVATE)
    graph.wait(lambda: bench.is_in(ProcedureState.STATE_FAILED, "the needle planner was deactivated"), "the end")
    graph.wait(lambda: not bench.commands[-1].twist.linear.x, "the needle to be stopped")
    ended = running.get_result_async()
    graph.wait(ended.done, "the result")
    assert ended.result().result.reason == "the needle planner was deactivated"
    for refused in (
        graph.call(PlanProcedure, Service.PLAN_PROCEDURE, procedure=FAR),
        graph.call(Trigger, Service.PAUSE_PROCEDURE),
    ):
        assert not refused.success
        assert refused.message == "needle_planner is inactive; activate it first"
    count = len(bench.commands)
    goal = bench.client.send_goal_async(ExecuteProcedure.Goal(procedure=FAR))
    graph.wait(goal.done, "the goal's answer")
    result = goal.result().get_result_async()
    graph.wait(result.done, "the result")
    assert result.result().result.reason == "needle_planner is inactive; activate it first"
    assert len(bench.commands) == count
    published = len(bench.states)
    assert graph.change("needle_planner", ACTIVATE)
    graph.wait(lambda: len(bench.states) > published, "how it ended, once more")
    assert len(bench.commands) == count  # it has stopped the needle once
    assert bench.send(FAR).accepted
    bench.until(lambda: bench.is_in(ProcedureState.STATE_RUNNING), "another procedure")


def test_the_path_follower_stops_the_needle_and_goes_on_where_it_was(graph: Graph):
    node = graph.add(PathFollowerNode, settle=0.0, waypoints=[0.02, 0.0])
    reports = graph.listen(topics.DIAGNOSTICS)
    commands, setpoints = graph.listen(topics.NEEDLE_COMMAND), graph.listen(topics.TIP_SETPOINT)

    def show(second: float) -> None:
        graph.publish(topics.NEEDLE_POSE, pose(second, 0.0))

    def answered(index: int) -> bool:
        return len(commands) > index

    for index in range(20):
        show(index / 60)
        graph.wait(partial(answered, index), "the answer")
    reached = setpoints[-1].pose.position.x
    assert commands[-1].twist.linear.x > 0.0
    assert graph.change("path_follower", DEACTIVATE)
    graph.wait(lambda: commands[-1].twist.linear.x == 0.0, "the needle to be stopped")
    # A planner could command now.
    graph.wait(lambda: graph.probe.count_publishers(topics.NEEDLE_COMMAND.name) == 0, "the topic to be free")
    assert graph.change("path_follower", ACTIVATE)
    graph.wait(lambda: values_of(reports).get("progress", "0.0") != "0.0", "the report")
    graph.wait(lambda: graph.matched(topics.NEEDLE_COMMAND), "the commands")
    graph.wait(lambda: node._commands.get_subscription_count() == 1, "who takes them")
    show(2.0)
    graph.wait(lambda: commands[-1].twist.linear.x > 0.0, "the motion to go on")
    assert reached <= setpoints[-1].pose.position.x < reached + 1e-3
    assert graph.change("path_follower", DEACTIVATE, CLEANUP, CONFIGURE)
    graph.wait(lambda: values_of(reports)["progress"] == "0.0", "the path from its beginning")


def test_a_flood_of_refusals_is_counted_and_not_repeated(graph):
    said = graph.listen_later(topics.DIAGNOSTICS)
    health = Health(graph.probe)
    graph.wait(lambda: graph.matched(topics.DIAGNOSTICS), "the match")
    for index in range(1000):
        health.refuse(InvalidInputError("field", index, "something else"))
    graph.wait(
        lambda: any({v.key: v.value for v in d.status[0].values}["refused"] == "1000" for d in said), "the count"
    )
    assert len(said) < 20
    assert said[-1].status[0].level == DiagnosticStatus.WARN
    assert said[-1].status[0].hardware_id == (graph.probe.get_namespace().strip("/") or "magnetosuture")
