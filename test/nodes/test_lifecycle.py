"""The lifecycle of the nodes that hold no boards: what each does in its states, and how it comes back."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from threading import Event
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import ProcedureState
from magnetosuture_msgs.srv import EditShape, ForecastPath, LoadScene, PlanProcedure
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import CompressedImage
from std_srvs.srv import Trigger

from benchmarks.vision.measurements import frame_of
from magnetosuture_thread import Disc, Forecast, ThreadForecaster
from magnetosuture_thread.configuration import configuration_fields
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.interface import (
    ADD_SHAPE,
    FORECAST_PATH,
    LOAD_SCENE,
    PAUSE_PROCEDURE,
    PLAN_PROCEDURE,
    SCENE_SERVER,
)
from magnetosuture_thread.model.session import WAITING
from magnetosuture_thread.nodes import needle_planner, path_follower, scene_server, thread_model, topics, vision_tracker
from magnetosuture_thread.nodes.lifecycle import INACTIVE
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.needle_planner import NeedlePlannerNode
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from magnetosuture_thread.nodes.perception import perception
from magnetosuture_thread.nodes.procedure_inputs import ProcedureInputs
from magnetosuture_thread.nodes.scene_server import SceneServerNode
from magnetosuture_thread.nodes.thread_forecast import ThreadForecasts
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.topics import Topic
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.scene import Scene, SceneShape, read_scene
from test.nodes.conftest import Graph
from test.nodes.scenes import scene_told
from test.nodes.test_needle_planner import FAR, OPEN, Bench
from test.nodes.test_thread_estimate import counting
from test.nodes.test_thread_estimate import stamp as frame_stamp
from test.nodes.test_thread_model import pose, seen
from test.nodes.test_vision_tracker import camera_info, compressed, frame

CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE
NODES: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "vision_tracker": (VisionTrackerNode, {"scene": "dish_35mm"}),
    "thread_model": (ThreadModelNode, {"scene": "dish_35mm", "forecast_horizon": 1.0}),
    "needle_planner": (NeedlePlannerNode, {"scene": "dish_35mm"}),
    "path_follower": (PathFollowerNode, {"scene": "dish_35mm", "waypoints": [0.01, 0.0]}),
    "scene_server": (SceneServerNode, {"scene": "dish_35mm"}),
}
LOADED = {  # where each loads its kernels, or its file
    "vision_tracker": [(vision_tracker, "warm_up")],
    "thread_model": [(thread_model, "ThreadSession"), (thread_model, "ThreadForecasts")],
    "needle_planner": [(needle_planner, "compile_planning")],
    "path_follower": [(path_follower, "prepare_paths")],
    "scene_server": [(scene_server, "initial_scene")],
}
PUBLISHED = {
    "vision_tracker": "/needle/measured_cp",
    "thread_model": "/thread/predicted",
    "needle_planner": "/procedure/state",
    "path_follower": "/needle/servo_cv",
    "scene_server": "/scene",
}
ACTIVE = {  # how the first report of each begins while it is active
    "vision_tracker": "no camera frame yet",
    "thread_model": "no needle pose yet",
    "needle_planner": "no procedure",
    "path_follower": "no needle pose yet",
    "scene_server": "scene ",
}
HANDLERS: dict[str, list[Any]] = {  # classes of which methods take messages and timers
    "vision_tracker": [VisionTrackerNode],
    "thread_model": [ThreadModelNode, ThreadForecasts],
    "needle_planner": [NeedlePlannerNode, ProcedureInputs],
    "path_follower": [PathFollowerNode],
}
IN_EVERY_STATE = ("on_scene", "on_material", "on_camera_info", "on_bridge")  # published only when it changes
SCENES: dict[str, Callable[[Any], str]] = {  # version of the scene by which each works
    "vision_tracker": lambda node: str(node._session._tracker._scene.version),
    "thread_model": lambda node: str(node._session.scene_version),
    "needle_planner": lambda node: str(node._session.known.scene_version),
}
BEGIN = int(time.time()) + 3600  # s; late poses are refused, however slowly a test runs


def called(graph: Graph, kind: Any, name: str, request: Any) -> Any:
    """Return the answer of a service."""
    client = graph.probe.create_client(kind, name)
    graph.wait(client.service_is_ready, name)
    future = client.call_async(request)
    graph.wait(future.done, f"the answer of {name}")
    graph.probe.destroy_client(client)
    return future.result()


def change(graph: Graph, name: str, *transitions: int) -> None:
    """Make transitions of a node, as `ros2 lifecycle set` does."""
    for transition in transitions:
        request = ChangeState.Request(transition=Transition(id=transition))
        assert called(graph, ChangeState, f"{name}/change_state", request).success


def stage(graph: Graph, name: str) -> str:
    """Return the name of a node's state, as `ros2 lifecycle get` does."""
    return str(called(graph, GetState, f"{name}/get_state", GetState.Request()).current_state.label)


