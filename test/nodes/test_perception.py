"""Tracker and model in one process: the same bits as apart, one clear line where one cannot start, a clean end."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import PredictedThread, SafetyMargins
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.perception import perception
from magnetosuture_thread.nodes.processes import reserved_domain
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from test.nodes.conftest import Graph, own_context
from test.nodes.test_vision_tracker import compressed

FRAMES = 8
SCENE = "dish_35mm"


BETWEEN = [f"/{topic.name}" for topic in (topics.NEEDLE_POSE, topics.THREAD_OBSERVATION, topics.MEASURED_THREAD)]


def all_found(ends: list[Any]) -> bool:
    """Return whether all publishers and subscriptions have found their other ends."""
    return all(
        end.get_subscription_count() if isinstance(end, Publisher) else end.get_publisher_count() for end in ends
    )


def together(graph: Graph, **parameters: Any) -> tuple[VisionTrackerNode, ThreadModelNode]:
    """Add both nodes, made by the composition."""
    overrides = [Parameter(name, value=value) for name, value in {"scene": SCENE, **parameters}.items()]
    made = perception(context=graph.context, parameter_overrides=overrides)
    for node in made:
        graph.nodes.append(node)
        graph.executor.add_node(node)
    return made


def last_of_each(margins: list[SafetyMargins]) -> list[SafetyMargins]:
    """Return the last valid margins of each frame."""
    return list({each.header.stamp.nanosec: each for each in margins if each.valid}.values())


def are_last(margins: list[SafetyMargins], expected: list[SafetyMargins]) -> bool:
    """Return whether some margins are the last of each frame."""
    return last_of_each(margins) == expected


def answers(graph: Graph, frames: list[np.ndarray]) -> tuple[list[PredictedThread], list[SafetyMargins]]:
    """Return what comes of frames, one after the other."""
    predicted, margins = graph.listen(topics.PREDICTED_THREAD), graph.listen(topics.MARGINS)
    measured, states = graph.listen(topics.MEASURED_THREAD), graph.listen(topics.TRACKER_STATE)

    def answered(count: int) -> bool:
        return len(states) >= count

    for index, image in enumerate(frames):
        stamp = Time(sec=5, nanosec=index * 33_000_000)
        graph.publish(topics.COMPRESSED_IMAGE, compressed(image, stamp))
        # Each is answered before the next is shown: of frames that wait, the tracker takes only the newest two.
        graph.wait(partial(answered, index + 1), "the state of a frame")
    confirmed = len(frames) - 2  # the needle is in the third frame
    graph.wait(lambda: min(len(predicted), len(measured)) >= confirmed, "an answer to each")
    graph.wait(lambda: bool(margins) and margins[-1].header.stamp == predicted[-1].header.stamp, "its margins")
    return predicted, margins


@pytest.fixture
def frames(camera, thread_arc) -> list[np.ndarray]:
    """Pictures of a needle that moves on and turns."""
    shown = []
    for index in range(FRAMES):
        angle = 0.4 + 0.01 * index
        tail = np.array([0.002 + 1e-4 * index, 0.001])
        shown.append(camera.render(tail, angle, thread_arc(tail, angle + np.pi, 40.0)))
    return shown


def test_together_they_say_the_same_as_apart_to_the_last_bit(frames):
    said = list[tuple[list[PredictedThread], list[SafetyMargins]]]()
    for alone in (False, True):
        with reserved_domain() as domain, own_context(domain) as context:
            graph = Graph(context, domain)
            try:
                if alone:
                    tracker, model = graph.add(VisionTrackerNode, scene=SCENE), graph.add(ThreadModelNode, scene=SCENE)
                    ends = [each for node in (tracker, model) for each in (*node.publishers, *node.subscriptions)]
                    between = [each for each in ends if each.topic_name in BETWEEN]
                    graph.wait(partial(all_found, between), "them to have found each other")
                else:
                    together(graph)
                predicted, margins = answers(graph, frames)
                if alone:  # The pose may come before the observation of its frame, which then corrects the estimate.
                    graph.wait(partial(are_last, margins, said[0][1]), "the same margins")
            finally:
                graph.close()
        for message in predicted:
            message.step_time = 0.0  # that is a clock's
        said.append((predicted, last_of_each(margins)))
    joined, apart = said
    assert len(apart[0]) == FRAMES - 2
    assert apart == joined


def test_a_model_that_is_remapped_hears_the_topic_of_its_new_name():
    with reserved_domain() as domain, own_context(domain) as context:
        graph, other = Graph(context, domain), "thread_model:needle/measured_cp:=other/measured_cp"
        made = perception(context=context, cli_args=["--ros-args", "-r", other, "-p", f"scene:={SCENE}"])
        graph.nodes.extend(made)
        heard = {entry.topic_name for entry in made[1].subscriptions}
        graph.close()
    assert {"/other/measured_cp", "/thread/observation"} <= heard
