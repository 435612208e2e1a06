"""The thread model told of another thread, liquid or obstacles while it runs: by parameters and by topics."""

from __future__ import annotations

import gc
import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from magnetosuture_msgs.msg import Disc, ObstacleSet, Outline, Polygon, SafetyMargins, ThreadMaterial
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from magnetosuture_thread.configuration import from_mapping
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.thread_model import ThreadModelNode

SQUARE = [-0.012, 0.001, -0.006, 0.001, -0.006, 0.007, -0.012, 0.007]


class Bench:
    """A thread model that a needle is shown to, and beside it a session that is told the same, without a graph."""

    def __init__(self, graph: Any, **parameters: Any) -> None:
        self.graph = graph
        self.parameters = {"initial_shape": "straight", **parameters}
        self.node = graph.add(ThreadModelNode, **self.parameters)
        self.predicted = graph.listen(topics.PREDICTED_THREAD)
        self.margins = graph.listen(topics.MARGINS)
        self.obstacles = graph.listen(topics.OBSTACLE_MARKERS)
        self.diagnostics = graph.listen(topics.DIAGNOSTICS)
        graph.wait(lambda: len(self.obstacles) == 1, "the obstacles at the start")
        self.session = ThreadSession(from_mapping(ThreadModelSettings, self.parameters))
        self.shown = 0

    def show(self, count: int) -> None:
        """Show a number of poses, and compare every prediction with the session's, to the last bit."""
        for _ in range(count):
            k = self.shown
            nanoseconds = 1_000_000_000 + k * 33_000_000
            tail, angle = np.array([1e-4 * k, 2e-5 * k]), 0.01 * k
            heading = np.array([math.cos(angle), math.sin(angle)])
            message = messages.pose_message(messages.stamp_of(nanoseconds), tail, heading)
            self.graph.publish(topics.NEEDLE_POSE, message)
            self.shown += 1
            self.graph.wait(lambda: len(self.margins) == self.shown, "the pose's margins")
            outcome = self.session.on_pose(nanoseconds, messages.needle_pose(message))
            if outcome.prediction is None:
                continue
            self.graph.wait(partial(self._predicted_last, message), "the prediction")
            found = np.array([[vertex.x, vertex.y] for vertex in self.predicted[-1].vertices])
            np.testing.assert_array_equal(found, outcome.prediction.vertices)
            assert self.margins[-1].valid == outcome.prediction.converged

    def _predicted_last(self, pose: PoseWithCovarianceStamped) -> bool:
        return bool(self.predicted) and self.predicted[-1].header.stamp == pose.header.stamp

    def change(self, **values: Any) -> None:
        """Have the session do what the node was told."""
        self.parameters.update(values)
        self.session.change(from_mapping(ThreadModelSettings, self.parameters))

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


def obstacle_set(graph: Any, **fields: Any) -> ObstacleSet:
    """Return a set of obstacles in the dish frame."""
    return ObstacleSet(header=messages.header(graph.now()), **fields)


def square(hole: bool = False) -> Polygon:
    """Return the square above the thread as a message, with or without a hole."""
    corners = [Point(x=x, y=y) for x, y in np.reshape(SQUARE, (-1, 2)).tolist()]
    inner = [Point(x=-0.010, y=0.003), Point(x=-0.008, y=0.003), Point(x=-0.009, y=0.005)]
    return Polygon(outline=Outline(corners=corners), holes=[Outline(corners=inner)] if hole else [])


