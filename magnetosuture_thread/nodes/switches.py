"""The coil bridge's switches: services that a button can call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.errors import MagnetosutureError
from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, RESET


class Switches:
    """Offers arm and disarm, emergency stop, and reset.

    An action raises `MagnetosutureError` to refuse; whoever asked gets its text.

    Args:
        node: that gets the services.
        arm: lets commands pass, or no more.
        stop: presses the emergency stop.
        reset: forgets it, and faults.
    """

    def __init__(
        self, node: Node, arm: Callable[[bool], None], stop: Callable[[], None], reset: Callable[[], None]
    ) -> None:
        node.create_service(SetBool, ARM, lambda asked, answer: _answer(answer, lambda: arm(asked.data)))
        node.create_service(Trigger, EMERGENCY_STOP, lambda _, answer: _answer(answer, stop))
        node.create_service(Trigger, RESET, lambda _, answer: _answer(answer, reset))


def _answer(answer: Any, act: Callable[[], None]) -> Any:
    try:
        act()
    except MagnetosutureError as error:
        answer.success, answer.message = False, str(error)
    else:
        answer.success = True
    return answer
