"""What the simulated rig publishes: frames, and the truth behind them."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.time import Time

from magnetosuture_thread.messages.cdr import time_of
from magnetosuture_thread.messages.packing import packed_path
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.rig.camera.dish_camera import DishCamera, encode_jpeg
from magnetosuture_thread.rig.rig import RigFrame
from magnetosuture_thread.rig.settings import RigSettings


class FramePublisher:
    """Publishes frames as a camera does, and where needle and thread really are.

    Args:
        node: that publishes.
        camera: that the frames are from.
        settings: of the rig.
    """

    def __init__(self, node: Node, camera: DishCamera, settings: RigSettings) -> None:
        self._quality, self._distance = settings.jpeg_quality, settings.camera_distance
        self._compressed = topics.COMPRESSED_IMAGE.publisher(node)
        self._raw = topics.IMAGE.publisher(node)
        self._info = topics.CAMERA_INFO.publisher(node)
        self._needle = topics.GROUND_TRUTH_NEEDLE.publisher(node)
        self._thread = topics.GROUND_TRUTH_THREAD.publisher(node)
        self.take(camera)

    def take(self, camera: DishCamera) -> None:
        """Publish frames of another camera from now on."""
        self._camera = MESSAGES.camera_info(Time().to_msg(), camera.size, camera.view, self._distance)

    def publish(self, nanoseconds: int, frame: RigFrame) -> None:
        """Publish a frame with its stamp [ns]; one that got lost has its truth all the same."""
        stamp = Time(nanoseconds=nanoseconds).to_msg()
        if frame.image is not None:
            data = encode_jpeg(frame.image, self._quality)
            self._compressed.publish(MESSAGES.compressed_image(stamp, data))
            if self._raw.get_subscription_count():
                self._raw.publish(MESSAGES.image(stamp, frame.image))
            self._camera.header.stamp = stamp
            self._info.publish(self._camera)
        self._needle.publish(MESSAGES.placed(stamp, frame.tail, frame.heading))
        self._thread.publish(packed_path(time_of(nanoseconds), frame.thread))