@pytest.mark.parametrize(
    "values",
    [
        {"material": "silk_6_0"},
        {"viscosity": 0.3},
        {"segments": 40},
        {"attachment": "glued"},
        {"attachment_offset": [1e-3, 0.0]},
        {"disc_obstacles": [-0.005, 0.003, 0.002]},
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


def test_polygons_are_set_at_once_and_shown_anew(graph):
    bench = Bench(graph, disc_obstacles=[0.01, 0.01, 0.002])
    bench.show(2)
    (reason,) = bench.set(polygon_obstacles=SQUARE)
    assert "thread_model.polygon_sizes" in reason
    assert "set at once, by set_parameters_atomically" in reason
    assert bench.told("polygon_obstacles") == []
    values = {"polygon_obstacles": SQUARE, "polygon_sizes": [4]}
    assert bench.set_at_once(**values) == ""
    bench.change(**values)
    bench.show(3)
    assert 1 in bench.margins[-1].obstacle
    graph.wait(lambda: len(bench.obstacles) == 2, "other markers")
    assert [marker.action for marker in bench.obstacles[-1].markers] == [Marker.DELETEALL, Marker.ADD, Marker.ADD]
    assert bench.set_at_once(polygon_obstacles=[], polygon_sizes=[], disc_obstacles=[]) == ""
    bench.change(polygon_obstacles=[], polygon_sizes=[], disc_obstacles=[])
    bench.show(2)
    graph.wait(lambda: len(bench.obstacles) == 3, "no markers")
    assert [marker.action for marker in bench.obstacles[-1].markers] == [Marker.DELETEALL]
    assert bench.set(viscosity=0.5) == []
    bench.change(viscosity=0.5)
    bench.show(1)
    assert len(bench.obstacles) == 3


def test_obstacles_come_by_topic_and_are_parameters_then(graph):
    bench = Bench(graph, corner_radius=1e-4)
    bench.show(3)
    graph.publish(topics.OBSTACLE_SET, obstacle_set(graph, discs=[Disc(x=-0.005, y=0.003, radius=0.002)]))
    graph.wait(lambda: len(bench.obstacles) == 2, "the disc")
    bench.change(disc_obstacles=[-0.005, 0.003, 0.002])
    bench.show(3)
    assert bench.told("disc_obstacles") == [-0.005, 0.003, 0.002]
    graph.publish(topics.OBSTACLE_SET, obstacle_set(graph, polygons=[square(hole=True)]))
    graph.wait(lambda: len(bench.obstacles) == 3, "the square")
    assert bench.told("disc_obstacles") == []
    assert bench.told("polygon_sizes") == [4, -3]
    assert bench.told("corner_radius") == 1e-4
    bench.change(disc_obstacles=[], polygon_obstacles=bench.told("polygon_obstacles"), polygon_sizes=[4, -3])
    bench.show(3)
    graph.publish(topics.OBSTACLE_SET, obstacle_set(graph, corner_radius=[0.0]))
    graph.wait(lambda: len(bench.obstacles) == 4, "nothing")
    assert (bench.told("polygon_obstacles"), bench.told("corner_radius")) == ([], 0.0)
    assert bench.refusals() == 0


def test_a_material_comes_by_topic_and_is_parameters_then(graph):
    bench = Bench(graph, elastic_modulus=1.5e9)
    bench.show(3)
    graph.publish(topics.MATERIAL, ThreadMaterial(viscosity=0.7, drag_anisotropy=0.6, rest_curvature=[20.0]))
    graph.wait(lambda: bench.node.get_parameter("viscosity").value == 0.7, "the liquid")
    bench.change(viscosity=0.7, drag_anisotropy=0.6, rest_curvature=20.0)
    bench.show(3)
    assert bench.told("elastic_modulus") == 1.5e9
    graph.publish(topics.MATERIAL, ThreadMaterial(name="silk_6_0", attachment="glued", attachment_offset=[1e-4, 0.0]))
    graph.wait(lambda: bench.node.get_parameter("material").value == "silk_6_0", "silk")
    bench.change(material="silk_6_0", elastic_modulus=0.0, attachment="glued", attachment_offset=[1e-4, 0.0])
    bench.show(3)
    assert bench.predicted[-1].material == "silk_6_0"
    graph.publish(topics.MATERIAL, ThreadMaterial())  # says nothing
    bench.show(3)
    assert bench.refusals() == 0
    assert len(bench.obstacles) == 1


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"viscosity": -1.0}, "out of range"),
        ({"viscosity": math.nan}, "out of range"),
        ({"material": "steel"}, "thread_model.material: got 'steel', expected one of polyamide_7_0, silk_6_0"),
        ({"segments": 400}, "longer than thick"),
        ({"disc_obstacles": [0.0, 0.0, 1e-4]}, "half of a segment"),
        ({"disc_obstacles": [0.0, 0.0]}, "multiple of 3"),
        ({"disc_obstacles": [0.0, math.inf, 0.01]}, "from -1 to 1 m"),
        ({"polygon_obstacles": SQUARE[:4], "polygon_sizes": [2]}, "at least 3 points"),
        ({"polygon_obstacles": [0.0, 0.0, 0.01, 0.01, 0.01, 0.0, 0.0, 0.01], "polygon_sizes": [4]}, "does not cross"),
        ({"polygon_obstacles": [0.0] * 200_000, "polygon_sizes": [100_000]}, "200000 entries"),
        ({"gravity": [0.0, -9.8]}, "medium: air only"),
        ({"formulation": "paper"}, "read-only"),
        ({"viscosity": 0.5, "solver": "osqp"}, "read-only"),
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
    assert len(bench.obstacles) == 1


