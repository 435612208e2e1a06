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
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String
from std_srvs.srv import SetBool

from magnetosuture_thread import ConfigurationError, InvalidInputError, MagnetosutureError, Scene, interface
from magnetosuture_thread.interface import PAUSE_RIG
from magnetosuture_thread.messages.packing import camera_outputs, ground_truth_outputs, packed_image
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import PackageNode
from magnetosuture_thread.nodes.parameters import declare, given_parameters
from magnetosuture_thread.nodes.scene_follower import SceneFollower, initial_scene
from magnetosuture_thread.nodes.timeline import Timeline
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.rig.faults import Fault
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.settings import RigSettings

MAX_WAITING = 2  # frames that are rendered or wait for that; the next ones are left out
MIN_REAL_TIME_FACTOR = 0.9  # below which the status says so
BOARD_PERIOD = 0.005  # s between two looks at the boards, which keep real time whatever the rig's own is
CLOCK_PERIOD = 0.005  # s of simulated time between two messages on /clock
EPOCH = 1_000_000_000  # ns; simulated time begins here, as time 0 means "not set" in ROS


class RigSimulatorNode(PackageNode):
    """Stands in for coils, dish and camera."""

    def __init__(self, **options: Any) -> None:
        super().__init__("rig_simulator", **options)
        self._settings = settings = declare(self, RigSettings, given_parameters(self, "rig_simulator", options))
        # Who runs by /clock gets it from the rig: nobody else can say what time it is in a simulation.
        simulated = bool(self.get_parameter("use_sim_time").value)
        rate = settings.rate if simulated else 1.0
        scene = initial_scene(settings.scene)
        if scene is None:
            raise ConfigurationError(f"{settings.GROUP}.scene", "", "a scene file: what is simulated has a dish")
        # What one callback may take, so that frames come and the others of this computer get on: else time lags. For so
        # long the rig moves [s]; an iteration of its Newton method takes 40 us.
        self._catch_up = max(0.1, 2.0 / settings.frame_rate)
        iterations = max(1e3, 1e4 / settings.frame_rate)
        with self.health.load("the rig's kernels"):
            self.rig = Rig(settings, scene, max_time=self._catch_up, max_iterations=iterations)
            self.rig.warm_up()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        epoch = EPOCH if simulated else self.get_clock().now().nanoseconds
        self.time = RigTime(self, epoch, rate, simulated=simulated)
        self._phase: float | None = None
        self._last_index, self._clock_stamp = -1, 0
        self._frames = self._skipped = 0
        # A thread of its own renders and publishes, so that currents are in force at once, as on a rig.
        self._renderer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="renderer")
        self._rendering: deque[Future[None]] = deque()
        self._late: deque[tuple[float, int, RigFrame]] = deque()
        self._outputs = {
            interface.COMPRESSED_IMAGE: topics.COMPRESSED_IMAGE.publisher(self),
            interface.CAMERA_INFO: topics.CAMERA_INFO.publisher(self),
            interface.GROUND_TRUTH_NEEDLE: topics.GROUND_TRUTH_NEEDLE.publisher(self),
            interface.GROUND_TRUTH_THREAD: topics.GROUND_TRUTH_THREAD.publisher(self),
            interface.GROUND_TRUTH_PULL: topics.GROUND_TRUTH_PULL.publisher(self),
        }
        self._raw = topics.IMAGE.publisher(self)
        topics.FAULT_REQUEST.subscribe(self, self.on_fault)
        self._scene = SceneFollower(self, self.on_scene, scene)
        if simulated:
            self._clocks = topics.CLOCK.publisher(self)
            self.create_timer(CLOCK_PERIOD / rate, self.on_clock, clock=self._steady)
        self.create_timer(1.0 / (settings.frame_rate * rate), self.on_frame, clock=self._steady)
        self._stage = stage = settings.power()  # simulated boards; None where currents come as messages
        if stage is None:
            topics.RIG_CURRENTS.subscribe(self, self.on_currents)
        else:
            stage.open()
            self.create_timer(BOARD_PERIOD, lambda: self._apply(stage.currents()), clock=self._steady)
        self.get_logger().info("ready: everything here is simulated")

    def on_scene(self, scene: Scene) -> None:
        """Put another dish and other shapes around needle and thread, which stay where they are."""
        wait(self._rendering)
        self.rig.set_scene(scene)

    def on_currents(self, message: CoilCurrents) -> None:
        """Apply the coils' currents of a message."""
        self._apply(np.asarray(message.current, dtype=float))

    def on_fault(self, message: String) -> None:
        """Apply a fault that begins now."""
        try:
            self.rig.faults.add(Fault.requested(message.data, max(0.0, self.rig.running)))
        except InvalidInputError as error:
            self.health.refuse(error)

    def on_clock(self) -> None:
        """Publish the simulated time, which waits for the rig where that is late and never goes back."""
        elapsed = self.time.elapsed()
        if not self.rig.held:
            elapsed = min(elapsed, self.rig.time + self._catch_up)
        self._clock_stamp = max(self._clock_stamp, self.time.stamp(elapsed))
        self._clocks.publish(ClockMessage(clock=Time(nanoseconds=self._clock_stamp).to_msg()))

    def on_frame(self) -> None:
        """Capture the frame that is due; a missed one is left out."""
        if self.time.paused:
            self.health.ok("paused")
            return
        elapsed = self.time.elapsed()
        if self._phase is None:
            self._phase = elapsed
        index = math.floor((elapsed - self._phase) * self._settings.frame_rate + 0.1)  # a tick may be early
        # No frame is stamped later than it is taken: the first tick may have been later than the others.
        self._phase = min(self._phase, elapsed - index / self._settings.frame_rate)
        while self._rendering and self._rendering[0].done():
            self._rendering.popleft().result()  # raises what rendering has raised
        if index > self._last_index and len(self._rendering) < MAX_WAITING:
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

    def _apply(self, currents: NDArray[np.float64]) -> None:
        elapsed = self.time.elapsed()
        try:
            self.rig.apply(currents, elapsed)
        except InvalidInputError as error:
            self.health.refuse(error)
            return
        except MagnetosutureError as error:
            self._fail(error)
        self._leave_out(elapsed - self.rig.time)

    def _leave_out(self, behind: float) -> None:
        """Let the time lag by what the rig is behind [s]: what it had no time for it never makes good."""
        if behind > 1e-9:
            self.time.slip(behind)
            self._phase = None if self._phase is None else self._phase - behind

    def _take(self, elapsed: float) -> None:
        try:
            frame = self.rig.look(elapsed, rendered=False)
        except MagnetosutureError as error:
            self._fail(error)
            return
        finally:
            self._leave_out(elapsed - self.rig.time)
        stamp = self.time.stamp(frame.time)  # currents may have moved the rig on since the frame was due
        self._rendering.append(self._renderer.submit(self._render, elapsed, stamp, frame))
        self._frames += 1
        factor = self.time.real_time_factor(self.rig.time)
        late = factor < MIN_REAL_TIME_FACTOR
        text = self.rig.problem or self.rig.status
        if late:
            text = f"{text}; late: simulated time runs at {100.0 * factor:.0f} % of real time"
        moving = self.health.warn if late else self.health.ok
        level = self.health.error if self.rig.problem else moving
        values = {"taken": self._frames, "skipped": self._skipped, "real_time_factor": round(factor, 2)}
        level(text, **values, **{"lag [s]": round(self.time.lag, 3)})

    def _render(self, elapsed: float, stamp: int, frame: RigFrame) -> None:
        """Render a frame and publish it, in the renderer's thread; a late one is published when it is due."""
        frame = self.rig.render(frame)
        if frame.lateness:
            self._late.append((elapsed + frame.lateness, stamp, frame))
        else:
            self._publish(stamp, frame)

    def _publish(self, stamp: int, frame: RigFrame) -> None:
        """Publish a frame with its stamp [ns]; the ground truth is published also for a lost frame."""
        outputs = [*ground_truth_outputs(stamp, frame)]
        if frame.image is not None:
            camera, jpeg = self.rig.camera, encode_jpeg(frame.image, self._settings.jpeg_quality)
            distance = self._settings.camera_distance
            outputs = [*camera_outputs(stamp, jpeg, camera.size, camera.view, distance), *outputs]
            if self._raw.get_subscription_count():
                self._raw.publish(packed_image(stamp, frame.image))
        for channel, data in outputs:
            self._outputs[channel].publish(data)

    def _fail(self, error: MagnetosutureError) -> None:
        """Switch the coils off where the simulation does not find its next state, and say so."""
        self.rig.switch_off()
        self.health.error(str(error))


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
        if now - then >= 1.0:
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
