"""The node `coil_bridge`: forwards needle velocity commands to the coil driver."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from magnetosuture_msgs.msg import CoilCurrents, SafetyMargins
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread import InvalidInputError, MagnetosutureError, Scene
from magnetosuture_thread.coils.bridge import INPUTS, NEEDLE, OPERATOR, BridgeOutput, CoilBridge
from magnetosuture_thread.coils.coil_system import CoilSystem
from magnetosuture_thread.coils.drivers import DriverState, make_driver
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, RESET
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.lifecycle import ManagedNode
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.run import raise_priority, run
from magnetosuture_thread.nodes.scene_follower import SceneFollower


class BridgeServices:
    """Service servers for arm and disarm, emergency stop, and reset.

    A callback refuses by raising `MagnetosutureError`, whose text is the response.

    Args:
        node: of the services.
        arm: arms or disarms.
        stop: latches the emergency stop.
        reset: clears the emergency stop and faults.
    """

    def __init__(
        self, node: Node, arm: Callable[[bool], None], stop: Callable[[], None], reset: Callable[[], None]
    ) -> None:
        node.create_service(SetBool, ARM, lambda request, response: _respond(response, lambda: arm(request.data)))
        node.create_service(Trigger, EMERGENCY_STOP, lambda _, response: _respond(response, stop))
        node.create_service(Trigger, RESET, lambda _, response: _respond(response, reset))


def _respond(response: Any, act: Callable[[], None]) -> Any:
    try:
        act()
    except MagnetosutureError as error:
        response.success, response.message = False, str(error)
    else:
        response.success = True
    return response


FAULT_PREFIX = "fault: "
SCHEDULING = "scheduling"
JITTER_KEYS = tuple(f"loop jitter, {name} [ms]" for name in ("median", "99th percentile", "maximum"))
STATE_PERIOD = 0.1  # s between two messages of an unchanged state


class CoilReport:
    """Publishes currents, state and diagnostics of the coil bridge.

    Args:
        node: the coil bridge.
        system: bridge, driver and latch.
        steady: a clock that does not depend on /clock.

    Attributes:
        health: of the node, on /diagnostics.
    """

    def __init__(self, node: Node, system: CoilSystem, steady: Clock) -> None:
        self._node = node
        self._system = system
        self.health = self._health = Health(node)
        self._refused = 0
        self._last_state: object = None
        self._last_log = ""
        self._setpoints = topics.NEEDLE_SETPOINT.publisher(node)
        self._currents = topics.CURRENTS.publisher(node)
        self._states = topics.BRIDGE_STATE.publisher(node)
        self._filter = topics.FILTER_STATE.publisher(node)
        self._rig = topics.RIG_CURRENTS.publisher(node)
        node.create_timer(STATE_PERIOD, lambda: self.publish_state(force=True), clock=steady)
        # Once before the loop runs: for its first line rclpy looks for its caller in all modules, which takes 0.1 s.
        self._log("unconfigured", system.driver_state)

    def send_to_rig(self, currents: np.ndarray) -> None:
        """Send currents to the simulated rig."""
        header = MESSAGES.header(self._node.get_clock().now().to_msg())
        self._rig.publish(CoilCurrents(header=header, current=currents.tolist()))

    def count_rigs(self) -> int:
        """Return the number of simulated rigs that subscribe; none after ROS has shut down."""
        return int(self._rig.get_subscription_count()) if self._node.context.ok() else 0

    def report_scheduling(self, scheduling: str) -> None:
        """Log how the process is scheduled."""
        self._health.note(**{SCHEDULING: scheduling})
        self._node.get_logger().info(f"{SCHEDULING}: {scheduling}")

    def report_refused(self, problem: Exception) -> None:
        """Count and report a refused message."""
        self._refused += 1
        self._health.refuse(problem)

    def publish_output(self, command: Time | None, output: BridgeOutput) -> None:
        """Publish the output of a step; `command` is the stamp of the command that it follows, if any."""
        stamp = self._node.get_clock().now().to_msg()
        self._currents.publish(MESSAGES.currents_message(stamp, command, output))
        self._setpoints.publish(MESSAGES.twist_message(stamp, output.applied))
        self._filter.publish(MESSAGES.filter_message(command or stamp, output))

    def publish_state(self, *, force: bool) -> None:
        """Publish the state if it has changed, or if forced."""
        system = self._system
        latch, output, driver = system.latch, system.output, system.driver_state
        reasons = () if output is None else output.reasons
        scene = "" if system.bridge is None else system.bridge.scene_version
        now = (
            latch.state,
            latch.stop_reason,
            output is None,
            reasons,
            driver.ready,
            driver.problem,
            driver.warnings,
            scene,
        )
        changed = now != self._last_state
        if not changed and not force:
            return
        stamp = self._node.get_clock().now().to_msg()
        self._states.publish(MESSAGES.state_message(stamp, system, driver, self._refused))
        if output is not None and not output.publish:
            self._filter.publish(MESSAGES.filter_message(stamp, output))
        jitter = zip(JITTER_KEYS, system.timing.jitter_ms, strict=True)
        self._health.note(**{key: round(value, 3) for key, value in jitter})
        self._health.note(
            driver=system.driver_name, scene=scene or "none", **{"driver problem": driver.problem or "none"}
        )
        self._last_state = now
        self._log(latch.state.value if output else "unconfigured", driver)
        if latch.latched_reason:
            self._health.error(f"{FAULT_PREFIX}{latch.latched_reason}")
        elif output is None:
            self._health.ok("unconfigured")
        elif not driver.ready:
            self._health.warn(f"{latch.stop_reason or 'armed'}; driver: {driver.problem}")
        elif latch.stop_reason:
            self._health.ok(latch.stop_reason)
        elif reasons:
            self._health.warn(f"stopped: {'; '.join(reasons)}")
        elif driver.warnings:
            self._health.warn(f"following commands; driver: {'; '.join(driver.warnings)}")
        else:
            self._health.ok("following commands")

    def _log(self, state: str, driver: DriverState) -> None:
        """Log changes of state and driver, as a record of incidents."""
        latch = self._system.latch
        text = f"{state}{', armed' if latch.armed else ''}{f': {latch.latched_reason}' if latch.latched_reason else ''}"
        text += f"; driver {self._system.driver_name}: {'ready' if driver.ready else driver.problem}"
        if text != self._last_log:
            self._last_log = text
            self._node.get_logger().info(text)


INPUT_ERRORS = (InvalidInputError, ArithmeticError, ValueError)  # the last two in case a check is missing


class CoilBridgeNode(ManagedNode[CoilBridgeSettings]):
    """Drives the coils by filtered velocity commands while active and armed, and with zeros otherwise.

    Every command passes the needle's safety filter: those of an operator on `operator/servo_cv`, which have priority,
    and those of a planner or path follower on `needle/servo_cv`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("coil_bridge", CoilBridgeSettings, **options)
        self.system = CoilSystem()
        self._stamps: dict[str, Any] = {}  # of the last valid command of each input
        self._reactivate = False  # whether a reset activates the node again
        # The watchdog has its own clock: simulated time may stand still, and the coils must not stay on.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watchdog: Timer | None = None
        self._report = CoilReport(self, self.system, self._steady)
        topics.NEEDLE_POSE.subscribe_numbered(self, self.on_pose)
        self._scene = SceneFollower(self, self._report.health, None, self.on_scene)
        topics.MARGINS.subscribe(self, self.on_margins)
        for topic, source in ((topics.OPERATOR_COMMAND, OPERATOR), (topics.NEEDLE_COMMAND, NEEDLE)):
            topic.subscribe_numbered(self, partial(self.on_command, source))
        BridgeServices(self, self.arm, self.stop, self.reset)
        self.start()
        if self.settings is not None and self.settings.autostart == "armed":
            self.system.arm_when_ready()

    def begin(self, settings: CoilBridgeSettings) -> None:
        """Open the driver; from now on it receives zeros periodically."""
        bridge = CoilBridge(settings, self.system.latch, self._scene.load(settings.scene))
        driver = make_driver(settings, len(bridge.coils), self._report.send_to_rig, self._report.count_rigs)
        self.system.open(settings, bridge, driver)
        self._watchdog = self.create_timer(1.0 / settings.rate, self.on_watchdog, clock=self._steady)

    def resume(self) -> None:
        """Activate, so that the bridge can be armed."""
        self.system.latch.activate()

    def pause(self) -> None:
        """Stop at once; activation and arming are needed again."""
        self.system.latch.deactivate()
        self.system.zero()
        self._step()

    def end(self) -> None:
        """Set the coils to zero and close the driver."""
        if self._watchdog is not None:
            self.destroy_timer(self._watchdog)
        self._watchdog, self._reactivate = None, False
        self._stamps.clear()
        self.system.close()

    def arm(self, armed: bool) -> None:
        """Arm or disarm."""
        self.system.arm(armed)
        self._step()

    def stop(self) -> None:
        """Latch the emergency stop, in any state."""
        self.system.latch.stop()
        self.system.zero()
        self._step()

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
            self.system.bridge.extrapolator.update(
                pose.tail, pose.heading, pose.stamp, number, *self._times(), covariance
            )
        except INPUT_ERRORS as error:
            self._report.report_refused(error)

    def on_margins(self, message: SafetyMargins) -> None:
        """Register the thread's margins: slowdown by friction, and the scene of the prediction."""
        if self.system.bridge is None:
            return
        try:
            stamp, arrival = reading.seconds(message.header.stamp), self._times()[1]
            self.system.bridge.on_margins(stamp, message.valid, message.slowdown, message.scene_version, arrival)
        except INPUT_ERRORS as error:
            self._report.report_refused(error)

    def on_scene(self, scene: Scene) -> None:
        """Replace the scene, from the next step on."""
        if self.system.bridge is None:
            return
        self.system.zero()  # building the filter takes some milliseconds
        self.system.bridge.set_scene(scene)
        self._step()

    def on_command(self, source: str, message: TwistStamped, number: int) -> None:
        """Register a velocity command of an input, and follow it at once."""
        if self.system.bridge is None:
            return
        try:
            velocity = reading.plane_velocity(message, INPUTS[source])
            stamp = reading.checked_nanoseconds(message.header.stamp, INPUTS[source]) * 1e-9
            self.system.bridge.command(source, velocity, stamp, number, *self._times())
        except INPUT_ERRORS as error:
            self._report.report_refused(error)
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

    def destroy_node(self) -> None:
        """Set the coils to zero and close the driver."""
        try:
            self.end()
        finally:
            super().destroy_node()

    def _step(self) -> None:
        """Compute, apply and publish the currents."""
        output = self.system.step(*self._times())
        if output is not None and output.publish:
            self._report.publish_output(None if output.reasons else self._stamps.get(output.source), output)
        self._report.publish_state(force=False)

    def _times(self) -> tuple[float, float]:
        """Return the time of the stamps' clock and a monotonic time [s]."""
        return self.get_clock().now().nanoseconds * 1e-9, self._steady.now().nanoseconds * 1e-9


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(CoilBridgeNode, arguments, CoilBridgeNode.raise_priority)


if __name__ == "__main__":
    sys.exit(main())