def state_of(reports: list[Any]) -> str:
    """Return what a node said of itself last on /diagnostics."""
    return str(reports[-1].status[0].message) if reports else ""


def values_of(reports: list[Any]) -> dict[str, str]:
    """Return the values that a node reported last on /diagnostics."""
    return {each.key: each.value for each in reports[-1].status[0].values} if reports else {}


def are_more_than(count: int, messages: list[Any]) -> Callable[[], bool]:
    """Return a condition: there are more messages than a count."""
    return lambda: len(messages) > count


def is_shown(second: int, states: list[Any]) -> Callable[[], bool]:
    """Return a condition: a tracker has published its state at a second."""
    return lambda: any(each.header.stamp.sec == second for each in states)


def show_frames(graph: Graph, states: list[Any], image: np.ndarray, *seconds: int) -> None:
    """Show an image to a tracker at some seconds, each once the one before has been looked at: few may wait."""
    for second in seconds:
        graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=second)))
        graph.wait(is_shown(second, states), "its state")


def show_unused(graph: Graph, node: Any, topic: Topic, message: Any) -> None:
    """Publish a message, and return when the node has had it and let it pass; by then an answer would be sent."""
    taken: list[Any] = []
    (subscription,) = (each for each in node.subscriptions if each.topic_name == f"/{topic.name}")
    callback = subscription.callback

    def take(*arguments: Any) -> None:
        callback(*arguments)
        taken.append(arguments)

    subscription.callback = take
    graph.publish(topic, message)
    graph.wait(lambda: bool(taken), "the message at the node")
    subscription.callback = callback


@pytest.mark.parametrize("name", NODES)
def test_it_goes_as_far_as_autostart_says_and_through_its_states_twice(graph: Graph, name: str):
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    node = graph.add(make, autostart="unconfigured", **parameters)
    before = entities(node)
    graph.wait(lambda: state_of(reports) == "unconfigured", "the report")
    for _ in range(2):
        assert stage(graph, name) == "unconfigured"
        change(graph, name, CONFIGURE)
        assert stage(graph, name) == "inactive"
        graph.wait(lambda: state_of(reports) == INACTIVE, "the report")
        change(graph, name, ACTIVATE)
        assert stage(graph, name) == "active"
        graph.wait(lambda: state_of(reports).startswith(ACTIVE[name]), "another report")
        change(graph, name, DEACTIVATE)
        graph.wait(lambda: state_of(reports) == INACTIVE, "the report")
        change(graph, name, ACTIVATE, DEACTIVATE, CLEANUP)
        graph.wait(lambda: state_of(reports) == "unconfigured", "the report")
        assert entities(node) == before
    graph.add(make, autostart="inactive", namespace="second", **parameters)
    assert stage(graph, f"second/{name}") == "inactive"
    graph.add(make, namespace="third", **parameters)
    assert stage(graph, f"third/{name}") == "active"


def entities(node: Any) -> list[str]:
    """Return the names of all that a node has in the graph."""
    topic_names = [each.topic_name for each in (*node.publishers, *node.subscriptions)]
    return sorted([*topic_names, *(each.srv_name for each in node.services), *["timer" for _ in node.timers]])


@pytest.mark.parametrize("name", NODES)
def test_a_start_that_goes_on_to_active_never_reports_that_it_is_inactive(graph: Graph, name: str):
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    graph.add(make, **parameters)
    graph.wait(lambda: bool(reports), "a report")
    change(graph, name, DEACTIVATE)
    graph.wait(lambda: state_of(reports) == INACTIVE, "the report")
    assert [each.status[0].message for each in reports].count(INACTIVE) == 1


@pytest.mark.parametrize("name", NODES)
def test_whatever_is_refused_an_inactive_node_reports_that_it_is_inactive(graph: Graph, name: str):
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    node = graph.add(make, autostart="inactive", **parameters)
    graph.wait(lambda: state_of(reports) == INACTIVE, "the report")
    with graph.between_callbacks():
        node.refuse(ConfigurationError("anything", 1, "another thing"))
        node.health.publish()
    graph.wait(lambda: values_of(reports)["last refusal"] != "none", "the refusal")
    assert state_of(reports) == INACTIVE


@pytest.mark.parametrize("name", NODES)
def test_its_scene_can_be_set_before_it_is_configured_and_not_after(
    graph: Graph, name: str, capfd: pytest.CaptureFixture[str]
):
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    node = graph.add(make, autostart="unconfigured", **{**parameters, "scene": "elsewhere"})
    request = ChangeState.Request(transition=Transition(id=CONFIGURE))
    assert not called(graph, ChangeState, f"{name}/change_state", request).success
    assert isinstance(node.problem, ConfigurationError)
    graph.wait(lambda: "unconfigured: scene: got 'elsewhere'" in state_of(reports), "the reason")
    assert "scene: got 'elsewhere'" in capfd.readouterr().err
    assert node.set_parameters([Parameter("scene", value="dish_35mm_post")])[0].successful
    change(graph, name, CONFIGURE)
    refused = node.set_parameters([Parameter("scene", value="dish_50mm")])[0]
    assert refused.reason == f"{name}.scene: got 'dish_50mm', expected its value in force, until the node is cleaned up"
    change(graph, name, CLEANUP)
    assert node.set_parameters([Parameter("scene", value="dish_50mm")])[0].successful
    change(graph, name, CONFIGURE, ACTIVATE)


