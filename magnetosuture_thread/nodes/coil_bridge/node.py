"""The node `coil_bridge`: filters needle velocity commands and drives the coils."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from magnetosuture_msgs.msg import SafetyMargins
from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer

from magnetosuture_thread import InvalidInputError, Scene
from magnetosuture_thread.coils.bridge import INPUTS, NEEDLE, OPERATOR, CoilBridge
from magnetosuture_thread.coils.coil_system import FINALIZED, UNCONFIGURED, CoilSystem
from magnetosuture_thread.coils.drivers import make_driver
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_bridge.report import BridgeServices, CoilReport
from magnetosuture_thread.nodes.coil_bridge.stop_file import stop_record
from magnetosuture_thread.nodes.lifecycle import ManagedNode
from magnetosuture_thread.nodes.run import raise_priority, run
from magnetosuture_thread.nodes.scene_follower import SceneFollower

INPUT_ERRORS = (InvalidInputError, ArithmeticError, ValueError)  # the last two in case a check is missing


class CoilBridgeNode(ManagedNode[CoilBridgeSettings]):
    """Drives the coils by filtered velocity commands while active and armed, and with zeros otherwise.

    Every command passes the needle's safety filter: those of an operator on `operator/servo_cv`, which have priority,
    and those of a planner or path follower on `needle/servo_cv`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("coil_bridge", CoilBridgeSettings, **options)
        with self.health.load("the bridge's kernels"):  # before any driver is open
            self.system = CoilSystem()
        self.system.recall(stop_record(self))
        self._stamps: dict[str, Any] = {}  # of the last valid command of each input
        self._reactivate = False  # whether a reset activates the node again
        # The watchdog has its own clock: simulated time may stand still, and the coils must not stay on.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watchdog: Timer | None = None
        self._report = CoilReport(self, self.system, self._steady)
        topics.NEEDLE_POSE.subscribe_numbered(self, self.on_pose)
        self._scene = SceneFollower(self, self.health, None, self.on_scene)
        topics.MARGINS.subscribe(self, self.on_margins)
        for topic, source in ((topics.OPERATOR_COMMAND, OPERATOR), (topics.NEEDLE_COMMAND, NEEDLE)):
            topic.subscribe_numbered(self, partial(self.on_command, source))
        BridgeServices(self, self.arm, self.stop, self.reset)
        self.system.import_barriers(self.get_parameter_or("barriers").value or ())
        self.start()
        self.system.arm_when_ready(self.settings is not None and self.settings.autostart == "armed")

    def allocate(self, settings: CoilBridgeSettings) -> None:
        """Open the driver; from now on it receives zeros periodically."""
        self.system.check_barriers(settings.barriers)
        self.system.recall(stop_record(self))
        self.system.remember()
        bridge = CoilBridge(settings, self.system.latch, self._scene.load(settings.scene))
        driver = make_driver(settings, len(bridge.coils), self._report.send_to_rig, self._report.count_rigs)
        self.system.open(settings, bridge, driver)
        self._watchdog = self.create_timer(1.0 / settings.rate, self.on_watchdog, clock=self._steady)

    def activate(self) -> None:
        """Activate, so that the bridge can be armed."""
        self.system.latch.activate()

    def deactivate(self) -> None:
        """Stop at once; activation and arming are needed again."""
        self._rest(self.system.latch.deactivate)

    def release(self) -> None:
        """Set the coils to zero, close the driver, and publish that."""
        if self._watchdog is not None:
            self.destroy_timer(self._watchdog)
        self._watchdog, self._reactivate = None, False
        self._stamps.clear()
        ends = self.is_shutting_down or self.has_ended
        final = self.system.close(FINALIZED if ends else UNCONFIGURED)
        if ends:
            self._report.report_unless(partial(self.system.remember, ends=True))
        if final is not None and self.context.ok():
            self._report.publish_output(None, final)
            self._report.publish_state(force=True)

    def may_start(self) -> bool:
        """Return whether nothing is latched from the process before; else a reset makes the node active."""
        self._reactivate = bool(self.system.latch.latched_reason)
        return not self._reactivate

    def arm(self, armed: bool) -> str:
        """Arm, or disarm; return what is wrong all the same."""
        if not armed:
            return self._rest(partial(self.system.arm, False))
        self.system.arm(True)
        self._step()
        return ""

    def stop(self) -> str:
        """Latch the emergency stop, in any state, also over a restart; return what is wrong all the same."""
        return self._rest(self.system.latch.stop)

    def reset(self) -> None:
        """Clear the emergency stop and faults; a node that they deactivated is active again, but disarmed."""
        self.system.reset()
        if self._reactivate and self.stage == "inactive":
            self.require(self.trigger_activate)
        self._reactivate = False
        self._step()

    def on_pose(self, message: PoseWithCovarianceStamped, number: int) -> None:
        """Register a needle pose, for the next currents."""
        if self.system.bridge is None:
            return
        try:
            pose = reading.needle_pose(message)
            covariance = reading.pose_covariance(message)
            self.system.bridge.on_pose(pose.tail, pose.heading, pose.stamp, number, *self._times(), covariance)
        except INPUT_ERRORS as error:
            self.refuse(error)

    def on_margins(self, message: SafetyMargins) -> None:
        """Register the thread's margins: slowdown by friction, and the scene of the prediction."""
        if (bridge := self.system.bridge) is None:
            return
        try:
            stamp = reading.checked_nanoseconds(message.header.stamp, "thread/margins.header.stamp") * 1e-9
            bridge.on_margins(stamp, message.valid, message.slowdown, message.scene_version, self._times()[1])
        except INPUT_ERRORS as error:
            self.refuse(error)

    def on_scene(self, scene: Scene) -> None:
        """Replace the scene, from the next step on."""
        if self.system.bridge is None:
            return
        self._step()  # first: a scene that waited while the process was frozen must not hide that it was
        self.system.zero()  # building the filter takes some milliseconds
        self.system.bridge.rest(*self._times())
        self.system.bridge.set_scene(scene)
        self._step()

    def on_command(self, source: str, message: TwistStamped, number: int) -> None:
        """Register a velocity command of an input, and follow it at once."""
        if self.system.bridge is None:
            return
        try:
            velocity = reading.plane_velocity(message, INPUTS[source])
            stamp = reading.checked_nanoseconds(message.header.stamp, f"{INPUTS[source]}.header.stamp") * 1e-9
            self.system.bridge.command(source, velocity, stamp, number, *self._times())
        except INPUT_ERRORS as error:
            self.refuse(error)
        else:
            self._stamps[source] = message.header.stamp
            self._step()

    def on_watchdog(self) -> None:
        """Apply the currents of the last valid command and pose."""
        self.system.timing.tick(self._times()[1])
        self._step()
        if self.system.latch.latched_reason and self.stage == "active":
            self._reactivate = True
            self.trigger_deactivate()

    def raise_priority(self) -> None:
        """Set the real-time priority of the loop; meant for a process of its own."""
        self._report.report_scheduling(raise_priority((self.settings or CoilBridgeSettings()).realtime_priority))

    def refuse(self, problem: Exception) -> None:
        """Report a message that was refused."""
        self._report.report_refused(problem)

    def _rest(self, switch: Callable[[], None]) -> str:
        """Come to rest by a switch, and only then wait for the disk; return what is wrong with that."""
        switch()
        self.system.zero()
        self._step()
        return self._report.report_unless(self.system.remember)

    def _step(self) -> None:
        """Compute, apply and publish the currents."""
        output = self.system.step(*self._times(), self._scene.problem)
        if output is not None and output.publish:
            self._report.publish_output(None if output.reasons else self._stamps.get(output.source), output)
        self._report.publish_state(force=False)

    def _times(self) -> tuple[float, float]:
        """Return the time of the stamps' clock and a monotonic time [s]."""
        return self.get_clock().now().nanoseconds * 1e-9, time.monotonic()


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(CoilBridgeNode, arguments, CoilBridgeNode.raise_priority)
