"""The coil bridge node: needle velocity commands in, coil currents out."""

from __future__ import annotations

import sys
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from magnetosuture_thread.coils.allocation import Allocation
from magnetosuture_thread.coils.drivers import make_driver
from magnetosuture_thread.coils.gate import CommandGate, Setpoint
from magnetosuture_thread.coils.needle import NeedleWatch
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run


class CoilBridgeNode(Node):
    """Forwards velocity commands to the coils, and zeros as soon as they cease."""

    def __init__(self, **options: Any) -> None:
        super().__init__("coil_bridge", automatically_declare_parameters_from_overrides=True, **options)
        settings = declare(self, CoilBridgeSettings)
        self._coils = settings.allocation()
        self._needle = NeedleWatch(settings.needle(), settings.pose_timeout, settings.reach)
        self._gate = CommandGate(settings.command_timeout, settings.max_speed, settings.zero_hold)
        self.driver = make_driver(settings)
        self._health = Health(self)
        # The watchdog runs on a clock of its own: simulated time may stand still, the coils must not stay on.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._setpoints = topics.NEEDLE_SETPOINT.publisher(self)
        self._currents = topics.CURRENTS.publisher(self)
        topics.NEEDLE_POSE.subscribe(self, self.on_pose)
        topics.NEEDLE_COMMAND.subscribe(self, self.on_command)
        self.create_timer(1.0 / settings.rate, self.on_watchdog, clock=self._steady)
        self._following = False
        self._period, self._applied = 1.0 / settings.rate, 0.0
        self._health.ok("no command yet", driver=settings.driver)
        self.driver.open()  # last, so that nothing can fail and leave it open

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Take the needle's pose, for the next currents."""
        try:
            pose = messages.needle_pose(message)
            self._needle.see(pose.tail, pose.heading, pose.stamp, self._now(), self._arrival())
        except InvalidInputError as error:
            self._health.refuse(error)

    def on_command(self, message: TwistStamped) -> None:
        """Take a velocity command and apply it at once."""
        try:
            velocity = messages.command_velocity(message)
            self._gate.accept(velocity, messages.seconds(message.header.stamp), self._now(), self._arrival())
        except InvalidInputError as error:
            self._health.refuse(error)
            return
        self._following = True
        self._apply(message.header.stamp)

    def on_watchdog(self) -> None:
        """Lay the field along the needle as it lies now; stop when no good command or pose has come for too long."""
        # A command has just been applied: two in a row would only cost time.
        if self._arrival() - self._applied > 0.9 * self._period:
            self._apply(self.get_clock().now().to_msg())

    def destroy_node(self) -> None:
        """Leave the coils at zero."""
        try:
            self.driver.close()
        finally:
            super().destroy_node()

    def _apply(self, stamp: Time) -> None:
        setpoint = self._gate.setpoint(self._arrival())
        if not setpoint.send:
            return
        allocation, stop = self._allocate(setpoint)
        if stop and self._following:
            self._health.warn(f"stopped: {stop}")
        elif self._following:
            self._health.ok("following commands", saturated=allocation.saturated)
        self._following = not setpoint.stop
        self.driver.apply(allocation.currents)
        self._applied = self._arrival()
        self._needle.move(allocation.velocity)
        self._currents.publish(messages.currents_message(stamp, self._coils.names, allocation, stop))
        self._setpoints.publish(messages.twist_message(stamp, allocation.velocity))

    def _allocate(self, setpoint: Setpoint) -> tuple[Allocation, str]:
        """Return the currents for a setpoint, and why they are zero, if they are a stop."""
        if setpoint.stop:
            return self._coils.zero(), setpoint.stop
        pose = self._needle.pose(self._now(), self._arrival())
        if pose is None:
            return self._coils.zero(), "no needle pose"
        return self._coils.allocate(setpoint.velocity, pose.tail, pose.heading), ""

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds * 1e-9)

    def _arrival(self) -> float:
        return float(self._steady.now().nanoseconds * 1e-9)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(CoilBridgeNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
