"""Vision tracker and thread model in one process: the prediction follows the frame without a way between.

Both nodes have their names, topics and parameters as if each ran alone, and publish the same to the last bit. What the
tracker sees is published, and handed to the model by a call.
"""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.settings.errors import GraphError


def perception(**options: Any) -> tuple[VisionTrackerNode, ThreadModelNode]:
    """Return the two nodes, so that the model hears the tracker; by topics only where these have other names.

    Args:
        options: for both nodes of rclpy.

    Raises:
        MagnetosutureError: one of them cannot be made, or both have one name; none is left.
    """
    tracker = VisionTrackerNode(**options)
    try:
        model = ThreadModelNode(tracker=tracker, **options)
    except BaseException:
        tracker.destroy_node()
        raise
    if tracker.get_name() == (name := model.get_name()):
        tracker.destroy_node()
        model.destroy_node()
        raise GraphError(f"two nodes cannot both be named {name}: rename each, as by -r vision_tracker:__node:=NAME")
    return tracker, model