def corners(*points: tuple[float, float]) -> Polygon:
    """Return a polygon."""
    return Polygon(outline=Outline(corners=[Point(x=x, y=y) for x, y in points]))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"discs": [Disc(x=math.nan, radius=0.01)]}, "thread_model.disc_obstacles"),
        ({"discs": [Disc(y=1e300, radius=0.01)]}, "from -1 to 1 m"),
        ({"discs": [Disc(radius=-0.01)]}, "half of a segment"),
        ({"discs": [Disc(radius=0.01)], "corner_radius": [math.inf]}, "out of range"),
        ({"polygons": [Polygon()]}, "thread_model.polygon_sizes: got [0], expected an outline before its holes"),
        ({"polygons": [corners((0.0, 0.0), (0.01, 0.0))]}, "at least 3 points"),
        ({"polygons": [corners((0.0, 0.0), (0.01, 0.01), (0.01, 0.0), (0.0, 0.01))]}, "does not cross"),
        ({"polygons": [corners((0.0, 0.0), (math.nan, 0.01), (0.01, 0.0))]}, "polygon_obstacles"),
        ({"polygons": [Polygon(holes=[square().outline])]}, "an outline before its holes"),
        ({"polygons": [square(), Polygon(holes=[square().outline])]}, "at least 3 points"),
        ({"polygons": [square()] * 300}, "2400 entries"),
        ({"polygons": [corners(*((1e-9 * k, 0.0) for k in range(20_000)))]}, "bytes, expected at most"),
        ({"discs": [Disc(radius=0.01)] * 20_000}, "bytes, expected at most"),
        ({"header": Header(frame_id="map"), "discs": [Disc(radius=0.01)]}, "'map', expected 'dish'"),
    ],
)
def test_refused_obstacles_are_said_and_leave_all_as_it_was(graph, fields, words):
    bench = Bench(graph, disc_obstacles=[-0.005, 0.003, 0.002])
    bench.show(4)
    graph.publish(topics.OBSTACLE_SET, ObstacleSet(**{"header": messages.header(graph.now()), **fields}))
    graph.wait(lambda: bench.said(words), "a refusal")
    assert bench.told("disc_obstacles") == [-0.005, 0.003, 0.002]
    bench.show(4)
    assert len(bench.obstacles) == 1


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"name": "steel"}, "thread_model.material: got 'steel'"),
        ({"name": "x" * 100_000}, "thread_model.material"),
        ({"name": "x" * 300_000}, "bytes, expected at most"),
        ({"diameter": -1e-5}, "out of range"),
        ({"diameter": math.inf}, "out of range"),
        ({"viscosity": 1e300}, "out of range"),
        ({"viscosity": 0.5, "elastic_modulus": -1.0}, "out of range"),
        ({"rest_curvature": [math.nan]}, "out of range"),
        ({"attachment_offset": [1e-3]}, "multiple of 2"),
        ({"attachment_offset": [1e-3, 1.0]}, "from -0.01 to 0.01 m"),
        ({"attachment": "knotted"}, "pinned, glued"),
    ],
)
def test_a_refused_material_is_said_and_leaves_all_as_it_was(graph, fields, words):
    bench = Bench(graph)
    bench.show(4)
    graph.publish(topics.MATERIAL, ThreadMaterial(**fields))
    graph.wait(lambda: bench.said(words), "a refusal")
    assert bench.told("viscosity") == 1.0
    bench.show(4)


def test_who_starts_later_gets_the_last_obstacles_and_the_last_material(graph):
    publisher = graph.probe.create_publisher(ObstacleSet, "thread/obstacle_set", topics.LATCHED)
    other = graph.probe.create_publisher(ThreadMaterial, "thread/material", topics.LATCHED)
    for radius in (0.001, 0.002):
        publisher.publish(obstacle_set(graph, discs=[Disc(x=-0.005, y=0.003, radius=radius)]))
        other.publish(ThreadMaterial(viscosity=100.0 * radius))
    node = graph.add(ThreadModelNode)
    graph.wait(lambda: list(node.get_parameter("disc_obstacles").value) == [-0.005, 0.003, 0.002], "the obstacles")
    graph.wait(lambda: node.get_parameter("viscosity").value == 0.2, "the liquid")


def test_a_publisher_that_cannot_be_heard_is_named(graph):
    bench = Bench(graph)
    graph.probe.create_publisher(ObstacleSet, "thread/obstacle_set", QoSProfile(depth=1))
    graph.wait(
        lambda: bench.said("publisher of thread/obstacle_set: got another durability, expected transient_local"),
        "a word on the publisher",
    )


