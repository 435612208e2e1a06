"""Clock, camera and boards of the simulated rig."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from magnetosuture_msgs.msg import CoilCurrents
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.time import Time
from std_srvs.srv import SetBool

from magnetosuture_thread.interface import PAUSE_RIG
from magnetosuture_thread.messages.cdr import time_of
from magnetosuture_thread.messages.packing import packed_path
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.node import PackageNode
from magnetosuture_thread.nodes.player import Timeline
from magnetosuture_thread.rig.camera import DishCamera, encode_jpeg
from magnetosuture_thread.rig.rig import RigFrame
from magnetosuture_thread.rig.settings import RigSettings

FACTOR_PERIOD = 1.0  # s over which the real-time factor is taken


class RigTime:
    """Counts the rig's own time, and stamps what happens in it; the node's service `rig/pause` lets it stand still.

    By a simulated clock the stamps stand still with the rig. By the time of the day they go on: what the rig shows
    after a pause is stamped as late as it is shown. Time for which the computer was too slow is left out in the same
    way (`slip`).

    Args:
        node: that gets the service.
        epoch: the stamp of its beginning, which is now [ns].
        rate: how much faster than real time it runs.
        simulated: whether the stamps are those of a simulated clock.

    Attributes:
        lag: time that was left out [s].
    """

    def __init__(self, node: Node, epoch: int, rate: float, *, simulated: bool) -> None:
        self._epoch, self._rate, self._simulated = epoch, rate, simulated
        self._timeline = Timeline(epoch, rate)
        self._timeline.begin()
        self._began = time.perf_counter()
        self._stood = 0.0  # s of real time, in all pauses that are over
        self.lag = 0.0
        self._mark, self._factor = (0.0, 0.0), 1.0
        node.create_service(SetBool, PAUSE_RIG, self._on_pause)

    @property
    def paused(self) -> bool:
        """Whether it stands still."""
        return self._timeline.paused

    def elapsed(self) -> float:
        """Return the rig's own time since its beginning [s]."""
        return self._timeline.running() * self._rate - self.lag

    def slip(self, seconds: float) -> None:
        """Leave out time that the simulation did not have [s]."""
        self.lag += seconds

    def real_time_factor(self, elapsed: float) -> float:
        """Return the share of time that was not left out, over the last second or two until a time of its own [s]."""
        now, (then, before) = elapsed + self.lag, self._mark
        if now - then >= FACTOR_PERIOD:
            self._mark, self._factor = (now, self.lag), 1.0 - (self.lag - before) / (now - then)
        return self._factor

    def stamp(self, elapsed: float) -> int:
        """Return the stamp of a moment in the rig's own time, given in seconds [ns]."""
        return self._epoch + round((elapsed + (0.0 if self._simulated else self._stood + self.lag)) * 1e9)

    def pause(self, still: bool) -> None:
        """Pause the time, or resume it."""
        self._timeline.pause(still)
        if not still:
            self._stood = time.perf_counter() - self._began - self._timeline.running()

    def _on_pause(self, asked: Any, answer: Any) -> Any:
        self.pause(asked.data)
        answer.success = True
        answer.message = f"{'paused' if asked.data else 'goes on'} at {self.elapsed():.2f} s"
        return answer


class FramePublisher:
    """Publishes frames as a camera does, and where needle and thread really are and how they pull.

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
        self._pull = topics.GROUND_TRUTH_PULL.publisher(node)
        self.take(camera)

    def take(self, camera: DishCamera) -> None:
        """Publish frames of another camera from now on."""
        self._camera = camera

    def publish(self, nanoseconds: int, frame: RigFrame) -> None:
        """Publish a frame with its stamp [ns]; the ground truth is published also for a lost frame."""
        stamp = Time(nanoseconds=nanoseconds).to_msg()
        if frame.image is not None:
            data = encode_jpeg(frame.image, self._quality)
            self._compressed.publish(MESSAGES.compressed_image(stamp, data))
            if self._raw.get_subscription_count():
                self._raw.publish(MESSAGES.image(stamp, frame.image))
            camera = self._camera
            self._info.publish(MESSAGES.camera_info(stamp, camera.size, camera.view, self._distance))
        self._needle.publish(MESSAGES.placed(stamp, frame.tail, frame.heading))
        self._thread.publish(packed_path(time_of(nanoseconds), frame.thread))
        self._pull.publish(MESSAGES.wrench_message(stamp, frame.pull, frame.moment))


PERIOD = 0.005  # s between two looks at the boards, which keep real time whatever the rig's own is


class RigCurrents:
    """Hands on what the settings name.

    Args:
        node: that has the rig.
        settings: of the rig.
        clock: that the boards are looked at by.
        apply: takes the coils' currents from now on, shape (m,) [A].

    Attributes:
        stage: the simulated boards, None where currents come as messages.

    Raises:
        ConfigurationError: a path for the boards cannot be used.
    """

    def __init__(
        self, node: PackageNode, settings: RigSettings, clock: Clock, apply: Callable[[NDArray[np.float64]], None]
    ) -> None:
        self._apply = apply
        self.stage = stage = settings.power()
        if stage is None:
            topics.RIG_CURRENTS.subscribe(node, self.on_currents)
        else:
            stage.open()
            node.create_timer(PERIOD, lambda: apply(stage.currents()), clock=clock)

    def on_currents(self, message: CoilCurrents) -> None:
        """Apply currents from a message."""
        self._apply(np.asarray(message.current, dtype=float))

    def close(self) -> None:
        """Remove the boards' serial lines."""
        if self.stage is not None:
            self.stage.close()


EARLY = 0.1  # of a period, that a tick may come before its time


CLOCK_PERIOD = 0.005  # s of simulated time between two messages on /clock


EPOCH = 1_000_000_000  # ns; simulated time begins here, as time 0 means "not set" in ROS
