"""A node that asks every other node for an answer, again and again, and presses the emergency stop."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.clock import Clock, ClockType
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread.interface import ARM, EMERGENCY_STOP, RESET
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.nodes.run import run

PERIOD = 0.02  # s between two questions
STOP_EVERY = 50  # questions
LIMIT = 3.0  # s without an answer, after which the next question is asked
READY, STOP, UNARMED = "ready", "stop", "unarmed"


class ProbeNode(GuardedNode):
    """Prints a line for each answer: the node's name, or `STOP`, and the seconds until the answer came.

    It prints `READY` once all nodes have answered: while kernels compile, a node answers nobody. The bridge is armed
    before each emergency stop; where that was not possible, `UNARMED` is printed. Parameter: `nodes`, their names.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("probe", **options)
        names = self.declare_parameter("nodes", [""]).value
        self._nodes = {name: self.create_client(GetParameters, f"{name}/get_parameters") for name in names}
        self._stop = self.create_client(Trigger, EMERGENCY_STOP)
        self._reset = self.create_client(Trigger, RESET)
        self._arm = self.create_client(SetBool, ARM)
        self._turns = itertools.cycle(names)
        self._asked = 0
        self._silent = set(names)  # who have not answered yet
        self._since: float | None = None
        self._then: Callable[[Any, float], None] = lambda answer, delay: None
        self._future: Any = None
        self.create_timer(PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _look(self) -> None:
        """Ask the next question, unless the last one waits for its answer."""
        if self._since is not None:
            if time.monotonic() - self._since > LIMIT:
                self._future.cancel()
                self._answered(None, LIMIT)
        elif self._silent:
            name = next(self._turns)
            if self._nodes[name].service_is_ready() and self._stop.service_is_ready() and self._arm.service_is_ready():
                self._ask(self._nodes[name], GetParameters.Request(), lambda answer, delay: self._greet(name, answer))
        elif self._asked % STOP_EVERY == 0:
            self._ask(self._reset, Trigger.Request(), lambda answer, delay: self._on_reset())
        else:
            name = next(self._turns)
            request = GetParameters.Request(names=["use_sim_time"])
            self._ask(self._nodes[name], request, lambda answer, delay: self._print(name, delay))

    def _ask(self, client: Any, request: Any, then: Callable[[Any, float], None]) -> None:
        self._since, self._then = time.monotonic(), then
        self._future = client.call_async(request)
        # The time is taken when the answer is there, not at the next look.
        self._future.add_done_callback(self._on_answer)

    def _on_answer(self, future: Any) -> None:
        if future is self._future and self._since is not None:
            self._answered(future.result(), time.monotonic() - self._since)

    def _answered(self, answer: Any, delay: float) -> None:
        self._since = None
        self._then(answer, delay)

    def _on_reset(self) -> None:
        self._ask(self._arm, SetBool.Request(data=True), lambda answer, delay: self._on_armed(answer))

    def _on_armed(self, answer: Any) -> None:
        if answer is None or not answer.success:
            print(UNARMED, flush=True)
        self._ask(self._stop, Trigger.Request(), lambda answer, delay: self._print(STOP, delay))

    def _greet(self, name: str, answer: Any) -> None:
        if answer is not None:
            self._silent.discard(name)
        if not self._silent:
            print(READY, flush=True)

    def _print(self, name: str, delay: float) -> None:
        self._asked += 1
        print(name, f"{delay:.6f}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(ProbeNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
