"""The lifecycle of the nodes that hold no boards: what each does in its states, and how it comes back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import Transition
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import ProcedureState
from magnetosuture_msgs.srv import PlanProcedure
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.nodes.node import INACTIVE
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.thread_model import ThreadForecasts, ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.settings.interface import STANDBY_NODES, Service
from test.nodes import wire
from test.nodes.conftest import Graph
from test.nodes.makers import EVERY_NODE
from test.nodes.test_needle_planner import FAR, Bench

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
HANDLERS: dict[str, Any] = {  # classes of which methods take messages and timers
    "vision_tracker": [VisionTrackerNode],
    "thread_model": [ThreadModelNode, ThreadForecasts],
    "needle_planner": [NeedlePlannerNode],
    "path_follower": [PathFollowerNode],
}
IN_EVERY_STATE = ("on_scene", "on_material", "on_camera_info", "on_bridge", "on_plan")  # published only when it changes
BEGIN = int(time.time()) + 3600  # s; late poses are refused, however slowly a test runs


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


def entities(node: Any) -> list[str]:
    """Return the names of all that a node has in the graph."""
    topic_names = [each.topic_name for each in (*node.publishers, *node.subscriptions)]
    return sorted([*topic_names, *(each.srv_name for each in node.services), *["timer" for _ in node.timers]])


@pytest.mark.parametrize(
    ("name", "others"), [*((name, {}) for name in HANDLERS), ("vision_tracker", {"image_transport": "raw"})]
)
def test_an_inactive_node_handles_no_message_and_no_timer(
    graph: Graph, name: str, others: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    make, parameters = NODES[name]
    handled: list[str] = []

    def noted(handler: str) -> Callable[..., None]:
        return lambda *_: handled.append(handler)

    for owner in HANDLERS[name]:
        for handler in [each for each in vars(owner) if each.startswith("on_") and each not in IN_EVERY_STATE]:
            monkeypatch.setattr(owner, handler, noted(handler))
    node = graph.add(make, autostart="inactive", **{**parameters, **others})
    subscriptions = [each for each in node._held if isinstance(each, Subscription)]
    timers = [each for each in node._held if isinstance(each, Timer)]

    def call() -> list[str]:
        with graph.between_callbacks():
            handled.clear()
            for subscription in subscriptions:
                subscription.callback(serialize_message(subscription.msg_type()))
            for timer in timers:
                timer.callback()
            return sorted(handled)

    assert call() == []
    assert graph.change(name, ACTIVATE)
    latched = {f"/{topics.BRIDGE_STATE.name}", f"/{topics.PROCEDURE_PLAN.name}"}
    in_every_state = sum(each.topic_name in latched for each in subscriptions)
    assert len(call()) == len(subscriptions) + len(timers) - in_every_state > 0


def broken() -> None:
    """Fail as nobody expects it."""
    raise RuntimeError("nobody foresaw this")


def test_a_deactivation_that_fails_gives_everything_back(graph: Graph, monkeypatch: pytest.MonkeyPatch):
    name = "needle_planner"
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    node = graph.add(make, autostart="unconfigured", **parameters)
    before = entities(node)
    assert graph.change(name, CONFIGURE, ACTIVATE)
    graph.wait(lambda: state_of(reports).startswith(ACTIVE[name]), "the report")
    monkeypatch.setattr(node, "deactivate", broken)
    assert not graph.change(name, DEACTIVATE)
    assert graph.stage(name) == "unconfigured"
    assert entities(node) == before
    assert "nobody foresaw this" in str(node.problem)
    graph.wait(lambda: state_of(reports) == "unconfigured", "the report")
    monkeypatch.undo()
    assert node.set_parameters([Parameter("scene", value="dish_50mm")])[0].successful
    assert graph.change(name, CONFIGURE, ACTIVATE)


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
        stamp = Time(sec=BEGIN + int(second), nanosec=round((second % 1.0) * 1e9))
        graph.publish(topics.NEEDLE_POSE, wire.pose_message(stamp, np.zeros(2), np.array([1.0, 0.0])))

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