@pytest.mark.parametrize("name", NODES)
def test_a_node_that_is_shut_down_ends(graph: Graph, name: str):
    make, parameters = NODES[name]
    node = graph.add(make, **parameters)
    reports = graph.listen_later(topics.DIAGNOSTICS)
    assert not node.has_ended
    change(graph, name, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert node.has_ended
    graph.wait(lambda: state_of(reports) == "finalized", "the report")
    with graph.between_callbacks():
        node.finish()  # as its process does then


@pytest.mark.parametrize("name", NODES)
def test_with_an_invalid_parameter_all_others_can_be_set_before_it_is_configured(
    graph: Graph, name: str, capfd: pytest.CaptureFixture[str]
):
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    node = graph.add(make, autostart="unconfigured", **{**parameters, "scene": 3.0})
    reason = f"{name}.scene: got 3.0, expected text"
    assert reason in capfd.readouterr().err
    graph.wait(lambda: state_of(reports).startswith(f"unconfigured: {reason}"), "the reason")
    names = {about.name for about in configuration_fields(node._class)}
    assert {each for each in names if not node.has_parameter(each)} == set()
    assert node.set_parameters([Parameter("scene", value="dish_35mm")])[0].successful
    change(graph, name, CONFIGURE)


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
    change(graph, name, ACTIVATE)
    in_every_state = sum(each.topic_name == f"/{topics.BRIDGE_STATE.name}" for each in subscriptions)
    assert len(call()) == len(subscriptions) + len(timers) - in_every_state > 0


def failing(graph: Graph, name: str, transition: int) -> None:
    """Ask for a transition that fails."""
    request = ChangeState.Request(transition=Transition(id=transition))
    assert not called(graph, ChangeState, f"{name}/change_state", request).success


def broken() -> None:
    """Fail as nobody expects it."""
    raise RuntimeError("nobody foresaw this")


def test_an_activation_that_fails_leaves_the_node_inactive(graph: Graph, monkeypatch: pytest.MonkeyPatch):
    node = graph.add(SceneServerNode, scene="dish_35mm", autostart="inactive")
    reports = graph.listen(topics.DIAGNOSTICS)
    monkeypatch.setattr(node, "activate", broken)
    failing(graph, SCENE_SERVER, ACTIVATE)
    assert stage(graph, SCENE_SERVER) == "inactive"
    refused = called(graph, LoadScene, LOAD_SCENE, LoadScene.Request(file="dish_50mm"))
    assert refused.message == "scene_server is inactive; activate it first"
    with graph.between_callbacks():
        node.health.note(asked="now")
        node.health.publish()
    graph.wait(lambda: values_of(reports).get("asked") == "now", "another report")
    assert state_of(reports) == INACTIVE
    monkeypatch.undo()
    change(graph, SCENE_SERVER, ACTIVATE)


@pytest.mark.parametrize("name", NODES)
def test_a_deactivation_that_fails_gives_everything_back(graph: Graph, name: str, monkeypatch: pytest.MonkeyPatch):
    make, parameters = NODES[name]
    reports = graph.listen_later(topics.DIAGNOSTICS)
    node = graph.add(make, autostart="unconfigured", **parameters)
    before = entities(node)
    change(graph, name, CONFIGURE, ACTIVATE)
    graph.wait(lambda: state_of(reports).startswith(ACTIVE[name]), "the report")
    monkeypatch.setattr(node, "deactivate", broken)
    failing(graph, name, DEACTIVATE)
    assert stage(graph, name) == "unconfigured"
    assert entities(node) == before
    assert "nobody foresaw this" in str(node.problem)
    graph.wait(lambda: state_of(reports) == "unconfigured", "the report")
    monkeypatch.undo()
    assert node.set_parameters([Parameter("scene", value="dish_50mm")])[0].successful
    change(graph, name, CONFIGURE, ACTIVATE)


def place(graph: Graph, node: Any, scene: Scene) -> None:
    """Publish a scene, and wait until a node has taken it or left it."""
    graph.publish(topics.SCENE, scene_told(scene))
    graph.wait(lambda: node._scene._heard == scene, "the scene")
    with graph.between_callbacks():
        pass


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_that_comes_before_a_node_is_configured_or_active_counts(
    graph: Graph, name: str, capfd: pytest.CaptureFixture[str]
):
    make, parameters = NODES[name]
    node = graph.add(make, autostart="unconfigured", **parameters)
    first, second = read_scene("dish_50mm"), read_scene("dish_35mm_post")
    place(graph, node, first)
    change(graph, name, CONFIGURE)
    assert SCENES[name](node) == first.version
    assert f"scene {first.version} of the topic, and not that of the parameter" in capfd.readouterr().err
    place(graph, node, second)
    assert SCENES[name](node) == second.version
    change(graph, name, ACTIVATE)
    assert SCENES[name](node) == second.version


def test_a_tracker_that_was_configured_without_a_scene_takes_one_while_inactive(graph: Graph):
    node = graph.add(VisionTrackerNode, autostart="inactive")
    scene = read_scene("dish_50mm")
    place(graph, node, scene)
    assert SCENES["vision_tracker"](node) == scene.version


@pytest.mark.parametrize("name", NODES)
def test_it_is_found_in_the_graph_when_everything_is_loaded(graph: Graph, name: str, monkeypatch: pytest.MonkeyPatch):
    """Who waits for its topics, as a replay does, would play into a node that still compiles."""
    make, parameters = NODES[name]
    found: list[set[str]] = []

    def load(function: Callable[..., Any]) -> Callable[..., Any]:
        def loaded(*arguments: Any, **options: Any) -> Any:
            names = dict(graph.probe.get_publisher_names_and_types_by_node(name, "/"))
            found.append(set(names))
            return function(*arguments, **options)

        return loaded

    for module, kernels in LOADED[name]:
        monkeypatch.setattr(module, kernels, load(getattr(module, kernels)))
    graph.add(make, **parameters)
    assert found
    every = {"/rosout", "/parameter_events", "/diagnostics", f"/{name}/transition_event"}
    assert set().union(*found) <= every
    graph.wait(lambda: PUBLISHED[name] in dict(graph.probe.get_publisher_names_and_types_by_node(name, "/")), "it")


def overrides(**values: Any) -> list[Parameter]:
    """Return parameters to start a node with."""
    return [Parameter(name, value=value) for name, value in values.items()]


def test_an_inactive_tracker_uses_no_frame_and_finds_the_needle_again_once_active(
    graph: Graph, camera: Any, thread_arc: Any
):
    node = graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, states = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    image = frame(camera, thread_arc)
    graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=1)))
    graph.wait(lambda: len(poses) == 1, "a pose")
    change(graph, "vision_tracker", DEACTIVATE)
    before = len(states)
    show_unused(graph, node, topics.COMPRESSED_IMAGE, compressed(image, Time(sec=2)))
    assert node._session.frames == 0
    change(graph, "vision_tracker", ACTIVATE)
    graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=1)))  # an earlier frame than the last one
    graph.wait(lambda: len(poses) == 2, "a pose again")
    graph.wait(lambda: len(states) == before + 1, "its state alone")
    assert [each.header.stamp.sec for each in poses] == [1, 1]