def test_obstacles_may_come_while_the_thread_is_waited_for(graph):
    bench = Bench(graph, initial_shape="seen")
    bench.show(3)
    assert [margins.reason for margins in bench.margins] == ["waiting for the thread to be seen"] * 3
    graph.publish(topics.OBSTACLE_SET, obstacle_set(graph, discs=[Disc(x=-0.005, y=0.003, radius=0.002)]))
    graph.wait(lambda: len(bench.obstacles) == 2, "the disc")
    thread = np.column_stack([1e-4 - np.linspace(0.0, 0.019, 60), np.full(60, 2e-5)])
    graph.publish(topics.SEEN_THREAD, messages.PathMaker().message(messages.stamp_of(1_033_000_000), thread))
    graph.wait(lambda: len(bench.predicted) == 2 and len(bench.margins) == 5, "the poses that waited")
    assert [prediction.solver_status for prediction in bench.predicted] == ["started", "solved"]
    assert 0 in bench.margins[-1].obstacle


def test_who_waits_for_a_camera_in_vain_can_be_told_to_start(graph):
    bench = Bench(graph, initial_shape="seen")
    bench.show(2)
    assert bench.set(initial_shape="straight") == []
    bench.change(initial_shape="straight")
    bench.show(2)
    assert len(bench.predicted) == 2


def test_of_an_obstacle_upon_the_needle_there_is_no_valid_margin(graph):
    bench = Bench(graph)
    bench.show(2)
    graph.publish(topics.OBSTACLE_SET, obstacle_set(graph, discs=[Disc(x=0.0, y=0.0, radius=0.005)]))
    graph.wait(lambda: len(bench.obstacles) == 2, "the disc")
    bench.change(disc_obstacles=[0.0, 0.0, 0.005])
    bench.show(3)
    for margins in bench.margins[-3:]:
        assert not margins.valid
        assert "not converged" in margins.reason
        assert margins.contact_state == SafetyMargins.CONTACT_UNKNOWN
    graph.publish(topics.OBSTACLE_SET, obstacle_set(graph))
    graph.wait(lambda: len(bench.obstacles) == 3, "nothing")
    bench.change(disc_obstacles=[])
    bench.show(3)
    assert bench.margins[-1].valid


def alive() -> int:
    """Return how many predictors there are."""
    gc.collect()
    return sum(isinstance(found, ThreadPredictor) for found in gc.get_objects())


def test_a_hundred_changes_at_the_rate_of_the_camera_lose_no_pose_and_keep_nothing(graph):
    bench = Bench(graph)
    bench.show(2)
    publisher = graph.probe.create_publisher(ObstacleSet, "thread/obstacle_set", topics.LATCHED)
    graph.wait(lambda: publisher.get_subscription_count() > 0, "the node")
    before = alive()
    for k in range(100):
        x = -0.005 + 1e-5 * k
        if k % 2:
            publisher.publish(obstacle_set(graph, discs=[Disc(x=x, y=0.003, radius=0.002)]))
            graph.wait(lambda x=x: list(bench.node.get_parameter("disc_obstacles").value)[:1] == [x], "the disc")
            bench.change(disc_obstacles=[x, 0.003, 0.002])
        else:
            assert bench.set(viscosity=0.5 + 0.001 * k) == []
            bench.change(viscosity=0.5 + 0.001 * k)
        bench.show(1)
    assert len(bench.predicted) == 102
    assert all(prediction.interval == pytest.approx(0.033) for prediction in bench.predicted[1:])
    assert bench.refusals() == 0
    assert alive() == before


def test_a_flood_of_what_is_refused_keeps_no_pose_waiting(graph):
    """A million numbers are refused by their count, before anything is built of them."""
    bench = Bench(graph)
    bench.show(2)
    for _ in range(3):
        assert "1000000 entries" in bench.set(disc_obstacles=[0.0] * 1_000_000)[0]
        bench.show(1)


def test_bytes_that_are_no_message_are_refused_and_end_nothing(graph):
    """As from a publisher whose definition of the type is another."""
    bench = Bench(graph, disc_obstacles=[-0.005, 0.003, 0.002], corner_radius=1e-4)
    bench.show(2)
    settings = bench.node._settings
    whole = serialize_message(obstacle_set(graph, discs=[Disc(radius=0.01)]))
    for data in (b"", whole[:-3], whole[:16], b"\x00\x01\x00\x00" + b"\xff" * 40):
        settings.on_obstacles(data)
        settings.on_material(data[:20])
    graph.wait(lambda: bench.refusals() >= 8, "the refusals")
    assert bench.told("disc_obstacles") == [-0.005, 0.003, 0.002]


def test_a_rounding_below_rounding_is_refused(graph):
    bench = Bench(graph, polygon_obstacles=[0.0, 0.0, 0.005, 0.0, 0.0, 0.005], polygon_sizes=[3])
    before = bench.told("corner_radius")
    assert "can be cut into triangles" in bench.set_at_once(corner_radius=1e-320)
    assert bench.told("corner_radius") == before
