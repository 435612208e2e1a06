"""Services, states and diagnostics of the coil bridge."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import CoilCurrents
from rclpy.clock import Clock
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.coils.bridge import INPUTS, BridgeOutput
from magnetosuture_thread.coils.coil_system import CoilSystem
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, RESET
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.node import PackageNode


class BridgeServices:
    """Service servers for arm and disarm, emergency stop, and reset.

    A callback refuses by raising `MagnetosutureError`, whose text is the response; one that succeeds may return a text
    about what is wrong all the same.

    Args:
        node: of the services.
        arm: arms or disarms.
        stop: latches the emergency stop.
        reset: clears the emergency stop and faults.
    """

    def __init__(
        self,
        node: Node,
        arm: Callable[[bool], str | None],
        stop: Callable[[], str | None],
        reset: Callable[[], str | None],
    ) -> None:
        node.create_service(SetBool, ARM, lambda request, response: _respond(response, lambda: arm(request.data)))
        node.create_service(Trigger, EMERGENCY_STOP, lambda _, response: _respond(response, stop))
        node.create_service(Trigger, RESET, lambda _, response: _respond(response, reset))


def _respond(response: Any, act: Callable[[], str | None]) -> Any:
    try:
        response.message = act() or ""
    except MagnetosutureError as error:
        response.success, response.message = False, str(error)
    else:
        response.success = True
    return response


FAULT_PREFIX = "fault: "


SCHEDULING = "scheduling"


JITTER_KEYS = tuple(f"loop jitter, {name} [ms]" for name in ("median", "99th percentile", "maximum"))


# Over the last seconds, NaN without a message; negative where the sender's clock is ahead.
AGE_KEY = "minimum age of {topic} [ms]"
AGED_TOPICS = (*INPUTS.values(), topics.NEEDLE_POSE.name)


STATE_PERIOD = 0.1  # s between two messages of an unchanged state


class CoilReport:
    """Publishes currents, state and diagnostics of the coil bridge.

    Args:
        node: the coil bridge.
        system: bridge, driver and latch.
        steady: a clock that does not depend on /clock.
    """

    def __init__(self, node: PackageNode, system: CoilSystem, steady: Clock) -> None:
        self._node = node
        self._system = system
        self._health = node.health
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
        self._log(system.closed, system.driver_state)

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

    def report_unless(self, act: Callable[[], object]) -> str:
        """Do what may fail but must not hold up what comes after; log and return the problem, empty if none."""
        try:
            act()
        except MagnetosutureError as error:
            self._node.get_logger().error(str(error))
            return str(error)
        return ""

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
            "" if output else system.closed,
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
        ages = {} if system.bridge is None else system.bridge.stamp_ages.minimum(time.monotonic())
        self._health.note(**{AGE_KEY.format(topic=t): round(1e3 * ages.get(t, math.nan), 1) for t in AGED_TOPICS})
        self._health.note(
            driver=system.driver_name, scene=scene or "none", **{"driver problem": driver.problem or "none"}
        )
        self._last_state = now
        self._log(latch.state.value if output else system.closed, driver)
        if latch.latched_reason:
            self._health.error(f"{FAULT_PREFIX}{latch.latched_reason}")
        elif output is None:
            self._health.ok(system.closed)
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