def test_the_tracker_takes_the_camera_topic_that_it_is_configured_with(graph: Graph, camera: Any, thread_arc: Any):
    node = graph.add(VisionTrackerNode, scene="dish_35mm", image_transport="raw")
    image = topics.IMAGE.name
    assert node.count_subscribers(image) == 1
    change(graph, "vision_tracker", DEACTIVATE, CLEANUP)
    graph.wait(lambda: node.count_subscribers(image) == 0, "the camera to be left")
    assert node.set_parameters([Parameter("image_transport", value="compressed")])[0].successful
    change(graph, "vision_tracker", CONFIGURE, ACTIVATE)
    poses, states = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    show_frames(graph, states, frame(camera, thread_arc), 1, 2, 3)
    graph.wait(lambda: bool(poses), "a pose")


def test_a_lens_stays_in_force_while_the_tracker_is_inactive_and_configured_again(graph: Graph):
    case, image = frame_of("distortion", 2, 31)
    assert case.lens is not None
    node = graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    graph.publish(topics.CAMERA_INFO, camera_info(case.lens))
    graph.wait(lambda: node._lens is not None, "the lens")
    poses = graph.listen(topics.NEEDLE_POSE)
    for transitions in ((DEACTIVATE, ACTIVATE), (DEACTIVATE, CLEANUP, CONFIGURE, ACTIVATE)):
        change(graph, "vision_tracker", *transitions)
        graph.wait(lambda: node._poses.get_subscription_count() == 1, "who takes them")
        before = len(poses)
        graph.publish(topics.COMPRESSED_IMAGE, compressed(image, graph.now()))
        graph.wait(are_more_than(before, poses), "a pose")
        position = poses[-1].pose.pose.position
        assert np.hypot(*(np.array([position.x, position.y]) - case.needle.tail)) < 0.6 * 8e-5


