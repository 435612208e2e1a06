"""The thread model told of another thread, liquid or scene while it runs: by parameters and by topics."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from magnetosuture_msgs.msg import Scene as SceneMessage
from magnetosuture_msgs.msg import ThreadMaterial
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter

from magnetosuture_thread.configuration import from_mapping
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.scene import Scene, read_scene
from magnetosuture_thread.thread_model.session import ThreadSession
from magnetosuture_thread.thread_model.settings import ThreadModelSettings
from test.nodes import wire
from test.thread.worlds import scene_with

SCENE = "dish_150mm"
POST = Disc((-0.005, 0.003), 0.002)
SQUARE = ((-0.012, 0.001), (-0.006, 0.001), (-0.006, 0.007), (-0.012, 0.007))
HOLE = ((-0.010, 0.003), (-0.008, 0.003), (-0.009, 0.005))


class Bench:
    """A thread model that a needle is shown to, and beside it a session that is told the same, without a graph."""

    def __init__(self, graph: Any, **parameters: Any) -> None:
        self.graph = graph
        self.parameters = {"initial_shape": "straight", "scene": SCENE, **parameters}
        self.node = graph.add(ThreadModelNode, **self.parameters)
        self.predicted = graph.listen(topics.PREDICTED_THREAD)
        self.margins = graph.listen(topics.MARGINS)
        self.diagnostics = graph.listen(topics.DIAGNOSTICS)
        self.scene = read_scene(SCENE)
        self.session = ThreadSession(from_mapping(ThreadModelSettings, self.parameters), self.scene)
        self.shown = 0

    def show(self, count: int) -> None:
        """Show a number of poses, and compare every prediction with the session's, to the last bit."""
        for _ in range(count):
            k = self.shown
            nanoseconds = 1_000_000_000 + k * 33_000_000
            tail, angle = np.array([1e-4 * k, 2e-5 * k]), 0.01 * k
            heading = np.array([math.cos(angle), math.sin(angle)])
            message = wire.pose_message(wire.time(nanoseconds), tail, heading)
            self.graph.publish(topics.NEEDLE_POSE, message)
            self.shown += 1
            self.graph.wait(lambda: len(self.margins) == self.shown, "the pose's margins")
            outcome = self.session.on_pose(nanoseconds, reading.needle_pose(message))
            if outcome.prediction is None:
                continue
            self.graph.wait(partial(self._predicted_last, message), "the prediction")
            found = np.array([[vertex.x, vertex.y] for vertex in self.predicted[-1].positions])
            np.testing.assert_array_equal(found, outcome.prediction.positions)
            assert self.margins[-1].valid == outcome.prediction.converged
            assert self.margins[-1].scene_version == self.predicted[-1].scene_version == self.scene.version

    def _predicted_last(self, pose: PoseWithCovarianceStamped) -> bool:
        return bool(self.predicted) and self.predicted[-1].header.stamp == pose.header.stamp

    def change(self, **values: Any) -> None:
        """Have the session do what the node was told."""
        self.parameters.update(values)
        self.session.change(from_mapping(ThreadModelSettings, self.parameters), self.scene)

    def place(self, scene: Scene) -> None:
        """Publish a scene, wait until the node goes by it, and have the session do so too."""
        self.graph.publish(topics.SCENE, wire.scene_message(self.graph.now(), scene))
        self.graph.wait(lambda: self.node._session.scene_version == scene.version, "the scene")
        self.scene = scene
        self.change()

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call one of the node's parameter services."""
        client = self.graph.probe.create_client(kind, f"/thread_model/{name}")
        assert client.wait_for_service(10.0)
        future = client.call_async(request)
        self.graph.wait(future.done, "an answer")
        self.graph.probe.destroy_client(client)
        return future.result()

    def set(self, **values: Any) -> list[str]:
        """Set parameters one by one, as `ros2 param set` and `ros2 param load`; return why each was refused."""
        request = SetParameters.Request(parameters=as_messages(values))
        results = self.call(SetParameters, "set_parameters", request).results
        return [result.reason for result in results if not result.successful]

    def set_at_once(self, **values: Any) -> str:
        """Set parameters together; return why they were refused."""
        request = SetParametersAtomically.Request(parameters=as_messages(values))
        result = self.call(SetParametersAtomically, "set_parameters_atomically", request).result
        return "" if result.successful else result.reason

    def told(self, name: str) -> Any:
        """Return a parameter's value, as `ros2 param get`."""
        value = self.call(GetParameters, "get_parameters", GetParameters.Request(names=[name])).values[0]
        found = Parameter.from_parameter_msg(ParameterMessage(name=name, value=value)).value
        return list(found) if hasattr(found, "typecode") else found

    def refusals(self) -> int:
        """Return how many refusals the node has counted, as far as it has said."""
        counts = [
            int(entry.value)
            for message in list(self.diagnostics)
            for entry in message.status[0].values
            if entry.key == "refused" and message.status[0].name.startswith("thread_model")
        ]
        return max(counts, default=0)

    def said(self, words: str) -> bool:
        """Return whether the last refusal on /diagnostics has these words."""
        return any(
            words in entry.value
            for message in list(self.diagnostics)
            for entry in message.status[0].values
            if entry.key == "last refusal"
        )


