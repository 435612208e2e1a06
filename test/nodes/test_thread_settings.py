"""The thread model told of another thread or liquid while it runs: by parameters and by a topic."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from magnetosuture_msgs.msg import ThreadMaterial
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from test.nodes import wire


class Bench:
    """A thread model that a needle is shown to."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.node = graph.add(ThreadModelNode, initial_shape="straight", scene="dish_150mm")
        self.predicted, self.margins = graph.listen(topics.PREDICTED_THREAD), graph.listen(topics.MARGINS)
        self.shown = 0

    def show(self, count: int) -> np.ndarray:
        """Show a number of poses, each of which is predicted; return the last thread."""
        for _ in range(count):
            tail, angle = np.array([1e-4, 2e-5]) * self.shown, 0.01 * self.shown
            stamp = wire.time(1_000_000_000 + self.shown * 33_000_000)
            heading = np.array([math.cos(angle), math.sin(angle)])
            self.graph.publish(topics.NEEDLE_POSE, wire.pose_message(stamp, tail, heading))
            self.shown += 1
            self.graph.wait(lambda: len(self.margins) == len(self.predicted) == self.shown, "the prediction")
            assert self.margins[-1].scene_version == self.predicted[-1].scene_version
        return np.array([[vertex.x, vertex.y] for vertex in self.predicted[-1].positions])

    def set(self, **values: Any) -> str:
        """Set parameters together, as `ros2 param load` does; return why they were refused."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        name = "thread_model/set_parameters_atomically"
        result = self.graph.call(SetParametersAtomically, name, parameters=parameters).result
        return "" if result.successful else str(result.reason)


@pytest.fixture
def bench(graph) -> Bench:
    """A thread model."""
    return Bench(graph)


def test_parameters_count_from_the_next_pose_on(bench: Bench):
    before = bench.show(5)
    assert bench.set(segments=40, viscosity=0.3, attachment_offset=[1e-3, 0.0]) == ""
    after = bench.show(1)
    assert len(after) == 41
    assert np.linalg.norm(after[0] - before[0]) > 5e-4  # where the thread is fixed to the needle
    assert bench.predicted[-1].interval == pytest.approx(0.033)  # it goes on
    assert bench.node.get_parameter("viscosity").value == bench.node.settings.viscosity == 0.3


def test_a_material_comes_by_topic_and_is_parameters_then(graph, bench: Bench):
    bench.show(3)
    graph.publish(topics.MATERIAL, ThreadMaterial(viscosity=0.7, drag_anisotropy=0.6, rest_curvature=[20.0]))
    graph.wait(lambda: bench.node.get_parameter("viscosity").value == 0.7, "the liquid")
    graph.publish(topics.MATERIAL, ThreadMaterial(name="silk_6_0", attachment="clamped", attachment_offset=[1e-4, 0.0]))
    graph.wait(lambda: bench.node.get_parameter("material").value == "silk_6_0", "silk")
    graph.publish(topics.MATERIAL, ThreadMaterial())  # says nothing
    bench.show(3)
    assert bench.predicted[-1].material == "silk_6_0"
    assert bench.node.settings.rest_curvature == 20.0
