"""The vision tracker node: camera frames in, needle pose and seen thread out."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.interface import CAMERA
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.scene import Dish, Scene
from magnetosuture_thread.vision.images import decode_image, unpack_image
from magnetosuture_thread.vision.look import no_pose
from magnetosuture_thread.vision.session import TrackerSession
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.warm_up import warm_up

SILENCE = 0.5  # s without a frame, after which the tracker says that it sees nothing


class VisionTrackerNode(Node):
    """Tracks the needle in every camera frame; when it is lost, no pose is published."""

    def __init__(self, **options: Any) -> None:
        super().__init__("vision_tracker", automatically_declare_parameters_from_overrides=True, **options)
        settings = declare(self, VisionTrackerSettings)
        self.get_logger().info("loading the tracker's kernels; the first start on a machine compiles them")
        warm_up()
        self._session = TrackerSession(settings, Scene(Dish(settings.dish_diameter)))
        self._health = Health(self)
        self._words = "nothing seen"
        # Simulated time may stand still; that the camera is silent must be noticed all the same.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._last_frame = self._arrival()
        self._poses = topics.NEEDLE_POSE.publisher(self)
        self._states = topics.TRACKER_STATE.publisher(self)
        self._path = messages.PathMaker()
        self._threads = topics.SEEN_THREAD.publisher(self)
        if settings.image_transport == "compressed":
            topics.COMPRESSED_IMAGE.subscribe(self, self.on_compressed)
        else:
            topics.IMAGE.subscribe(self, self.on_image)
        self.create_timer(0.5 * SILENCE, self.on_watch, clock=self._steady)
        self._health.warn("no camera frame yet")
        self.get_logger().info(f"ready: frames from {self.resolve_topic_name(CAMERA[settings.image_transport].name)}")

    def on_compressed(self, message: CompressedImage) -> None:
        """Take a JPEG or PNG frame."""
        self._take(message, lambda: decode_image(message.data))

    def on_image(self, message: Image) -> None:
        """Take a raw frame."""
        self._take(
            message,
            lambda: unpack_image(message.data, message.height, message.width, message.step, message.encoding),
        )

    def on_watch(self) -> None:
        """Say so when no frame has come for too long."""
        waited = self._arrival() - self._last_frame
        if self._session.frames and waited > SILENCE:
            reason = f"no camera frame for {waited:.1f} s"
            stamp = self.get_clock().now().to_msg()
            self._states.publish(messages.tracker_state(stamp, no_pose(self._session.missing, reason, None), 0.0))
            self._health.warn(f"{reason}; before that {self._words}")

    def _arrival(self) -> float:
        return float(self._steady.now().nanoseconds * 1e-9)

    def _take(self, message: Image | CompressedImage, decode: Callable[[], Any]) -> None:
        self._last_frame = self._arrival()
        stamp, taken = message.header.stamp, 0.0
        try:
            image = np.asarray(decode())
        except InvalidInputError as error:
            seen = self._session.on_broken(error)
        else:
            began = time.perf_counter()
            seen = self._session.on_image(messages.seconds(stamp), image)
            taken = time.perf_counter() - began
        track = seen.track
        if seen.tracked:
            # The pose first: the prediction waits for it, and a path of many poses takes some milliseconds.
            self._poses.publish(messages.pose_message(stamp, track.tail, track.heading, track.covariance))
            if len(seen.centreline):
                self._threads.publish(self._path.message(stamp, seen.centreline))
        self._states.publish(messages.tracker_state(stamp, track, 0.0 if seen.problem else taken))
        values = {"frames": self._session.frames, "tracked": self._session.tracked}
        if seen.problem is not None:
            self._health.refuse(seen.problem, **values)
        elif seen.tracked:
            self._words = "tracking"
            self._health.ok(self._words, confidence=round(track.confidence, 3), **values)
        else:
            self._words = f"{track.state.value}: {track.reason}"
            self._health.warn(self._words, **values)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(VisionTrackerNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
