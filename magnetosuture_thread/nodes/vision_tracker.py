"""The vision tracker node: camera frames in, needle pose and seen thread out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker, decode_image, unpack_image


class VisionTrackerNode(Node):
    """Tracks the needle in every camera frame; when it is lost, no pose is published."""

    def __init__(self, **options: Any) -> None:
        super().__init__("vision_tracker", automatically_declare_parameters_from_overrides=True, **options)
        settings = declare(self, VisionTrackerSettings)
        self._tracker = VisionTracker(settings)
        self._health = Health(self)
        self._frames = self._tracked = 0
        self._poses = topics.NEEDLE_POSE.publisher(self)
        self._threads = topics.SEEN_THREAD.publisher(self)
        if settings.image_transport == "compressed":
            topics.COMPRESSED_IMAGE.subscribe(self, self.on_compressed)
        else:
            topics.IMAGE.subscribe(self, self.on_image)
        self._health.warn("no camera frame yet")

    def on_compressed(self, message: CompressedImage) -> None:
        """Take a JPEG or PNG frame."""
        self._take(message, lambda: decode_image(message.data))

    def on_image(self, message: Image) -> None:
        """Take a raw frame."""
        self._take(
            message,
            lambda: unpack_image(message.data, message.height, message.width, message.step, message.encoding),
        )

    def _take(self, message: Image | CompressedImage, decode: Any) -> None:
        self._frames += 1
        try:
            track = self._tracker.track(np.asarray(decode()))
        except InvalidInputError as error:
            self._health.refuse(error, frames=self._frames, tracked=self._tracked)
            return
        if track.lost:
            self._health.warn(f"lost: {track.lost}", frames=self._frames, tracked=self._tracked)
            return
        self._tracked += 1
        stamp = message.header.stamp
        # The pose first: the prediction waits for it, and a path of many poses takes some milliseconds.
        self._poses.publish(messages.pose_message(stamp, track.tail, track.heading))
        self._threads.publish(messages.path_message(stamp, track.centreline))
        self._health.ok("tracking", frames=self._frames, tracked=self._tracked)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(VisionTrackerNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
