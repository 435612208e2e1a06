"""Between the coil bridge's messages and its core's own types."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import CoilBridgeState, CoilCurrents, FilterState
from rclpy.serialization import deserialize_message

from magnetosuture_thread.coils.bridge import Outcome
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import Condition
from magnetosuture_thread.coils.station import CoilStation
from magnetosuture_thread.nodes.messages import header, vector

_STATES = {
    Condition.INACTIVE: CoilBridgeState.STATE_INACTIVE,
    Condition.ACTIVE: CoilBridgeState.STATE_ACTIVE,
    Condition.FAULT: CoilBridgeState.STATE_FAULT,
}


def currents_message(stamp: Time, command: Time | None, outcome: Outcome) -> CoilCurrents:
    """Return coil currents with the stamp of the command that they follow, or why they are zero."""
    return CoilCurrents(
        header=header(stamp),
        coil=list(outcome.coils),
        current=outcome.allocation.currents.tolist(),
        stop="; ".join(outcome.reasons),
        saturated=outcome.allocation.saturated,
        command=command or Time(),
    )


def filter_message(stamp: Time, outcome: Outcome) -> FilterState:
    """Return what became of the command; `stamp` is the command's, or the time now where there is none."""
    return FilterState(
        header=header(stamp),
        source=outcome.source,
        commanded=vector(outcome.commanded),
        filtered=vector(outcome.filtered),
        applied=vector(outcome.applied),
        slowdown=outcome.slowdown,
        active=list(outcome.active),
        overridden=outcome.overridden,
        reason=outcome.reason,
    )


def state_message(stamp: Time, station: CoilStation, driver: DriverState, refused: int) -> CoilBridgeState:
    """Return what the bridge does and why.

    Args:
        stamp: of the message.
        station: what the bridge has in hand.
        driver: what its driver knows.
        refused: messages so far.
    """
    latch, outcome = station.latch, station.outcome
    message = CoilBridgeState(
        header=header(stamp),
        state=_STATES[latch.condition],
        armed=latch.armed,
        emergency_stopped=latch.emergency,
        driver=station.driver_name,
        driver_ready=driver.ready,
        driver_warnings=list(driver.warnings),
        supply_voltage=list(driver.voltages),
        refused=refused,
        scene_version="" if station.bridge is None else station.bridge.scene_version,
    )
    if driver.currents is not None:
        message.measured_current = driver.currents.tolist()
    if outcome is None:
        message.state = message.state if latch.latched else CoilBridgeState.STATE_UNCONFIGURED
        message.reasons = [latch.latched or "unconfigured"]
        return message
    message.reasons = list(outcome.reasons)
    message.commanded = vector(outcome.commanded)
    message.filtered = vector(outcome.filtered)
    message.applied = vector(outcome.applied)
    message.saturated = outcome.allocation.saturated
    message.current = outcome.allocation.currents.tolist()
    return message


def command_stamp(data: bytes) -> int | None:
    """Return the stamp of the command that serialised currents follow [ns]; None if they follow none."""
    command = deserialize_message(data, CoilCurrents).command
    return (command.sec * 1_000_000_000 + command.nanosec) or None
