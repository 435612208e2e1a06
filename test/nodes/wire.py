"""Messages as objects of rclpy, so that a test can look at them, or damage them, before it publishes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from magnetosuture_thread.bags import packing
from magnetosuture_thread.bags.packing import packed_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.topics import Topic


def decoded(topic: Topic, packed: Callable[..., bytes]) -> Callable[..., Any]:
    """Return a function that returns what another packs as a message."""
    return lambda *given, **more: topic.decode(packed(*given, **more))


pose_message = decoded(topics.NEEDLE_POSE, packing.packed_pose)
path_message = decoded(topics.MEASURED_THREAD, packing.packed_path)
twist_message = decoded(topics.NEEDLE_COMMAND, packing.packed_twist)
observation_message = decoded(topics.THREAD_OBSERVATION, packing.packed_observation)
image = decoded(topics.IMAGE, packing.packed_image)
compressed_image = decoded(topics.COMPRESSED_IMAGE, packing.packed_compressed_image)
scene_message = decoded(topics.SCENE, packed_scene)


def no_margins(stamp: Any, reason: str) -> Any:
    """Return the message that says that there are no margins, and why."""
    return topics.MARGINS.decode(packing.packed_margins(stamp, None, reason))


def header(stamp: Any) -> Header:
    """Return a header in the dish frame."""
    return Header(stamp=time(stamp), frame_id="dish")


def time(stamp: Any) -> Time:
    """Return a time given in nanoseconds, or one that is one already."""
    return Time(sec=stamp // 10**9, nanosec=stamp % 10**9) if isinstance(stamp, int) else stamp