def test_what_the_tracker_saw_before_it_was_inactive_is_not_in_its_reports(graph: Graph, camera: Any, thread_arc: Any):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    states, reports = graph.listen(topics.TRACKER_STATE), graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), graph.now()))
    graph.wait(lambda: state_of(reports) == "tracking", "the report")
    change(graph, "vision_tracker", DEACTIVATE, ACTIVATE)
    before = len(states)
    graph.publish(topics.COMPRESSED_IMAGE, CompressedImage(format="jpeg"))
    graph.wait(lambda: len(states) > before, "the refusal")
    graph.wait(lambda: state_of(reports).startswith("no camera frame for"), "the silence")
    assert state_of(reports).endswith("; before that nothing seen")


def test_a_model_that_was_inactive_starts_from_the_next_measured_thread(graph: Graph):
    node = graph.add(ThreadModelNode)
    predicted, margins = graph.listen(topics.PREDICTED_THREAD), graph.listen(topics.MARGINS)
    graph.publish(topics.MEASURED_THREAD, seen(1.0))
    graph.publish(topics.NEEDLE_POSE, pose(1.0))
    graph.wait(lambda: len(predicted) == 1, "the start")
    change(graph, "thread_model", DEACTIVATE)
    show_unused(graph, node, topics.NEEDLE_POSE, pose(1.1))
    change(graph, "thread_model", ACTIVATE)
    graph.publish(topics.NEEDLE_POSE, pose(1.2))
    graph.wait(lambda: margins[-1].header.stamp == pose(1.2).header.stamp, "margins")
    assert margins[-1].reason == WAITING
    assert pose(1.1).header.stamp not in [each.header.stamp for each in margins]
    assert len(predicted) == 1
    graph.publish(topics.MEASURED_THREAD, seen(1.3))
    graph.publish(topics.NEEDLE_POSE, pose(1.3))
    graph.wait(lambda: len(predicted) > 1, "the thread again")


def test_the_model_changes_with_its_parameters_in_every_state(graph: Graph):
    node = graph.add(ThreadModelNode, autostart="unconfigured", initial_shape="straight")
    assert node.set_parameters([Parameter("segments", value=20)])[0].successful
    change(graph, "thread_model", CONFIGURE)
    predicted = graph.listen(topics.PREDICTED_THREAD)
    assert node.set_parameters([Parameter("thread_length", value=0.02)])[0].successful
    change(graph, "thread_model", ACTIVATE)
    graph.publish(topics.NEEDLE_POSE, pose(1.0))
    graph.wait(lambda: len(predicted) == 1, "a prediction")
    assert len(predicted[-1].strain) == 20
    assert abs(predicted[-1].positions[-1].x + 0.02) < 1e-6
    change(graph, "thread_model", DEACTIVATE, CLEANUP)
    assert node.set_parameters([Parameter("formulation", value="paper")])[0].successful
    change(graph, "thread_model", CONFIGURE, ACTIVATE)
    graph.wait(lambda: graph.matched(topics.PREDICTED_THREAD), "the predictions")
    graph.publish(topics.NEEDLE_POSE, pose(2.0))
    graph.wait(lambda: predicted[-1].formulation == "paper", "the other formulation")
    assert len(predicted[-1].strain) == 20
    assert node.set_parameters([Parameter("segments", value=10)])[0].successful  # followed once, and not by two
    graph.publish(topics.NEEDLE_POSE, pose(2.1))
    graph.wait(lambda: len(predicted[-1].strain) == 10, "fewer segments")


def test_forecasts_are_offered_while_the_model_is_configured_with_them(graph: Graph):
    node = graph.add(ThreadModelNode, autostart="unconfigured", scene="dish_35mm", forecast_horizon=1.0)
    assert node.count_services(FORECAST_PATH) == 0
    change(graph, "thread_model", CONFIGURE)
    request = ForecastPath.Request(path=[Point(x=0.005)], speed=0.005, horizon=1.0)
    refused = called(graph, ForecastPath, FORECAST_PATH, request)
    assert not refused.success
    assert refused.message == "thread_model is inactive; activate it first"
    change(graph, "thread_model", ACTIVATE)
    assert "no estimate yet" in called(graph, ForecastPath, FORECAST_PATH, request).message
    change(graph, "thread_model", DEACTIVATE)
    change(graph, "thread_model", CLEANUP)
    graph.wait(lambda: node.count_services(FORECAST_PATH) == 0, "the service to be gone")


