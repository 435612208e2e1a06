"""Presses the graph's switches from an asyncio loop, which never waits for one."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, PAUSE_REPLAY, PAUSE_RIG, RESET

TIMEOUT = 10.0  # s for a switch to be found and to answer
AGAIN = 0.5  # s without an answer, after which it is pressed again
LOOK = 0.005  # s between two looks for an answer

_KINDS = {ARM: SetBool, EMERGENCY_STOP: Trigger, RESET: Trigger, PAUSE_REPLAY: SetBool, PAUSE_RIG: SetBool}
ACTIONS: dict[str, tuple[str, Any]] = {
    "arm": (ARM, SetBool.Request(data=True)),
    "disarm": (ARM, SetBool.Request(data=False)),
    "stop": (EMERGENCY_STOP, Trigger.Request()),
    "reset": (RESET, Trigger.Request()),
}


class ConsoleSwitches:
    """The services of the coil bridge, and those that let time stand still.

    They are looked for from the beginning, so that the emergency stop is found when it is needed.

    Args:
        node: that asks.
    """

    def __init__(self, node: Node) -> None:
        self._clients = {name: node.create_client(kind, name) for name, kind in _KINDS.items()}
        self._answers: dict[str, dict[int, Any]] = {name: {} for name in _KINDS}
        self._turn = 0

    def ready(self, name: str) -> bool:
        """Return whether a switch is there."""
        return bool(self._clients[name].service_is_ready())

    async def act(self, action: str) -> str:
        """Do one of `ACTIONS`; return an empty text, or the refusal.

        Whoever presses last is right: an action that still waits for its answer is given up.
        """
        self._turn += 1
        turn = self._turn
        name, request = ACTIONS[action]
        return await self._press(name, request, lambda: self._turn == turn)

    async def pause(self, name: str, still: bool) -> str:
        """Let the time of one of the services `PAUSE_REPLAY` and `PAUSE_RIG` stand still, or go on."""
        return await self._press(name, SetBool.Request(data=still), lambda: True)

    async def _press(self, name: str, request: Any, wanted: Any) -> str:
        client, answers = self._clients[name], self._answers[name]
        pressed: list[int] = []
        deadline, again = time.monotonic() + TIMEOUT, 0.0
        while (now := time.monotonic()) < deadline:
            if not wanted():
                return "something else was asked for meanwhile"
            if now >= again and client.service_is_ready():
                # A switch does no harm if it is pressed again: nothing waits for an answer that got lost.
                with client.handle:
                    pressed.append(client.handle.send_request(request))
                again = now + AGAIN
            await asyncio.sleep(LOOK)
            self._collect(name)
            for number in pressed:
                if number in answers:
                    answer = answers.pop(number)
                    return "" if answer.success else str(answer.message) or "refused"
        if not pressed:
            return f"nobody offers {name} within {TIMEOUT:g} s"
        return f"{name} did not answer within {TIMEOUT:g} s"

    def _collect(self, name: str) -> None:
        """Take answers that have come, whichever press they are to."""
        client = self._clients[name]
        with client.handle:
            while True:
                header, answer = client.handle.take_response(client.srv_type.Response)
                if header is None:
                    return
                self._answers[name][header.request_id.sequence_number] = answer
