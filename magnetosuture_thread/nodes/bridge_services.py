"""Services of the coil bridge: arm, emergency stop, reset."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.errors import MagnetosutureError
from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, RESET


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