def test_nothing_is_forecast_from_before_the_model_was_inactive(graph: Graph, monkeypatch: pytest.MonkeyPatch):
    model = counting(monkeypatch, graph, scene="dish_150mm", forecast_horizon=0.6, forecast_step=0.03)
    forecasts, forecast, begun, go_on = graph.listen(topics.FORECAST), ThreadForecaster.forecast, Event(), Event()

    def slow(*arguments: Any, **options: Any) -> Forecast:
        begun.set()
        assert go_on.wait(60.0)
        return forecast(*arguments, **options)

    monkeypatch.setattr(ThreadForecaster, "forecast", slow)
    state = topics.FILTER_STATE.message(header=MESSAGES.header(frame_stamp(1)))
    state.commanded.x = state.filtered.x = 0.001
    graph.publish(topics.FILTER_STATE, state)
    graph.wait(lambda: model.node._forecasts._command is not None, "the command")
    model.show(0)
    assert begun.wait(60.0)
    change(graph, "thread_model", DEACTIVATE)
    go_on.set()
    change(graph, "thread_model", ACTIVATE)
    request = ForecastPath.Request(path=[Point(x=0.005)], speed=0.005, horizon=1.0)
    assert "no estimate yet" in called(graph, ForecastPath, FORECAST_PATH, request).message
    model.show(1)
    graph.wait(lambda: bool(forecasts), "a forecast")
    assert forecasts[0].header.stamp == frame_stamp(1)
    assert forecasts[0].commanded.x == 0.0


@pytest.fixture
def bench(graph: Graph) -> Iterator[Bench]:
    """A planner with an ideal needle; the client leaves the graph at the end of the test."""
    made = Bench(graph)
    yield made
    made.close()


def test_a_procedure_is_given_up_when_its_planner_is_deactivated(graph: Graph, bench: Bench):
    running = bench.send(FAR)
    bench.until(lambda: any(c.twist.linear.x for c in bench.commands), "a motion")
    change(graph, "needle_planner", DEACTIVATE)
    graph.wait(lambda: bench.is_in(ProcedureState.STATE_FAILED, "the needle planner was deactivated"), "the end")
    graph.wait(lambda: not bench.commands[-1].twist.linear.x, "the needle to be stopped")
    ended = running.get_result_async()
    graph.wait(ended.done, "the result")
    assert ended.result().result.reason == "the needle planner was deactivated"
    request = PlanProcedure.Request(procedure=FAR)
    for kind, name, asked in ((PlanProcedure, PLAN_PROCEDURE, request), (Trigger, PAUSE_PROCEDURE, Trigger.Request())):
        refused = called(graph, kind, name, asked)
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
    change(graph, "needle_planner", ACTIVATE)
    graph.wait(lambda: len(bench.states) > published, "how it ended, once more")
    assert len(bench.commands) == count  # it has stopped the needle once
    assert bench.send(FAR).accepted
    bench.until(lambda: bench.is_in(ProcedureState.STATE_RUNNING), "another procedure")


def test_a_planner_that_is_configured_again_has_the_scene_and_the_bridge_s_state(graph: Graph, bench: Bench):
    graph.publish(topics.BRIDGE_STATE, topics.BRIDGE_STATE.message(armed=False))
    graph.wait(lambda: not bench.node._session._armed, "the bridge's state")
    change(graph, "needle_planner", DEACTIVATE, CLEANUP)
    graph.publish(topics.SCENE, scene_told(OPEN))
    change(graph, "needle_planner", CONFIGURE, ACTIVATE)
    assert bench.node._session.known.scene_version == OPEN.version
    graph.wait(lambda: not bench.node._session._armed, "the bridge's state, which it publishes when it changes")


def test_another_scene_reaches_an_inactive_planner_and_it_stays_quiet(graph: Graph, bench: Bench):
    reports = graph.listen_later(topics.DIAGNOSTICS)
    change(graph, "needle_planner", DEACTIVATE)
    graph.wait(lambda: state_of(reports) == INACTIVE, "the report")
    count = len(bench.states)
    other = read_scene("dish_50mm")
    graph.publish(topics.SCENE, scene_told(other))
    graph.wait(lambda: bench.node._session.known.scene_version == other.version, "the scene")
    change(graph, "needle_planner", ACTIVATE)
    graph.wait(lambda: len(bench.states) == count + 1, "the state when it is active")


def test_a_scene_that_was_refused_is_that_of_the_next_configuration(graph: Graph):
    node = graph.add(NeedlePlannerNode, scene="dish_150mm", keep_out=0.02)
    small = read_scene("dish_35mm")
    reports = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.SCENE, scene_told(small))
    graph.wait(lambda: any("refused" in each.status[0].message for each in reports), "the refusal")
    assert node._scene.version == read_scene("dish_150mm").version
    change(graph, "needle_planner", DEACTIVATE, CLEANUP)
    assert node.set_parameters([Parameter("keep_out", value=1e-4)])[0].successful
    change(graph, "needle_planner", CONFIGURE)
    assert node._session.known.scene_version == small.version


