"""The node `rig_simulator`: the simulated rig in the place of camera, power stage and needle."""

from __future__ import annotations

import math
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
from magnetosuture_msgs.msg import CoilCurrents
from numpy.typing import NDArray
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String

from magnetosuture_thread import ConfigurationError, InvalidInputError, MagnetosutureError, Scene, read_scene
from magnetosuture_thread.bags.packing import camera_outputs, packed_image
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.executor import Timeline
from magnetosuture_thread.nodes.node import GuardedNode, SceneFollower
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.rig.rig import Rig, RigFrame, ground_truth_outputs
from magnetosuture_thread.rig.settings import Fault, RigSettings
from magnetosuture_thread.settings import interface

PERIOD = 0.005  # s between two looks at the boards, which keep real time; simulated, between two messages on /clock


class RigSimulatorNode(GuardedNode):
    """Stands in for coils, dish and camera.

    Its own time stands still by the service `rig/pause`, and leaves out what the computer is too slow for. By a
    simulated clock the stamps do so too; by the time of the day, what the rig shows is stamped as late as it is shown.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("rig_simulator", **options)
        self._settings = settings = declare(self, RigSettings, options)
        # Who runs by /clock gets it from the rig: nobody else can say what time it is in a simulation.
        self._simulated = bool(self.get_parameter("use_sim_time").value)
        rate = settings.rate if self._simulated else 1.0
        if not settings.scene:
            raise ConfigurationError(f"{settings.GROUP}.scene", "", "a scene file: what is simulated has a dish")
        scene = read_scene(settings.scene)
        # What one callback may take, so that frames come and the others of this computer get on: else time lags. For so
        # long the rig moves [s]; an iteration of its Newton method takes 40 us.
        self._catch_up = max(0.1, 2.0 / settings.frame_rate)
        iterations = max(1e3, 1e4 / settings.frame_rate)
        with self.health.load("the rig's kernels"):
            self.rig = Rig(settings, scene, max_time=self._catch_up, max_iterations=iterations)
            self.rig.warm_up()
        self._model = self.resolve_topic_name(topics.PREDICTED_THREAD.name)
        # Simulated time begins at 1 s, as time 0 means "not set" in ROS.
        self.time = Timeline(1_000_000_000 if self._simulated else self.get_clock().now().nanoseconds, rate)
        self.time.begin()
        self.serve(interface.Service.PAUSE_RIG, self.time.on_pause)
        self._phase: float | None = None
        self._last_index, self._clock_stamp = -1, 0
        self._frames = self._skipped = 0
        self._mark, self._factor = (0.0, 0.0), 1.0  # of the real-time factor: time and lag before, the factor since
        # A worker renders and publishes, so that currents are in force at once, as on a rig.
        self._renderer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="renderer")
        self._rendering: deque[Future[None]] = deque()
        self._late: deque[tuple[float, int, RigFrame]] = deque()
        self._show = topics.publishing(self, topics.COMPRESSED_IMAGE, topics.CAMERA_INFO)
        self._reveal = topics.publishing(
            self, topics.GROUND_TRUTH_NEEDLE, topics.GROUND_TRUTH_THREAD, topics.GROUND_TRUTH_PULL
        )
        self._raw = topics.IMAGE.publisher(self)
        topics.FAULT_REQUEST.subscribe(self, self.on_fault)
        self._scene = SceneFollower(self, self.on_scene, scene)
        if self._simulated:
            self._clocks = topics.CLOCK.publisher(self)
            self.every(PERIOD / rate, self.on_clock)
        self.every(1.0 / (settings.frame_rate * rate), self.on_frame)
        self._stage = settings.power()  # simulated boards; None where currents come as messages
        if self._stage is None:
            topics.RIG_CURRENTS.subscribe(self, self.on_currents)
        else:
            self._stage.open()
            self.rig.advance(self.time.elapsed())  # nothing has flowed until now
            self.every(PERIOD, self.on_boards)
        self.get_logger().info("ready: everything here is simulated")

    def on_scene(self, scene: Scene) -> None:
        """Put another dish and other shapes around needle and thread, which stay where they are."""
        wait(self._rendering)
        self.rig.set_scene(scene)

    def on_currents(self, message: CoilCurrents) -> None:
        """Apply the coils' currents of a message."""
        now = self.time.elapsed()
        self._apply(np.asarray(message.current, dtype=float), now, now)

    def on_boards(self) -> float:
        """Let what has flowed since the last look act in the time in which it has; return the time of this look [s]."""
        assert self._stage is not None
        currents, until = self._stage.currents()
        elapsed = self.time.elapsed() - (time.monotonic() - until)
        self._apply(currents, self.rig.time, elapsed)
        return elapsed

    def on_fault(self, message: String) -> None:
        """Apply a fault that begins now."""
        self.rig.faults.add(Fault.requested(message.data, max(0.0, self.rig.running)))

    def on_clock(self) -> None:
        """Publish the simulated time, which waits for the rig where that is late and never goes back."""
        elapsed = self.time.elapsed()
        if not self.rig.held:
            elapsed = min(elapsed, self.rig.time + self._catch_up)
        self._clock_stamp = max(self._clock_stamp, self._stamp(elapsed))
        self._clocks.publish(ClockMessage(clock=Time(nanoseconds=self._clock_stamp).to_msg()))

    def on_frame(self) -> None:
        """Capture the frame that is due; a missed one is left out."""
        if self.time.paused:
            self.health.ok("paused")
            return
        # No frame is ahead of what is known of the boards.
        elapsed = self.time.elapsed() if self._stage is None else self.on_boards()
        if self._phase is None:
            self._phase = elapsed
        index = math.floor((elapsed - self._phase) * self._settings.frame_rate + 0.1)  # a tick may be early
        # No frame is stamped later than it is taken: the first tick may have been later than the others.
        self._phase = min(self._phase, elapsed - index / self._settings.frame_rate)
        while self._rendering and self._rendering[0].done():
            self._rendering.popleft().result()  # raises what rendering has raised
        if index > self._last_index and len(self._rendering) < 2:  # the next ones are left out
            self._skipped += index - self._last_index - 1
            self._last_index = index
            self._take(self._phase + index / self._settings.frame_rate)
        while self._late and self._late[0][0] <= elapsed:
            _, stamp, frame = self._late.popleft()
            self._rendering.append(self._renderer.submit(self._publish, stamp, frame))

    def destroy_node(self) -> None:
        """End rendering, and remove the serial lines of simulated boards."""
        self._renderer.shutdown()
        try:
            if self._stage is not None:
                self._stage.close()
        finally:
            super().destroy_node()

    def _stamp(self, elapsed: float) -> int:
        """Return the stamp of a moment in the rig's own time, given in seconds [ns]."""
        left_out = 0.0 if self._simulated else self.time.stood + self.time.lag
        return self.time.start + round((elapsed + left_out) * 1e9)

    def _apply(self, currents: NDArray[np.float64], since: float, until: float) -> None:
        """Let currents act since a time, and the rig move on until another one [s]."""
        try:
            self.rig.apply(currents, since)
            self.rig.advance(until)
        except InvalidInputError as error:
            self.refuse(error)
            return
        except MagnetosutureError as error:
            self._fail(error)
        self._leave_out(until - self.rig.time)

    def _leave_out(self, behind: float) -> None:
        """Let the time lag by what the rig is behind [s]: what it had no time for it never makes good."""
        if behind > 1e-9:
            self.time.lag += behind
            self._phase = None if self._phase is None else self._phase - behind

    def _take(self, elapsed: float) -> None:
        # How long the other nodes take to start has no effect on where the thread is.
        self.rig.is_watched = not self.rig.held or self.count_publishers(self._model) > 0
        try:
            frame = self.rig.look(elapsed, rendered=False)
        except MagnetosutureError as error:
            self._fail(error)
            return
        finally:
            self._leave_out(elapsed - self.rig.time)
        stamp = self._stamp(frame.time)  # currents may have moved the rig on since the frame was due
        self._rendering.append(self._renderer.submit(self._render, elapsed, stamp, frame))
        self._frames += 1
        factor, text, level = self._real_time_factor(), self.rig.problem or self.rig.status, self.health.ok
        if factor < 0.9:
            text = f"{text}; late: simulated time runs at {100.0 * factor:.0f} % of real time"
            level = self.health.warn
        if self.rig.problem:
            level = self.health.error
        values = {"taken": self._frames, "skipped": self._skipped, "real_time_factor": round(factor, 2)}
        level(text, **values, **{"lag [s]": round(self.time.lag, 3)})

    def _real_time_factor(self) -> float:
        """Return the share of time that was not left out, over the last second or two."""
        lag, (then, before) = self.time.lag, self._mark
        now = self.rig.time + lag
        if now - then >= 1.0:
            self._mark, self._factor = (now, lag), 1.0 - (lag - before) / (now - then)
        return self._factor

    def _render(self, elapsed: float, stamp: int, frame: RigFrame) -> None:
        """Render a frame and publish it, by the renderer; a late one is published when it is due."""
        frame = self.rig.render(frame)
        if frame.lateness:
            self._late.append((elapsed + frame.lateness, stamp, frame))
        else:
            self._publish(stamp, frame)

    def _publish(self, stamp: int, frame: RigFrame) -> None:
        """Publish a frame with its stamp [ns]; the ground truth is published also for a lost frame."""
        if frame.image is not None:
            camera, jpeg = self.rig.camera, encode_jpeg(frame.image, self._settings.jpeg_quality)
            seen = stamp + round(1e9 * frame.stamp_delay)
            self._show(camera_outputs(seen, jpeg, camera.size, camera.view, self._settings.camera_distance))
            if self._raw.get_subscription_count():
                self._raw.publish(packed_image(seen, frame.image))
        self._reveal(ground_truth_outputs(stamp, frame))

    def _fail(self, error: MagnetosutureError) -> None:
        """Switch the coils off where the simulation does not find its next state, and say so."""
        self.rig.switch_off()
        self.health.error(str(error))