def as_messages(values: dict[str, Any]) -> list[Any]:
    """Return parameters as a service takes them."""
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


@pytest.mark.parametrize(
    "values",
    [
        {"material": "silk_6_0"},
        {"viscosity": 0.3},
        {"segments": 40},
        {"attachment": "clamped"},
        {"attachment_offset": [1e-3, 0.0]},
        {"margin_range": 0.01},
    ],
)
def test_a_parameter_counts_from_the_next_pose_on(graph, values):
    bench = Bench(graph)
    bench.show(5)
    assert bench.set(**values) == []
    bench.change(**values)
    bench.show(5)
    assert bench.predicted[-1].interval == pytest.approx(0.033)
    name, value = next(iter(values.items()))
    assert bench.told(name) == value


def test_a_scene_counts_from_the_next_pose_on(graph):
    bench = Bench(graph)
    bench.show(3)
    bench.place(scene_with(POST))
    bench.show(3)
    assert 0 in bench.margins[-1].obstacle
    bench.place(scene_with(POST, Polygon(SQUARE, (HOLE,))))
    bench.show(3)
    assert {0, 1} <= set(bench.margins[-1].obstacle)
    assert bench.set(viscosity=0.5) == []
    bench.change(viscosity=0.5)
    bench.show(2)
    bench.place(scene_with())
    bench.show(2)
    names = bench.margins[-1].barrier_names
    assert not any(names[row] == "obstacle" for row in bench.margins[-1].barrier)
    assert bench.refusals() == 0


def test_a_material_comes_by_topic_and_is_parameters_then(graph):
    bench = Bench(graph, elastic_modulus=1.5e9)
    bench.show(3)
    graph.publish(topics.MATERIAL, ThreadMaterial(viscosity=0.7, drag_anisotropy=0.6, rest_curvature=[20.0]))
    graph.wait(lambda: bench.node.get_parameter("viscosity").value == 0.7, "the liquid")
    bench.change(viscosity=0.7, drag_anisotropy=0.6, rest_curvature=20.0)
    bench.show(3)
    assert bench.told("elastic_modulus") == 1.5e9
    graph.publish(topics.MATERIAL, ThreadMaterial(name="silk_6_0", attachment="clamped", attachment_offset=[1e-4, 0.0]))
    graph.wait(lambda: bench.node.get_parameter("material").value == "silk_6_0", "silk")
    bench.change(material="silk_6_0", elastic_modulus=0.0, attachment="clamped", attachment_offset=[1e-4, 0.0])
    bench.show(3)
    assert bench.predicted[-1].material == "silk_6_0"
    graph.publish(topics.MATERIAL, ThreadMaterial())  # says nothing
    bench.show(3)
    assert bench.refusals() == 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"viscosity": -1.0}, "out of range"),
        ({"viscosity": math.nan}, "out of range"),
        ({"material": "steel"}, "thread_model.material: got 'steel', expected one of polyamide_7_0, silk_6_0"),
        ({"segments": 400}, "longer than thick"),
        ({"fixed_nodes": [1] * 200_000}, "200000 entries"),
        ({"scene": "dish_35mm"}, "expected its value in force, until the node is cleaned up"),
        ({"gravity": [0.0, -9.8]}, "medium: air only"),
        ({"formulation": "paper"}, "expected its value in force"),
        ({"viscosity": 0.5, "solver": "osqp"}, "thread_model.solver: got 'osqp', expected its value in force"),
        ({"lenght": 0.02}, ""),
    ],
)
def test_a_refused_parameter_leaves_all_as_it_was_to_the_last_bit(graph, values, words):
    bench = Bench(graph)
    bench.show(4)
    before = {name: bench.node.get_parameter(name).value for name in values if bench.node.has_parameter(name)}
    reason = bench.set_at_once(**values)
    assert words in reason
    assert "\n" not in reason
    assert len(reason) < 700
    assert {name: bench.node.get_parameter(name).value for name in before} == before
    bench.show(4)


def damaged(message: SceneMessage) -> SceneMessage:
    """Return a scene whose content is not that of its version."""
    message.dish_diameter -= 1e-6
    return message


def elsewhere(message: SceneMessage) -> SceneMessage:
    """Return a scene in another frame."""
    message.header.frame_id = "map"
    return message


@pytest.mark.parametrize(
    ("scene", "alter", "words"),
    [
        (scene_with(POST), damaged, "scene.version"),
        (scene_with(POST), elsewhere, "expected 'dish'"),
        (scene_with(Disc((0.005, 0.005), 1e-4)), lambda message: message, "half of a segment"),
        (scene_with(Polygon(((0.0, 0.005), (1e-4, 0.005), (0.0, 0.006)))), lambda message: message, "room for a disc"),
    ],
)
def test_a_refused_scene_is_reported_and_leaves_all_as_it_was(graph, scene, alter, words):
    bench = Bench(graph)
    bench.show(4)
    graph.publish(topics.SCENE, alter(wire.scene_message(graph.now(), scene)))
    graph.wait(lambda: bench.said(words), "a refusal")
    bench.show(4)
