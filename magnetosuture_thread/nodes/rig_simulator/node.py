"""The node `rig_simulator`: the simulated rig in the place of camera, power stage and needle."""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String

from magnetosuture_thread import ConfigurationError, InvalidInputError, MagnetosutureError, Scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import PackageNode
from magnetosuture_thread.nodes.parameter_files import node_options
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.rig_simulator.devices import (
    CLOCK_PERIOD,
    EARLY,
    EPOCH,
    FramePublisher,
    RigCurrents,
    RigTime,
)
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower, initial_scene
from magnetosuture_thread.rig.faults import Fault
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.settings import RigSettings

MIN_CATCH_UP, CATCH_UP_FRAMES = 0.1, 2.0  # s, or frame periods, for which the rig moves in one callback
MIN_ITERATIONS, ITERATION_RATE = 1000.0, 1e4  # of Newton in one callback, or for a second's frames; they take 40 us
MAX_WAITING = 2  # frames that are rendered or wait for that; the next ones are left out
MIN_REAL_TIME_FACTOR = 0.9  # below which the status says so


class RigSimulatorNode(PackageNode):
    """Stands in for coils, dish and camera."""

    def __init__(self, **options: Any) -> None:
        super().__init__("rig_simulator", **node_options("rig_simulator", options))
        self._settings = settings = declare(self, RigSettings)
        # Who runs by /clock gets it from the rig: nobody else can say what time it is in a simulation.
        simulated = bool(self.get_parameter("use_sim_time").value)
        rate = settings.rate if simulated else 1.0
        scene = initial_scene(settings.scene)
        if scene is None:
            raise ConfigurationError(f"{settings.GROUP}.scene", "", "a scene file: what is simulated has a dish")
        # What one callback may take, so that frames come and the others of this computer get on: else time lags.
        self._catch_up = max(MIN_CATCH_UP, CATCH_UP_FRAMES / settings.frame_rate)
        iterations = max(MIN_ITERATIONS, ITERATION_RATE / settings.frame_rate)
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
        self._publisher = FramePublisher(self, self.rig.camera, settings)
        topics.FAULT_REQUEST.subscribe(self, self.on_fault)
        self._scene = SceneFollower(self, self.health, scene, self.on_scene)
        if simulated:
            self._clocks = topics.CLOCK.publisher(self)
            self.create_timer(CLOCK_PERIOD / rate, self.on_clock, clock=self._steady)
        self.create_timer(1.0 / (settings.frame_rate * rate), self.on_frame, clock=self._steady)
        self.currents = RigCurrents(self, settings, self._steady, self._apply)
        self.get_logger().info("ready: everything here is simulated")

    def on_scene(self, scene: Scene) -> None:
        """Put another dish and other shapes around needle and thread, which stay where they are."""
        wait(self._rendering)
        self.rig.set_scene(scene)
        self._publisher.take(self.rig.camera)

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
        index = math.floor((elapsed - self._phase) * self._settings.frame_rate + EARLY)
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
            self._rendering.append(self._renderer.submit(self._publisher.publish, stamp, frame))

    def destroy_node(self) -> None:
        """End rendering, and remove the serial lines of simulated boards."""
        self._renderer.shutdown()
        try:
            self.currents.close()
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
            self._publisher.publish(stamp, frame)

    def _fail(self, error: MagnetosutureError) -> None:
        """Switch the coils off where the simulation does not find its next state, and say so."""
        self.rig.switch_off()
        self.health.error(str(error))


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(RigSimulatorNode, arguments)