def test_the_path_follower_stops_the_needle_and_goes_on_where_it_was(graph: Graph):
    node = graph.add(PathFollowerNode, settle=0.0, waypoints=[0.02, 0.0])
    reports = graph.listen(topics.DIAGNOSTICS)
    commands, setpoints = graph.listen(topics.NEEDLE_COMMAND), graph.listen(topics.TIP_SETPOINT)

    def show(second: float) -> None:
        stamp = Time(sec=BEGIN + int(second), nanosec=round((second % 1.0) * 1e9))
        graph.publish(topics.NEEDLE_POSE, MESSAGES.pose_message(stamp, np.zeros(2), np.array([1.0, 0.0])))

    for index in range(30):
        show(index / 60)
        graph.wait(are_more_than(index, commands), "the answer")
    reached = setpoints[-1].pose.position.x
    assert commands[-1].twist.linear.x > 0.0
    change(graph, "path_follower", DEACTIVATE)
    graph.wait(lambda: commands[-1].twist.linear.x == 0.0, "the needle to be stopped")
    message = MESSAGES.pose_message(Time(sec=BEGIN + 1), np.zeros(2), np.array([1.0, 0.0]))
    show_unused(graph, node, topics.NEEDLE_POSE, message)
    # A planner could command now.
    graph.wait(lambda: graph.probe.count_publishers(topics.NEEDLE_COMMAND.name) == 0, "the topic to be free")
    change(graph, "path_follower", ACTIVATE)
    graph.wait(lambda: state_of(reports) == "no needle pose yet", "the report")
    assert values_of(reports)["progress"] != "0.0"
    graph.wait(lambda: graph.matched(topics.NEEDLE_COMMAND), "the commands")
    graph.wait(lambda: node._commands.get_subscription_count() == 1, "who takes them")
    show(2.0)
    graph.wait(lambda: commands[-1].twist.linear.x > 0.0, "the motion to go on")
    assert reached <= setpoints[-1].pose.position.x < reached + 1e-3
    change(graph, "path_follower", DEACTIVATE, CLEANUP, CONFIGURE, ACTIVATE)
    graph.wait(lambda: values_of(reports)["progress"] == "0.0", "the report")
    graph.wait(lambda: graph.matched(topics.TIP_SETPOINT), "the setpoints")
    graph.wait(lambda: node._commands.get_subscription_count() == 1, "who takes them")
    graph.wait(lambda: node._setpoints.get_subscription_count() == 1, "who takes the setpoints")
    show(3.0)
    show(3.02)
    graph.wait(lambda: setpoints[-1].header.stamp.nanosec == 20_000_000, "the path from its beginning")
    assert setpoints[-1].pose.position.x < reached


def test_the_path_follower_checks_scenes_in_every_state(graph: Graph):
    node = graph.add(PathFollowerNode, autostart="unconfigured", settle=0.0, waypoints=[0.012, 0.0])
    commands, reports = graph.listen_later(topics.NEEDLE_COMMAND), graph.listen(topics.DIAGNOSTICS)
    blocked = Scene(OPEN.dish, (SceneShape("post", "wall", Disc((0.0123, 0.0), 0.001)),))
    reason = "waypoints: got [0.012, 0.0], expected a point outside of post"

    def show(second: float) -> None:
        graph.wait(lambda: node._commands.get_subscription_count() == 1, "who takes the commands")
        stamp = Time(sec=BEGIN, nanosec=round(1e9 * second))
        graph.publish(topics.NEEDLE_POSE, MESSAGES.pose_message(stamp, np.zeros(2), np.array([1.0, 0.0])))

    place(graph, node, blocked)
    failing(graph, "path_follower", CONFIGURE)
    assert reason in str(node.problem)
    place(graph, node, OPEN)
    change(graph, "path_follower", CONFIGURE)
    place(graph, node, blocked)
    change(graph, "path_follower", ACTIVATE)
    show(0.0)
    graph.wait(lambda: reason in state_of(reports), "the reason")
    assert commands == []
    change(graph, "path_follower", DEACTIVATE, CLEANUP)
    place(graph, node, OPEN)
    change(graph, "path_follower", CONFIGURE, ACTIVATE)
    show(0.02)
    graph.wait(lambda: state_of(reports) in ("settling", "following"), "the path to be followed")


def test_the_scene_server_publishes_and_changes_scenes_while_active(graph: Graph):
    graph.add(SceneServerNode, scene="dish_35mm", autostart="inactive")
    scenes = graph.listen(topics.SCENE)
    for kind, name in ((EditShape, ADD_SHAPE), (LoadScene, LOAD_SCENE)):
        refused = called(graph, kind, name, kind.Request())
        assert not refused.success
        assert refused.message == "scene_server is inactive; activate it first"
    assert scenes == []
    change(graph, SCENE_SERVER, ACTIVATE)
    graph.wait(lambda: len(scenes) == 1, "the scene")
    assert called(graph, LoadScene, LOAD_SCENE, LoadScene.Request(file="dish_35mm_post")).success
    graph.wait(lambda: len(scenes) == 2, "another scene")
    change(graph, SCENE_SERVER, DEACTIVATE, ACTIVATE)
    graph.wait(lambda: len(scenes) == 3, "the scene once more")
    assert scenes[2].version == scenes[1].version
    change(graph, SCENE_SERVER, DEACTIVATE, CLEANUP, CONFIGURE, ACTIVATE)
    graph.wait(lambda: len(scenes) == 4, "the scene of the parameter")
    assert scenes[3].version == scenes[0].version


