"""What the coil bridge tells: currents and velocities, its state, its health."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import CoilCurrents
from rclpy.clock import Clock
from rclpy.node import Node

from magnetosuture_thread.coils.bridge import Outcome
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.station import CoilStation
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.messages import MESSAGES

FAULT = "fault: "
SCHEDULING = "scheduling"
LOOP = tuple(f"loop off its period, {name} [ms]" for name in ("median", "99th percentile", "greatest"))
TELLING = 0.1  # s between two messages of the state, where nothing changes


class CoilReport:
    """Publishes for the coil bridge.

    Args:
        node: the coil bridge.
        station: what it has in hand.
        steady: a clock that runs whatever /clock does.

    Attributes:
        health: of the node, on /diagnostics.
    """

    def __init__(self, node: Node, station: CoilStation, steady: Clock) -> None:
        self._node = node
        self._station = station
        self.health = self._health = Health(node)
        self._refused = 0
        self._told: object = None
        self._logged = ""
        self._setpoints = topics.NEEDLE_SETPOINT.publisher(node)
        self._currents = topics.CURRENTS.publisher(node)
        self._states = topics.BRIDGE_STATE.publisher(node)
        self._filter = topics.FILTER_STATE.publisher(node)
        self._rig = topics.RIG_CURRENTS.publisher(node)
        node.create_timer(TELLING, lambda: self.state(anyway=True), clock=steady)
        # Once before the loop runs: for its first line rclpy looks for its caller in all modules, which takes 0.1 s.
        self._log("unconfigured", station.driver_state)

    def to_rig(self, currents: np.ndarray) -> None:
        """Send currents to the simulated rig."""
        header = MESSAGES.header(self._node.get_clock().now().to_msg())
        self._rig.publish(CoilCurrents(header=header, current=currents.tolist()))

    def rigs(self) -> int:
        """Return how many simulated rigs listen; none any more once ROS itself has ended."""
        return int(self._rig.get_subscription_count()) if self._node.context.ok() else 0

    def scheduled(self, how: str) -> None:
        """Say how the process is scheduled."""
        self._health.note(**{SCHEDULING: how})
        self._node.get_logger().info(f"{SCHEDULING}: {how}")

    def refuse(self, problem: Exception) -> None:
        """Say that a message was refused."""
        self._refused += 1
        self._health.refuse(problem)

    def applied(self, command: Time | None, outcome: Outcome) -> None:
        """Say what the coils were told; `command` is the stamp of the command that they follow, if they do."""
        stamp = self._node.get_clock().now().to_msg()
        self._currents.publish(MESSAGES.currents_message(stamp, command, outcome))
        self._setpoints.publish(MESSAGES.twist_message(stamp, outcome.applied))
        self._filter.publish(MESSAGES.filter_message(command or stamp, outcome))

    def state(self, *, anyway: bool) -> None:
        """Publish the state if it has changed, or anyway."""
        station = self._station
        latch, outcome, driver = station.latch, station.outcome, station.driver_state
        reasons = () if outcome is None else outcome.reasons
        scene = "" if station.bridge is None else station.bridge.scene_version
        now = (
            latch.condition,
            latch.holds,
            outcome is None,
            reasons,
            driver.ready,
            driver.problem,
            driver.warnings,
            scene,
        )
        changed = now != self._told
        if not changed and not anyway:
            return
        stamp = self._node.get_clock().now().to_msg()
        self._states.publish(MESSAGES.state_message(stamp, station, driver, self._refused))
        if outcome is not None and not outcome.publish:
            self._filter.publish(MESSAGES.filter_message(stamp, outcome))
        self._health.note(
            **{key: round(value, 3) for key, value in zip(LOOP, station.rhythm.milliseconds, strict=True)}
        )
        self._health.note(
            driver=station.driver_name, scene=scene or "none", **{"driver problem": driver.problem or "none"}
        )
        self._told = now
        self._log(latch.condition.value if outcome else "unconfigured", driver)
        if latch.latched:
            self._health.error(f"{FAULT}{latch.latched}")
        elif outcome is None:
            self._health.ok("unconfigured")
        elif not driver.ready:
            self._health.warn(f"{latch.holds or 'armed'}; driver: {driver.problem}")
        elif latch.holds:
            self._health.ok(latch.holds)
        elif reasons:
            self._health.warn(f"stopped: {'; '.join(reasons)}")
        elif driver.warnings:
            self._health.warn(f"following commands; driver: {'; '.join(driver.warnings)}")
        else:
            self._health.ok("following commands")

    def _log(self, condition: str, driver: DriverState) -> None:
        """Log what a person would ask for after an incident, as it changes."""
        latch = self._station.latch
        text = f"{condition}{', armed' if latch.armed else ''}{f': {latch.latched}' if latch.latched else ''}"
        text += f"; driver {self._station.driver_name}: {'ready' if driver.ready else driver.problem}"
        if text != self._logged:
            self._logged = text
            self._node.get_logger().info(text)
