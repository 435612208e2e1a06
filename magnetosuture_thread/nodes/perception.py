"""Vision tracker and thread model in one process: the prediction follows the frame without a way between.

Both nodes have their names, topics and parameters as if each ran alone, and publish the same to the last bit. What the
tracker sees is published, and handed to the model by a call.
"""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode


def perception(**options: Any) -> tuple[VisionTrackerNode, ThreadModelNode]:
    """Return the two nodes, of which the model takes poses and observations from the tracker.

    Args:
        options: for both nodes of rclpy.

    Raises:
        MagnetosutureError: one of them cannot be made, both have one name, or the model would hear other topics than
            the tracker's; none is left.
    """
    tracker = VisionTrackerNode(**options)
    try:
        model = ThreadModelNode(listens=False, **options)
    except BaseException:
        tracker.destroy_node()
        raise
    problem = ""
    if tracker.get_name() == (name := model.get_name()):
        problem = f"two nodes cannot both be named {name}: rename each, as by -r vision_tracker:__node:=NAME"
    for topic in (topics.NEEDLE_POSE, topics.THREAD_OBSERVATION):
        published, heard = (node.resolve_topic_name(topic.name) for node in (tracker, model))
        if published != heard:
            problem = (
                f"thread_model would hear {heard}, and not {published}: run the two nodes as programs of their own"
            )
    if problem:
        tracker.destroy_node()
        model.destroy_node()
        raise GraphError(problem)
    tracker.follower = model.on_tracked
    return tracker, model
