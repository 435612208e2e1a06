"""The node `coil_bridge`: filters needle velocity commands and drives the coils."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from magnetosuture_msgs.msg import SafetyMargins
from magnetosuture_msgs.srv import GivePulse
from rclpy.node import Node

from magnetosuture_thread import InvalidInputError, MagnetosutureError, Scene
from magnetosuture_thread.bags import packing, reading
from magnetosuture_thread.coils.bridge import INPUTS, NEEDLE, OPERATOR, BridgeOutput, CoilBridge
from magnetosuture_thread.coils.coil_system import FINALIZED, UNCONFIGURED, CoilSystem
from magnetosuture_thread.coils.drivers import DriverState, make_driver
from magnetosuture_thread.coils.latch import StopRecord
from magnetosuture_thread.coils.pulses import PulseBridge
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import ManagedNode, SceneFollower
from magnetosuture_thread.settings.interface import Service

# Keys of the report on /diagnostics.
PROCESS = "process"
JITTER_KEYS = tuple(f"loop jitter, {name} [ms]" for name in ("median", "99th percentile", "maximum"))


class CoilBridgeNode(ManagedNode[CoilBridgeSettings]):
    """Drives the coils by filtered velocity commands while active and armed, and with zeros otherwise.

    Every command passes the needle's safety filter: those of an operator on `operator/servo_cv`, which have priority,
    and those of a planner or path follower on `needle/servo_cv`. While a rig is commissioned pulses are given instead.
    """

    stands_by = False  # it reports what it does, in any state
    input_errors = (InvalidInputError, ArithmeticError, ValueError)  # the last two in case a check is missing

    def __init__(self, **options: Any) -> None:
        super().__init__("coil_bridge", CoilBridgeSettings, **options)
        with self.health.load("the bridge's kernels"):  # before any driver is open
            self.system = CoilSystem()
        self.system.recall(stop_record(self))
        self._kept = self.system.latch.latched_reason  # from the process before, until a reset
        self._stamps: dict[str, Any] = {}  # of the last valid command of each input
        self._reactivate = False  # whether a reset activates the node again
        self._refused, self._last_log = 0, ""
        self._last_state: object = None
        self._currents, self._setpoints = topics.CURRENTS.publisher(self), topics.NEEDLE_SETPOINT.publisher(self)
        self._states, self._filter = topics.BRIDGE_STATE.publisher(self), topics.FILTER_STATE.publisher(self)
        self._rig = topics.RIG_CURRENTS.publisher(self)
        self.health.note(**{PROCESS: f"{socket.gethostname()} {os.getpid()}"})
        self.every(0.1, lambda: self._publish_state(force=True))
        # Once before the loop runs: for its first line rclpy looks for its caller in all modules, which takes 0.1 s.
        self._log(self.system.closed, self.system.driver_state)
        topics.NEEDLE_POSE.subscribe_numbered(self, self.on_pose)
        self._scene = SceneFollower(self, self.on_scene)
        topics.MARGINS.subscribe(self, self.on_margins)
        for topic, source in ((topics.OPERATOR_COMMAND, OPERATOR), (topics.NEEDLE_COMMAND, NEEDLE)):
            topic.subscribe_numbered(self, partial(self.on_command, source), self._step)
        self.serve(Service.ARM, lambda request: self.arm(request.data), lambda request: request.data)
        self.serve(Service.EMERGENCY_STOP, lambda _: self.stop())
        self.serve(Service.RESET, lambda _: self.reset(), lambda _: True)
        self.serve(Service.PULSE, self.pulse, lambda _: True)
        self.system.import_barriers(self.get_parameter_or("barriers").value or ())
        self.start()
        self.system.arm_when_ready(self.settings is not None and self.settings.autostart == "armed")

    def allocate(self, settings: CoilBridgeSettings) -> None:
        """Open the driver; from now on it receives zeros periodically."""
        self.system.check_barriers(settings.barriers)
        self.system.recall(stop_record(self))
        self.system.remember()
        kind = PulseBridge if settings.commissioning else CoilBridge
        self.health.note(commissioning=settings.commissioning)
        bridge = kind(settings, self.system.latch, self._scene.load(settings.scene))
        driver = make_driver(settings, len(bridge.coils), self._send_to_rig, self._count_rigs)
        self.system.open(settings, bridge, driver)
        self.every(1.0 / settings.rate, self.on_watchdog)  # also while simulated time stands still

    def activate(self) -> None:
        """Activate, so that the bridge can be armed."""
        self.system.latch.activate()

    def deactivate(self) -> None:
        """Stop at once; activation and arming are needed again."""
        self._rest(self.system.latch.deactivate)

    def release(self) -> None:
        """Set the coils to zero, close the driver, and publish that."""
        self._reactivate = False
        self._stamps.clear()
        ends = self.is_shutting_down or self.has_ended
        final = self.system.close(FINALIZED if ends else UNCONFIGURED)
        if ends:
            self._remember(ends=True)
        if final is not None and self.context.ok():
            self._publish_output(None, final)
            self._publish_state(force=True)

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

    def reset(self) -> str:
        """Clear the emergency stop and faults; a node that they deactivated is active again, but disarmed."""
        self.system.reset()
        self._kept = ""
        if self._reactivate and self.stage == "inactive":
            self.require(self.trigger_activate)
        self._reactivate = False
        self._step()
        return ""

    def pulse(self, request: GivePulse.Request) -> str:
        """Give currents for a while."""
        bridge = self.system.bridge
        if not isinstance(bridge, PulseBridge):
            raise InvalidInputError(
                Service.PULSE, "a bridge that does not commission", "coil_bridge.commissioning true"
            )
        currents = np.asarray(request.current, dtype=float)
        bridge.pulse(currents, request.duration, *self._times(), self.system.driver_state)
        self._step()
        return ""

    def on_pose(self, message: PoseWithCovarianceStamped, number: int) -> None:
        """Register a needle pose, for the next currents."""
        if self.system.bridge is not None:
            pose, covariance = reading.needle_pose(message), reading.pose_covariance(message)
            self.system.bridge.on_pose(pose.tail, pose.heading, pose.stamp, number, *self._times(), covariance)

    def on_margins(self, message: SafetyMargins) -> None:
        """Register the thread's margins: slowdown by friction, and the scene of the prediction."""
        if self.system.bridge is not None:
            stamp = reading.checked_nanoseconds(message.header.stamp, "thread/margins.header.stamp") * 1e-9
            prediction = stamp, message.valid, message.slowdown, message.scene_version
            self.system.bridge.on_margins(*prediction, self._times()[1])

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
        """Register a velocity command of an input, which the next step follows."""
        if self.system.bridge is not None:
            command = reading.needle_command(message, INPUTS[source])
            stamp = reading.checked_nanoseconds(message.header.stamp, f"{INPUTS[source]}.header.stamp") * 1e-9
            self.system.bridge.command(source, command, stamp, number, *self._times())
            self._stamps[source] = message.header.stamp

    def on_watchdog(self) -> None:
        """Apply the currents of the last valid command and pose."""
        self.system.timing.tick(self._times()[1])
        self._step()
        if self.system.latch.latched_reason and self.stage == "active":
            self._reactivate = True
            self.trigger_deactivate()

    def refuse(self, problem: Exception) -> None:
        """Count and report a message that was refused."""
        self._refused += 1
        self.health.refuse(problem)

    def _rest(self, switch: Callable[[], None]) -> str:
        """Come to rest by a switch, and only then wait for the disk; return what is wrong with that."""
        switch()
        self.system.zero()
        self._step()
        return self._remember()

    def _remember(self, *, ends: bool = False) -> str:
        """Keep the latch over a restart, which must not hold up what comes after; return what is wrong with that."""
        try:
            self.system.remember(ends=ends)
        except MagnetosutureError as error:
            self.get_logger().error(str(error))
            return str(error)
        return ""

    def _step(self) -> None:
        """Compute, apply and publish the currents."""
        output = self.system.step(*self._times(), self._scene.problem)
        if output is not None and output.publish:
            self._publish_output(None if output.reasons else self._stamps.get(output.source), output)
        self._publish_state(force=False)

    def _times(self) -> tuple[float, float]:
        """Return the time of the stamps' clock and a monotonic time [s]."""
        return self.get_clock().now().nanoseconds * 1e-9, time.monotonic()

    def _send_to_rig(self, currents: np.ndarray) -> None:
        """Send currents to the simulated rig."""
        self._rig.publish(packing.packed_rig_currents(self.get_clock().now().to_msg(), currents))

    def _count_rigs(self) -> int:
        """Return the number of simulated rigs that subscribe; none after ROS has shut down."""
        return int(self._rig.get_subscription_count()) if self.context.ok() else 0

    def _publish_output(self, command: Time | None, output: BridgeOutput) -> None:
        """Publish the output of a step; `command` is the stamp of the command that it follows, if any."""
        stamp = self.get_clock().now().to_msg()
        self._currents.publish(packing.packed_currents(stamp, command, output))
        self._setpoints.publish(packing.packed_twist(stamp, output.applied))
        self._filter.publish(packing.packed_filter_state(command or stamp, output))

    def _publish_state(self, *, force: bool) -> None:
        """Publish the state if it has changed, or if forced."""
        system = self.system
        latch, output, driver = system.latch, system.output, system.driver_state
        reasons = () if output is None else output.reasons
        scene = "" if system.bridge is None else system.bridge.scene_version
        closed = "" if output else system.closed
        now = (latch.state, latch.stop_reason, closed, reasons, driver.ready, driver.problem, driver.warnings, scene)
        if now == self._last_state and not force:
            return
        stamp = self.get_clock().now().to_msg()
        self._states.publish(packing.packed_bridge_state(stamp, system, driver, self._refused))
        self._last_state = now
        if output is not None and not output.publish:
            self._filter.publish(packing.packed_filter_state(stamp, output))
        # Over the last seconds, NaN without a message; negative where the sender's clock is ahead.
        aged = (*INPUTS.values(), topics.NEEDLE_POSE.name)
        ages = {} if system.bridge is None else system.bridge.stamp_ages.minimum(time.monotonic())
        self.health.note(
            **{key: round(value, 3) for key, value in zip(JITTER_KEYS, system.timing.jitter_ms, strict=True)},
            **{f"minimum age of {name} [ms]": round(1e3 * ages.get(name, math.nan), 1) for name in aged},
            **{"driver": system.driver_name, "scene": scene or "none", "driver problem": driver.problem or "none"},
        )
        self._log(closed or latch.state.value, driver)
        if latch.latched_reason:
            self.health.error(self._fault())
        elif closed:
            self.health.ok(closed)
        elif not driver.ready:
            self.health.warn(f"{latch.stop_reason or 'armed'}; driver: {driver.problem}")
        elif latch.stop_reason:
            self.health.ok(latch.stop_reason)
        elif reasons:
            self.health.warn(f"stopped: {'; '.join(reasons)}")
        elif driver.warnings:
            self.health.warn(f"following commands; driver: {'; '.join(driver.warnings)}")
        else:
            self.health.ok("following commands")

    def _fault(self) -> str:
        """Return what is latched, and the way out of what has stayed so over a restart."""
        kept = f", kept over a restart; call {Service.RESET}, then {Service.ARM}" if self._kept else ""
        return f"fault: {self.system.latch.latched_reason}{kept}"

    def _log(self, state: str, driver: DriverState) -> None:
        """Log changes of state and driver, as a record of incidents: a fault as an error, a driver's as a warning."""
        latch, logger = self.system.latch, self.get_logger()
        text = self._fault() if latch.latched_reason else f"{state}{', armed' if latch.armed else ''}"
        text += f"; driver {self.system.driver_name}: {'ready' if driver.ready else driver.problem}"
        if text == self._last_log:
            return
        self._last_log = text
        if latch.latched_reason:
            logger.error(text)
        elif driver.ready or self.system.bridge is None:
            logger.info(text)
        else:
            logger.warning(text)


def stop_record(node: Node) -> StopRecord:
    """Return the record of a bridge: by its parameter, or else by the names of node and graph, one for each robot."""
    if name := str(node.get_parameter_or("stop_file").value or ""):
        return StopRecord(Path(os.path.expanduser(name)))
    home = os.environ.get("XDG_STATE_HOME", "")
    state = Path(home if os.path.isabs(home) else os.path.expanduser("~/.local/state"))
    name = node.get_fully_qualified_name().strip("/").replace("/", ".")
    return StopRecord(state / "magnetosuture" / f"{name}.domain_{node.context.get_domain_id()}.stop")
