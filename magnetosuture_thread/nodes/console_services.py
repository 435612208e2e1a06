"""Asynchronous calls of the graph's services from an asyncio loop, without blocking it."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, PAUSE_REPLAY, PAUSE_RIG, RESET

TIMEOUT = 10.0  # s for a service to be found and to answer
RETRY_PERIOD = 0.5  # s without an answer, after which it is called again
POLL_PERIOD = 0.005  # s between two checks for an answer

_TYPES = {ARM: SetBool, EMERGENCY_STOP: Trigger, RESET: Trigger, PAUSE_REPLAY: SetBool, PAUSE_RIG: SetBool}
ACTIONS: dict[str, tuple[str, Any]] = {
    "arm": (ARM, SetBool.Request(data=True)),
    "disarm": (ARM, SetBool.Request(data=False)),
    "stop": (EMERGENCY_STOP, Trigger.Request()),
    "reset": (RESET, Trigger.Request()),
}


class ConsoleServices:
    """Clients of the coil bridge's services, and of those that pause time.

    The clients are created at once, so that the emergency stop is discovered before it is needed.

    Args:
        node: that calls.
    """

    def __init__(self, node: Node) -> None:
        self._clients = {name: node.create_client(kind, name) for name, kind in _TYPES.items()}
        self._answers: dict[str, dict[int, Any]] = {name: {} for name in _TYPES}
        self._turn = 0

    def ready(self, name: str) -> bool:
        """Return whether a service is available."""
        return bool(self._clients[name].service_is_ready())

    async def execute_action(self, action: str) -> str:
        """Execute one of `ACTIONS`; return an empty text, or the reason of a refusal.

        The latest action has priority: one that still waits for its answer is cancelled.
        """
        self._turn += 1
        turn = self._turn
        name, request = ACTIONS[action]
        return await self._call(name, request, lambda: self._turn == turn)

    async def set_paused(self, name: str, paused: bool) -> str:
        """Pause or resume time by one of the services `PAUSE_REPLAY` and `PAUSE_RIG`."""
        return await self._call(name, SetBool.Request(data=paused), lambda: True)

    async def _call(self, name: str, request: Any, is_current: Any) -> str:
        client, answers = self._clients[name], self._answers[name]
        calls: list[int] = []
        deadline, retry_at = time.monotonic() + TIMEOUT, 0.0
        while (now := time.monotonic()) < deadline:
            if not is_current():
                return "cancelled by a later action"
            if now >= retry_at and client.service_is_ready():
                # The services may be called repeatedly: a lost answer blocks nothing.
                with client.handle:
                    calls.append(client.handle.send_request(request))
                retry_at = now + RETRY_PERIOD
            await asyncio.sleep(POLL_PERIOD)
            self._collect(name)
            for number in calls:
                if number in answers:
                    answer = answers.pop(number)
                    return "" if answer.success else str(answer.message) or "refused"
        if not calls:
            return f"no service {name} within {TIMEOUT:g} s"
        return f"{name} did not answer within {TIMEOUT:g} s"

    def _collect(self, name: str) -> None:
        """Collect answers of all calls."""
        client = self._clients[name]
        with client.handle:
            while True:
                header, answer = client.handle.take_response(client.srv_type.Response)
                if header is None:
                    return
                self._answers[name][header.request_id.sequence_number] = answer
