"""The rig simulator node: coil currents in, camera frames and the truth behind them out."""

from __future__ import annotations

import math
import sys
from collections import deque
from typing import Any

import numpy as np
from magnetosuture_msgs.msg import CoilCurrents
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String

from magnetosuture_thread.errors import InvalidInputError, MagnetosutureError
from magnetosuture_thread.nodes import camera_messages, messages, topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.rig.camera.dish_camera import encode_jpeg
from magnetosuture_thread.rig.faults import Fault
from magnetosuture_thread.rig.rig import Frame, Rig
from magnetosuture_thread.rig.settings import RigSettings

EARLY = 0.1  # of a period, that a tick may come before its time
CLOCK_PERIOD = 0.005  # s of simulated time between two messages on /clock
EPOCH = 1_000_000_000  # ns; simulated time begins here, as time 0 means "not set" in ROS


class RigSimulatorNode(Node):
    """Stands in for coils, dish and camera."""

    def __init__(self, **options: Any) -> None:
        super().__init__("rig_simulator", automatically_declare_parameters_from_overrides=True, **options)
        self._settings = settings = declare(self, RigSettings)
        # Who runs by /clock gets it from the rig: nobody else can say what time it is in a simulation.
        simulated = bool(self.get_parameter("use_sim_time").value)
        self._pace = settings.pace if simulated else 1.0
        self.get_logger().info("loading the rig's kernels; the first start on a machine compiles them")
        self.rig = Rig(settings)
        self.rig.warm_up()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._health = Health(self)
        self._epoch = EPOCH if simulated else self.get_clock().now().nanoseconds
        self._started = self._steady.now().nanoseconds
        self._phase: float | None = None
        self._last_index = -1
        self._frames = self._skipped = 0
        self._late: deque[tuple[float, int, Frame]] = deque()
        self._compressed = topics.COMPRESSED_IMAGE.publisher(self)
        self._raw = topics.IMAGE.publisher(self)
        self._info = topics.CAMERA_INFO.publisher(self)
        self._needle = topics.TRUE_NEEDLE.publisher(self)
        camera = self.rig.camera
        self._camera = camera_messages.camera_info(Time().to_msg(), camera.size, camera.view, settings.camera_distance)
        self._path = messages.PathMaker()
        self._thread = topics.TRUE_THREAD.publisher(self)
        topics.CURRENTS.subscribe(self, self.on_currents)
        topics.FAULT_REQUEST.subscribe(self, self.on_fault)
        if simulated:
            self._clocks = topics.CLOCK.publisher(self)
            self.create_timer(CLOCK_PERIOD / self._pace, self.on_clock, clock=self._steady)
        self.create_timer(1.0 / (settings.frame_rate * self._pace), self.on_frame, clock=self._steady)
        self.get_logger().info("ready: everything here is simulated")

    def on_currents(self, message: CoilCurrents) -> None:
        """Set the coils' currents from now on."""
        try:
            self.rig.apply(np.asarray(message.current, dtype=float), self._elapsed())
        except InvalidInputError as error:
            self._health.refuse(error)
        except MagnetosutureError as error:
            self._fail(error)

    def on_fault(self, message: String) -> None:
        """Take a fault that begins now."""
        try:
            self.rig.faults.add(Fault.asked_for(message.data, max(0.0, self.rig.running)))
        except InvalidInputError as error:
            self._health.refuse(error)

    def on_clock(self) -> None:
        """Say what time it is in the simulation."""
        self._clocks.publish(ClockMessage(clock=Time(nanoseconds=self._stamp(self._elapsed())).to_msg()))

    def on_frame(self) -> None:
        """Take the frame that is due; one that nobody had time for is left out."""
        elapsed = self._elapsed()
        if self._phase is None:
            self._phase = elapsed
        index = math.floor((elapsed - self._phase) * self._settings.frame_rate + EARLY)
        # No frame is stamped later than it is taken: the first tick may have been later than the others.
        self._phase = min(self._phase, elapsed - index / self._settings.frame_rate)
        if index > self._last_index:
            self._skipped += index - self._last_index - 1
            self._last_index = index
            self._take(self._phase + index / self._settings.frame_rate)
        while self._late and self._late[0][0] <= elapsed:
            _, stamp, frame = self._late.popleft()
            self._publish(stamp, frame)

    def _take(self, elapsed: float) -> None:
        try:
            frame = self.rig.look(elapsed)
        except MagnetosutureError as error:
            self._fail(error)
            return
        stamp = self._stamp(frame.time)  # currents may have moved the rig on since the frame was due
        if frame.lateness:
            self._late.append((elapsed + frame.lateness, stamp, frame))
        else:
            self._publish(stamp, frame)
        self._frames += 1
        self._health.ok(self.rig.words, taken=self._frames, skipped=self._skipped)

    def _fail(self, error: MagnetosutureError) -> None:
        """Switch the coils off where the simulation does not find its next state, and say so."""
        self.rig.switch_off()
        self._health.error(str(error))

    def _publish(self, nanoseconds: int, frame: Frame) -> None:
        stamp = Time(nanoseconds=nanoseconds).to_msg()
        if frame.image is not None:
            data = encode_jpeg(frame.image, self._settings.jpeg_quality)
            self._compressed.publish(camera_messages.compressed_image(stamp, data))
            if self._raw.get_subscription_count():
                self._raw.publish(camera_messages.image(stamp, frame.image))
            self._camera.header.stamp = stamp
            self._info.publish(self._camera)
        self._needle.publish(messages.placed(stamp, frame.tail, frame.heading))
        self._thread.publish(self._path.message(stamp, frame.thread))

    def _elapsed(self) -> float:
        """Return the rig's own time since the node's start [s]."""
        return (self._steady.now().nanoseconds - self._started) * 1e-9 * self._pace

    def _stamp(self, elapsed: float) -> int:
        return self._epoch + round(elapsed * 1e9)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(RigSimulatorNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
