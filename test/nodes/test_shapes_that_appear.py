"""A shape that a person adds to the scene, or makes larger, where thread or needle are while they move."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely
from builtin_interfaces.msg import Time
from magnetosuture_msgs.srv import EditShape

from magnetosuture_thread.interface import ADD_SHAPE, REPLACE_SHAPE
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.scene_server import SceneServerNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.thread.material import MATERIALS
from test.nodes import wire

RATE = 30.0
FRAMES, APPEARS = 60, 20  # of the needle's motion, and the frame after which the scene changes
SPEED = 2e-3  # m/s
DIP = (0.019 / 25) ** 2 / (8.0 * 1.5e-3)  # m; of a chord between two nodes on the smallest disc
TOLERANCE = 1e-6  # m
RADIUS = 0.5 * MATERIALS["polyamide_7_0"].diameter
SMALL = "{disc: {center: [-0.008, 0.003], radius: 0.001}, friction: 0.2}"


def pose(frame: int) -> Any:
    """Return the needle that goes east."""
    nanoseconds = round(1e9 * (1.0 + frame / RATE))
    stamp = Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return wire.pose_message(stamp, np.array([SPEED * frame / RATE, 0.0]), np.array([1.0, 0.0]))


class Bench:
    """The real nodes: scene server and thread model, and a needle."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        graph.add(SceneServerNode, scene="dish_35mm")
        self.node = graph.add(ThreadModelNode, initial_shape="straight", estimator=False)
        self.predicted, self.margins = graph.listen(topics.PREDICTED_THREAD), graph.listen(topics.MARGINS)
        self.reports = graph.listen(topics.DIAGNOSTICS)
        self.clients = {name: graph.probe.create_client(EditShape, name) for name in (ADD_SHAPE, REPLACE_SHAPE)}
        graph.wait(lambda: bool(self.node._session.scene_version), "the scene")

    def follow(self, first: int, last: int) -> None:
        """Move the needle on, waiting for what comes of each frame: the margins, or why there are none."""
        for frame in range(first, last):
            self.graph.publish(topics.NEEDLE_POSE, pose(frame))
            self.graph.wait(lambda frame=frame: len(self.margins) == frame + 1, f"the margins of frame {frame}")

    def change(self, service: str, shape: str) -> str:
        """Add or replace the shape by the server's service; return the scene's version, once the model has it."""
        client = self.clients[service]
        self.graph.wait(client.service_is_ready, service)
        answer = client.call_async(EditShape.Request(name="new", shape=shape))
        self.graph.wait(answer.done, "the answer")
        assert answer.result().success, answer.result().message
        version = str(answer.result().version)
        self.graph.wait(lambda: self.node._session.scene_version == version, "the scene at the model")
        return version

    def nodes(self, margins: Any) -> np.ndarray | None:
        """Return the nodes that were predicted with the same stamp."""
        found = [each for each in self.predicted if each.header.stamp == margins.header.stamp]
        return np.array([[point.x, point.y] for point in found[-1].positions]) if found else None


CASES = {
    "around a node": (ADD_SHAPE, "{disc: {center: [-0.0078, 0.0003], radius: 0.0015}}"),
    "around a node, with friction": (ADD_SHAPE, "{disc: {center: [-0.0078, 0.0003], radius: 0.0015}, friction: 0.5}"),
    "a polygon around nodes": (
        ADD_SHAPE,
        "{polygon: {outline: [[-0.010, -0.001], [-0.006, -0.001], [-0.006, 0.0022], [-0.010, 0.0022]]}}",
    ),
    "larger, over the thread": (REPLACE_SHAPE, "{disc: {center: [-0.008, 0.003], radius: 0.0042}, friction: 0.2}"),
    "around tail and needle": (ADD_SHAPE, "{disc: {center: [0.0014, 0.0002], radius: 0.0012}}"),
    "around all of the thread": (ADD_SHAPE, "{disc: {center: [-0.006, 0.0], radius: 0.011}}"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_shape_upon_the_thread_is_resolved_or_reported_and_no_margin_is_unproven(graph, case: str):
    bench, (service, shape) = Bench(graph), CASES[case]
    if service == REPLACE_SHAPE:
        bench.change(ADD_SHAPE, SMALL)
    bench.follow(0, APPEARS)
    assert all(each.valid for each in bench.margins)
    version = bench.change(service, shape)
    bench.follow(APPEARS, FRAMES)  # every frame is answered: nothing hangs
    after = bench.margins[APPEARS:]
    assert {each.scene_version for each in after} == {version}
    assert [each.header.stamp for each in after] == [pose(frame).header.stamp for frame in range(APPEARS, FRAMES)]
    solid = bench.node._session.scene.shapes[0].solid
    for margins in after:
        if not margins.valid:
            assert margins.reason
            assert not margins.value
            continue
        nodes = bench.nodes(margins)
        assert nodes is not None
        # What is published is true, by other code: nodes and chords of the published thread against the shape.
        places = [shapely.Point(node) for node in nodes]
        signed = [place.distance(solid) - solid.boundary.distance(place) * solid.covers(place) for place in places]
        outside = [shapely.LineString(pair).distance(solid) for pair in pairwise(nodes)]
        true = min(min(signed), *outside) - RADIUS if min(signed) > 0.0 else min(signed) - RADIUS
        stated = min((each.clearance for each in margins.minimum if each.barrier == "obstacle"), default=np.inf)
        assert stated <= true + TOLERANCE
    last = after[-1]
    if "tail" in case or "all of" in case:  # where it cannot come out: said
        assert not last.valid or min(each.clearance for each in last.minimum) < 0.0
    else:
        assert last.valid
        assert min(each.clearance for each in last.minimum if each.barrier == "obstacle") > -DIP
    assert any("predicting" in report.status[0].message for report in bench.reports)
