"""Between the coil bridge's messages and its core's own types."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped, Vector3
from magnetosuture_msgs.msg import CoilBridgeState, CoilCurrents
from rclpy.serialization import deserialize_message

from magnetosuture_thread.coils.bridge import Outcome
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import Condition
from magnetosuture_thread.coils.station import CoilStation
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.nodes.messages import header, require_dish_frame

_STATES = {
    Condition.INACTIVE: CoilBridgeState.STATE_INACTIVE,
    Condition.ACTIVE: CoilBridgeState.STATE_ACTIVE,
    Condition.FAULT: CoilBridgeState.STATE_FAULT,
}


def command_velocity(message: TwistStamped) -> np.ndarray:
    """Return a velocity command in the dish plane, shape (2,) [m/s].

    Raises:
        InvalidInputError: wrong frame, or a motion that the needle cannot make: out of the plane, or a turn
            apart from that which the tip's velocity amounts to.
    """
    require_dish_frame(message.header.frame_id, "needle/servo_cv")
    linear, angular = message.twist.linear, message.twist.angular
    others = [linear.z, angular.x, angular.y, angular.z]
    if any(value != 0.0 for value in others):
        raise InvalidInputError("needle/servo_cv.twist", f"linear.z, angular = {others}", "zeros: x and y alone count")
    return np.array([linear.x, linear.y])


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
    )
    if driver.currents is not None:
        message.measured_current = driver.currents.tolist()
    if outcome is None:
        message.state = message.state if latch.latched else CoilBridgeState.STATE_UNCONFIGURED
        message.reasons = [latch.latched or "unconfigured"]
        return message
    message.reasons = list(outcome.reasons)
    message.commanded = _vector(outcome.commanded)
    message.applied = _vector(outcome.applied)
    message.reached = _vector(outcome.allocation.velocity)
    message.saturated = outcome.allocation.saturated
    message.current = outcome.allocation.currents.tolist()
    return message


def _vector(velocity: np.ndarray) -> Vector3:
    return Vector3(x=float(velocity[0]), y=float(velocity[1]))


def command_stamp(data: bytes) -> int | None:
    """Return the stamp of the command that serialised currents follow [ns]; None if they follow none."""
    command = deserialize_message(data, CoilCurrents).command
    return (command.sec * 1_000_000_000 + command.nanosec) or None
