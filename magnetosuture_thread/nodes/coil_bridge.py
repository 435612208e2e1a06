"""The coil bridge node: needle velocity commands in, filtered, coil currents out."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from magnetosuture_msgs.msg import SafetyMargins
from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer

from magnetosuture_thread.coils.bridge import INPUTS, NEEDLE, OPERATOR, Bridge
from magnetosuture_thread.coils.drivers import make_driver
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.coils.station import CoilStation
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.coil_report import CoilReport
from magnetosuture_thread.nodes.lifecycle import ManagedNode
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower
from magnetosuture_thread.nodes.scheduling import take_priority
from magnetosuture_thread.nodes.switches import Switches
from magnetosuture_thread.scene import Scene

UNUSABLE = (InvalidInputError, ArithmeticError, ValueError)  # the last two where a check has been forgotten


class CoilBridgeNode(ManagedNode[CoilBridgeSettings]):
    """Forwards velocity commands to the coils while active and armed, and zeros as soon as they cease.

    Every command passes the needle's safety filter, whoever sent it: an operator's on `operator/servo_cv`, which are
    followed first, and those of a planner or path follower on `needle/servo_cv`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("coil_bridge", CoilBridgeSettings, **options)
        self.station = CoilStation()
        self._stamps: dict[str, Any] = {}  # of the last good command of each input
        self._resumes = False  # whether a reset makes it active again
        # A clock of its own for the watchdog: simulated time may stand still, the coils must not stay on.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watchdog: Timer | None = None
        self._report = CoilReport(self, self.station, self._steady)
        topics.NEEDLE_POSE.subscribe_numbered(self, self.on_pose)
        self._scene = SceneFollower(self, self._report.health, None, self.on_scene)
        topics.MARGINS.subscribe(self, self.on_margins)
        for topic, source in ((topics.OPERATOR_COMMAND, OPERATOR), (topics.NEEDLE_COMMAND, NEEDLE)):
            topic.subscribe_numbered(self, partial(self.on_command, source))
        Switches(self, self.arm, self.stop, self.reset)
        self.start()
        if self.settings is not None and self.settings.autostart == "armed":
            self.station.arm_when_ready()

    def begin(self, settings: CoilBridgeSettings) -> None:
        """Open the driver; from now on it is told zero again and again."""
        bridge = Bridge(settings, self.station.latch, self._scene.load(settings.scene))
        driver = make_driver(settings, len(bridge.coils), self._report.to_rig, self._report.rigs)
        self.station.open(settings, bridge, driver)
        self._watchdog = self.create_timer(1.0 / settings.rate, self.on_watchdog, clock=self._steady)

    def resume(self) -> None:
        """Let the bridge be armed."""
        self.station.latch.activate()

    def pause(self) -> None:
        """Stop at once, and pass nothing until somebody activates and arms again."""
        self.station.latch.deactivate()
        self.station.zero()
        self._step()

    def end(self) -> None:
        """Leave the coils at zero."""
        if self._watchdog is not None:
            self.destroy_timer(self._watchdog)
        self._watchdog, self._resumes = None, False
        self._stamps.clear()
        self.station.close()

    def arm(self, asked: bool) -> None:
        """Let commands pass that come from now on, or none."""
        self.station.arm(asked)
        self._step()

    def stop(self) -> None:
        """Press the emergency stop, in whatever state."""
        self.station.latch.stop()
        self.station.zero()
        self._step()

    def reset(self) -> None:
        """Forget the emergency stop and faults; a node that they made inactive is active again, but not armed."""
        self.station.reset()
        if self._resumes and self.stage == "inactive":
            self.require(self.trigger_activate)
        self._resumes = False
        self._step()

    def on_pose(self, message: PoseWithCovarianceStamped, number: int) -> None:
        """Take the needle's pose, for the next currents."""
        if self.station.bridge is None:
            return
        try:
            pose = reading.needle_pose(message)
            covariance = reading.pose_covariance(message)
            self.station.bridge.needle.see(pose.tail, pose.heading, pose.stamp, number, *self._times(), covariance)
        except UNUSABLE as error:
            self._report.refuse(error)

    def on_margins(self, message: SafetyMargins) -> None:
        """Take the thread's friction, and the scene that it is predicted in."""
        if self.station.bridge is None:
            return
        try:
            stamp, arrival = reading.seconds(message.header.stamp), self._times()[1]
            self.station.bridge.on_margins(stamp, message.valid, message.slowdown, message.scene_version, arrival)
        except UNUSABLE as error:
            self._report.refuse(error)

    def on_scene(self, scene: Scene) -> None:
        """Keep the needle within another scene, from the next step on."""
        if self.station.bridge is None:
            return
        self.station.zero()  # what is built of the scene takes some milliseconds
        self.station.bridge.set_scene(scene)
        self._step()

    def on_command(self, source: str, message: TwistStamped, number: int) -> None:
        """Take a velocity command of an input, and follow it at once."""
        if self.station.bridge is None:
            return
        try:
            velocity = reading.plane_velocity(message, INPUTS[source])
            stamp = reading.checked_nanoseconds(message.header.stamp, INPUTS[source]) * 1e-9
            self.station.bridge.command(source, velocity, stamp, number, *self._times())
        except UNUSABLE as error:
            self._report.refuse(error)
        else:
            self._stamps[source] = message.header.stamp
            self._step()

    def on_watchdog(self) -> None:
        """Ask the coils for what the last good command and pose amount to now."""
        self.station.rhythm.tick(self._times()[1])
        self._step()
        if self.station.latch.latched and self.stage == "active":
            self._resumes = True
            self.trigger_deactivate()

    def take_priority(self) -> None:
        """Let the loop not wait for other processes; meant for a process of its own."""
        self._report.scheduled(take_priority((self.settings or CoilBridgeSettings()).realtime_priority))

    def destroy_node(self) -> None:
        """Leave the coils at zero."""
        try:
            self.end()
        finally:
            super().destroy_node()

    def _step(self) -> None:
        """Apply what the bridge says now, and tell."""
        outcome = self.station.step(*self._times())
        if outcome is not None and outcome.publish:
            self._report.applied(None if outcome.reasons else self._stamps.get(outcome.source), outcome)
        self._report.state(anyway=False)

    def _times(self) -> tuple[float, float]:
        """Return the time of the stamps' clock and a monotonic time [s]."""
        return self.get_clock().now().nanoseconds * 1e-9, self._steady.now().nanoseconds * 1e-9


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(CoilBridgeNode, arguments, CoilBridgeNode.take_priority)


if __name__ == "__main__":
    sys.exit(main())