def test_two_nodes_in_one_process_have_states_of_their_own(graph: Graph, camera: Any, thread_arc: Any):
    tracker, model = perception(context=graph.context, parameter_overrides=overrides(scene="dish_35mm"))
    for node in (tracker, model):
        graph.nodes.append(node)
        graph.executor.add_node(node)
    poses, margins = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.MARGINS)
    states, image = graph.listen(topics.TRACKER_STATE), frame(camera, thread_arc)
    change(graph, "thread_model", DEACTIVATE)
    show_frames(graph, states, image, 1, 2, 3)
    graph.wait(lambda: bool(poses), "poses")
    change(graph, "thread_model", ACTIVATE)
    show_frames(graph, states, image, 4, 5)
    graph.wait(lambda: bool(margins), "margins")
    assert margins[0].header.stamp.sec >= 4
    change(graph, "vision_tracker", DEACTIVATE)
    show_unused(graph, tracker, topics.COMPRESSED_IMAGE, compressed(image, Time(sec=6)))
    change(graph, "vision_tracker", ACTIVATE)
    show_frames(graph, states, image, 7, 8, 9)
    graph.wait(lambda: poses[-1].header.stamp.sec > 6, "poses again")
    assert 6 not in [each.header.stamp.sec for each in poses]


@pytest.mark.parametrize("far", ["unconfigured", "finalized"])
def test_a_tracker_goes_on_beside_a_model_that_holds_nothing(graph: Graph, camera: Any, thread_arc: Any, far: str):
    given = overrides(scene="dish_35mm", autostart="unconfigured")
    for node in perception(context=graph.context, parameter_overrides=given):
        graph.nodes.append(node)
        graph.executor.add_node(node)
    change(graph, "vision_tracker", CONFIGURE, ACTIVATE)
    if far == "finalized":
        change(graph, "thread_model", CONFIGURE, ACTIVATE, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    poses, states = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    show_frames(graph, states, frame(camera, thread_arc), 1, 2, 3, 4)
    graph.wait(lambda: len(poses) == 2, "poses")


def test_a_model_that_is_to_listen_takes_each_message_once_however_often_it_is_configured(graph: Graph):
    node = graph.add(lambda **options: ThreadModelNode(listens=False, **options), autostart="unconfigured")
    with graph.between_callbacks():
        node.listen()
    for _ in range(2):
        change(graph, "thread_model", CONFIGURE)
        assert [each.topic_name for each in node.subscriptions].count("/needle/measured_cp") == 1
        change(graph, "thread_model", CLEANUP)


class NeverImported:
    """Stands for a module of a barrier; to look for it is an import."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def find_spec(self, name: str, *_: Any) -> None:
        """Note that a module was asked for; it is not here."""
        self.asked.append(name)


def test_what_a_configured_model_refuses_is_not_prepared_first(graph: Graph, monkeypatch: pytest.MonkeyPatch):
    node = graph.add(ThreadModelNode)
    finder = NeverImported()
    monkeypatch.setattr(sys, "meta_path", [finder, *sys.meta_path])
    refused = node.set_parameters([Parameter("barriers", value=["barrier_of_somebody:KeepOut"])])[0]
    assert not refused.successful
    assert "barrier_of_somebody" not in finder.asked


def test_a_failing_configuration_of_forecasts_leaves_nothing_in_the_graph(graph: Graph):
    node = graph.add(ThreadModelNode, autostart="unconfigured", scene="dish_35mm", forecast_horizon=1.0, keep_out=0.02)
    before = entities(node)
    request = ChangeState.Request(transition=Transition(id=CONFIGURE))
    for _ in range(2):
        assert not called(graph, ChangeState, "thread_model/change_state", request).success
        assert entities(node) == before


def test_a_material_that_was_published_once_is_applied_once(graph: Graph):
    node = graph.add(ThreadModelNode, autostart="unconfigured", initial_shape="straight")
    graph.publish(topics.MATERIAL, topics.MATERIAL.message(viscosity=0.7))
    graph.wait(lambda: node._material is not None, "the message")
    change(graph, "thread_model", CONFIGURE)
    assert node.get_parameter("viscosity").value == 0.7
    change(graph, "thread_model", CLEANUP)
    assert node.set_parameters([Parameter("viscosity", value=0.2)])[0].successful
    change(graph, "thread_model", CONFIGURE, ACTIVATE)
    predicted = graph.listen(topics.PREDICTED_THREAD)
    graph.publish(topics.NEEDLE_POSE, pose(1.0))
    graph.wait(lambda: bool(predicted), "a prediction")
    assert node.get_parameter("viscosity").value == node._session.settings.viscosity == 0.2
