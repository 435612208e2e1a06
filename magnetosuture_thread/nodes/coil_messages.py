"""Conversion between the coil bridge's messages and the types of its core."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import CoilBridgeState, CoilCurrents, FilterState
from rclpy.serialization import deserialize_message

from magnetosuture_thread.coils.bridge import BridgeOutput
from magnetosuture_thread.coils.coil_system import CoilSystem
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import ArmingState
from magnetosuture_thread.nodes.messages import header, vector

_STATES = {
    ArmingState.INACTIVE: CoilBridgeState.STATE_INACTIVE,
    ArmingState.ACTIVE: CoilBridgeState.STATE_ACTIVE,
    ArmingState.FAULT: CoilBridgeState.STATE_FAULT,
}


def currents_message(stamp: Time, command: Time | None, output: BridgeOutput) -> CoilCurrents:
    """Return coil currents with the stamp of the command that they follow, or why they are zero."""
    return CoilCurrents(
        header=header(stamp),
        coil=list(output.coils),
        current=output.allocation.currents.tolist(),
        stop="; ".join(output.reasons),
        saturated=output.allocation.saturated,
        command=command or Time(),
    )


def filter_message(stamp: Time, output: BridgeOutput) -> FilterState:
    """Return the filtered command as a message; `stamp` is the command's, or the time now where there is none."""
    return FilterState(
        header=header(stamp),
        source=output.source,
        commanded=vector(output.commanded),
        filtered=vector(output.filtered),
        applied=vector(output.applied),
        slowdown=output.slowdown,
        active=list(output.active),
        overridden=output.overridden,
        reason=output.reason,
    )


def state_message(stamp: Time, system: CoilSystem, driver: DriverState, refused: int) -> CoilBridgeState:
    """Return the state of the bridge as a message.

    Args:
        stamp: of the message.
        system: bridge, driver and latch.
        driver: state of the driver.
        refused: messages so far.
    """
    latch, output = system.latch, system.output
    message = CoilBridgeState(
        header=header(stamp),
        state=_STATES[latch.state],
        armed=latch.armed,
        emergency_stopped=latch.emergency,
        driver=system.driver_name,
        driver_ready=driver.ready,
        driver_warnings=list(driver.warnings),
        supply_voltage=list(driver.voltages),
        refused=refused,
        scene_version="" if system.bridge is None else system.bridge.scene_version,
    )
    if driver.currents is not None:
        message.measured_current = driver.currents.tolist()
    if output is None:
        message.state = message.state if latch.latched_reason else CoilBridgeState.STATE_UNCONFIGURED
        message.reasons = [latch.latched_reason or "unconfigured"]
        return message
    message.reasons = list(output.reasons)
    message.commanded = vector(output.commanded)
    message.filtered = vector(output.filtered)
    message.applied = vector(output.applied)
    message.saturated = output.allocation.saturated
    message.current = output.allocation.currents.tolist()
    return message


def command_stamp(data: bytes) -> int | None:
    """Return the stamp of the command that serialised currents follow [ns]; None if they follow none."""
    command = deserialize_message(data, CoilCurrents).command
    return (command.sec * 1_000_000_000 + command.nanosec) or None
