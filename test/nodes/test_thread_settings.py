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
from magnetosuture_thread.thread.prediction import NeedlePose
from test.nodes.test_thread_estimate import Bench


@pytest.fixture
def bench(graph: Any) -> Bench:
    """A thread model that needs no camera."""
    return Bench(graph, material="polyamide_7_0", initial_shape="straight", scene="dish_150mm")


def show(bench: Bench, count: int) -> np.ndarray:
    """Show a number of poses, each of which is predicted; return the last thread."""
    for _ in range(count):
        k = len(bench.predicted)
        angle = 0.01 * k
        heading = np.array([math.cos(angle), math.sin(angle)])
        bench.pose(k, NeedlePose(0.0, k * np.array([1e-4, 2e-5]), heading))
        bench.graph.wait(lambda k=k: len(bench.margins) == len(bench.predicted) == k + 1, "the prediction")
        assert bench.margins[-1].scene_version == bench.predicted[-1].scene_version
    return np.array([[vertex.x, vertex.y] for vertex in bench.predicted[-1].positions])


def test_parameters_count_from_the_next_pose_on(graph: Any, bench: Bench):
    before = show(bench, 5)
    values = {"segments": 40, "viscosity": 0.3, "attachment_offset": [1e-3, 0.0]}
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    # Together, as `ros2 param load` does.
    changed = graph.call(SetParametersAtomically, "thread_model/set_parameters_atomically", parameters=parameters)
    assert changed.result.successful, changed.result.reason
    after = show(bench, 1)
    assert len(after) == 41
    assert np.linalg.norm(after[0] - before[0]) > 5e-4  # where the thread is fixed to the needle
    assert bench.predicted[-1].interval == pytest.approx(1 / 30.0)  # it goes on
    assert bench.node.get_parameter("viscosity").value == bench.node.settings.viscosity == 0.3


def test_a_material_comes_by_topic_and_is_parameters_then(graph, bench: Bench):
    show(bench, 3)
    graph.publish(topics.MATERIAL, ThreadMaterial(viscosity=0.7, drag_anisotropy=0.6, rest_curvature=[20.0]))
    graph.wait(lambda: bench.node.get_parameter("viscosity").value == 0.7, "the liquid")
    graph.publish(topics.MATERIAL, ThreadMaterial(name="silk_6_0", attachment="clamped", attachment_offset=[1e-4, 0.0]))
    graph.wait(lambda: bench.node.get_parameter("material").value == "silk_6_0", "silk")
    graph.publish(topics.MATERIAL, ThreadMaterial())  # says nothing
    show(bench, 3)
    assert bench.predicted[-1].material == "silk_6_0"
    assert bench.node.settings.rest_curvature == 20.0
