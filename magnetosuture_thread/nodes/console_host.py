"""Host of the operator page on a graph that is already running, and the node that joins the graph."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from magnetosuture_thread.interface import PAUSE_REPLAY, PAUSE_RIG
from magnetosuture_thread.nodes.console_graph import ConsoleGraph

NAME = "console"
RIG = "rig_simulator"


@contextmanager
def joined(*, domain: int | None = None, simulated_clock: bool = False) -> Iterator[Node]:
    """Create a node in a graph, without an executor.

    Args:
        domain: the graph's ROS domain; the one that the environment names if None.
        simulated_clock: whether its time is that of /clock.
    """
    context = Context()
    rclpy.init(context=context, domain_id=domain, args=[], signal_handler_options=SignalHandlerOptions.NO)
    clock = [Parameter("use_sim_time", value=simulated_clock)]
    # Without an executor its parameter services could not answer.
    node = rclpy.create_node(NAME, context=context, parameter_overrides=clock, start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


class GraphHost:
    """Host of a graph that is already running: setups cannot be selected, and time pauses only if its nodes can.

    Args:
        graph: to serve.
    """

    mode = "graph"

    def __init__(self, graph: ConsoleGraph) -> None:
        self.graph = graph
        self.paused = False

    def state(self) -> dict[str, Any]:
        """Return what is running and which requests are possible; see `console.graph`."""
        if self.paused and not self._pause_service():
            self.paused = False
        return {
            "mode": self.mode,
            "setup": "",
            "setups": [],
            "can_pause": bool(self._pause_service()),
            "paused": self.paused,
            "can_record": False,
            "recording": "",
            "busy": "",
            "simulated": self.graph.is_active(RIG),
        }

    async def select_setup(self, setup: str) -> str:
        """Refuse: this graph is not started from the page."""
        return f"setup: got {setup!r}, expected none, as this graph is not started from the page"

    async def set_paused(self, paused: bool) -> str:
        """Pause or resume time if a node of the graph can; return the reason of a refusal."""
        name = self._pause_service()
        if not name:
            return "no node of this graph can pause time"
        refusal = await self.graph.services.set_paused(name, paused)
        if not refusal:
            self.paused = paused
        return refusal

    async def set_recording(self, recording: bool) -> str:
        """Refuse: this node records no bags."""
        return "the node console writes no bags; `magnetosuture console --graph` does"

    def _pause_service(self) -> str:
        """Return the service that pauses time; empty if there is none."""
        ready = (name for name in (PAUSE_REPLAY, PAUSE_RIG) if self.graph.services.ready(name))
        return next(ready, "")
