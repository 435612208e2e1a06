"""The estimated thread in a graph: at every frame, late, of paths, with bounds, disturbances, and bad observations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import SafetyMargins

from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.thread.prediction import NeedlePose
from test.estimator.threads import error_percent, piece_of, poses, thread_of, true_shapes, whole
from test.nodes import wire

COUNT = 12
WAY = poses(60)
NODES = true_shapes(thread_of(viscosity=3.0), WAY)  # the node is told of a liquid a third as viscous
SILK = {"material": "silk_6_0"}


def stamp(k: float) -> Time:
    seconds, nanoseconds = divmod(round((1.0 + k / 30.0) * 1e9), 10**9)
    return Time(sec=seconds, nanosec=nanoseconds)


class Bench:
    """A thread model, and what it says.

    Args:
        graph: of the test.
        taken: returns how many observations the node has been through; see `counting`.
        parameters: of the node.
    """

    def __init__(self, graph: Any, taken: Callable[[], int] = lambda: 0, **parameters: Any) -> None:
        self.graph, self.taken = graph, taken
        self.node = graph.add(ThreadModelNode, **{**SILK, **parameters})
        self.predicted, self.margins = graph.listen(topics.PREDICTED_THREAD), graph.listen(topics.MARGINS)
        self.estimated, self.reports = graph.listen(topics.ESTIMATED_THREAD), graph.listen(topics.DIAGNOSTICS)

    def pose(self, k: int, needle: NeedlePose | None = None) -> None:
        shown = needle or WAY[k]
        self.graph.publish(topics.NEEDLE_POSE, wire.pose_message(stamp(k), shown.tail, shown.heading))

    def observe(self, k: float, observation: ThreadObservation) -> None:
        """Publish what a frame shows, and wait until the node has taken it."""
        before = self.taken()
        self.graph.publish(topics.THREAD_OBSERVATION, wire.observation_message(stamp(k), observation))
        self.graph.wait(lambda: self.taken() > before, "the observation to be taken")

    def show(self, k: int, observation: ThreadObservation | None = None, needle: NeedlePose | None = None) -> Any:
        """Show a frame, its observation first, and return what is estimated."""
        before = len(self.estimated)
        self.observe(k, observation or whole(NODES[k], k))
        self.pose(k, needle)
        self.graph.wait(lambda: len(self.estimated) == before + 1, "an estimate")
        return self.estimated[-1]

    def hears(self, words: str) -> Callable[[], bool]:
        """Return whether a report has such words in its message or its values."""
        return lambda: any(
            words in text
            for report in self.reports
            for text in (report.status[0].message, *(value.value for value in report.status[0].values))
        )


@pytest.fixture
def bench(graph: Any, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Return a thread model of a thread whose observations are counted as the node takes them."""
    return counting(monkeypatch, graph)


def counting(monkeypatch: pytest.MonkeyPatch, graph: Any, **parameters: Any) -> Bench:
    counts = {"observations": 0}
    take = ThreadModelNode.on_observation_message

    def counted(self: ThreadModelNode, data: bytes) -> None:
        take(self, data)
        counts["observations"] += 1

    monkeypatch.setattr(ThreadModelNode, "on_observation_message", counted)
    return Bench(graph, lambda: counts["observations"], **parameters)


def error(message: Any, k: int) -> float:
    return error_percent(np.array([[point.x, point.y] for point in message.positions]), NODES[k])


def test_every_frame_has_an_estimate_beside_the_prediction(bench: Bench):
    for k in range(COUNT):
        message = bench.show(k)
        assert message.header.stamp == stamp(k)
        assert message.header.frame_id == "dish"
        assert (message.prediction_only, message.unmeasured_for, message.converged) == (False, 0.0, True)
        assert len(message.positions) == len(message.deviation) == 26
    bench.graph.wait(lambda: len(bench.predicted) == len(bench.margins) == COUNT, "all that comes of the frames")
    assert error(bench.estimated[-1], COUNT - 1) < 0.5 * error(bench.predicted[-1], COUNT - 1)
    assert [each.source for each in bench.margins] == [SafetyMargins.OF_ESTIMATE] * COUNT
    bench.graph.wait(bench.hears("predicting"), "the state")


def test_an_observation_that_cannot_be_used_is_survived_and_reported(bench: Bench):
    for k in range(3):
        bench.show(k)
    good = piece_of(NODES[3], 3)
    points = good.points.copy()
    points[3, 0] = math.nan
    bench.observe(3.0, ThreadObservation((replace(good, points=points),)))
    bench.pose(3)
    bench.graph.wait(lambda: len(bench.estimated) == 4, "an estimate")
    bench.graph.wait(bench.hears("thread/observation"), "the reason")
    for k in range(4, COUNT):
        message = bench.show(k)
        assert not message.prediction_only
    assert error(message, COUNT - 1) < 0.1
