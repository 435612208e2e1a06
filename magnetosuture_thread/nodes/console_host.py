"""Who serves the page on a graph that others run, and how a process joins a graph for it."""

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
    """Give a node in a graph, that no executor spins.

    Args:
        domain: the graph's ROS domain; the one that the environment names if None.
        simulated_clock: whether its time is that of /clock.
    """
    context = Context()
    rclpy.init(context=context, domain_id=domain, args=[], signal_handler_options=SignalHandlerOptions.NO)
    clock = [Parameter("use_sim_time", value=simulated_clock)]
    # Nobody would answer who asks for its parameters.
    node = rclpy.create_node(NAME, context=context, parameter_overrides=clock, start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


class GraphHost:
    """A graph that others run: nothing can be chosen, and time stands still only where its nodes can let it.

    Args:
        graph: that is looked at.
    """

    mode = "graph"

    def __init__(self, graph: ConsoleGraph) -> None:
        self.graph = graph
        self.paused = False

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now; see `console.graph`."""
        if self.paused and not self._pause():
            self.paused = False
        return {
            "mode": self.mode,
            "scenario": "",
            "scenarios": [],
            "can_pause": bool(self._pause()),
            "paused": self.paused,
            "can_record": False,
            "recording": "",
            "busy": "",
            "simulated": self.graph.says(RIG),
        }

    async def choose(self, scenario: str) -> str:
        """Refuse: who runs the graph chooses."""
        return f"scenario: got {scenario!r}, expected none, as this graph is run by others"

    async def pause(self, still: bool) -> str:
        """Let time stand still, or go on, where a node of the graph can do so; return the refusal if none can."""
        name = self._pause()
        if not name:
            return "nothing in this graph can let time stand still"
        refusal = await self.graph.switches.pause(name, still)
        if not refusal:
            self.paused = still
        return refusal

    async def record(self, on: bool) -> str:
        """Refuse: bags are written by whoever runs the graph."""
        return "the node console writes no bags; `magnetosuture console --graph` does"

    def _pause(self) -> str:
        """Return the service that lets time stand still here; an empty text if there is none."""
        ready = (name for name in (PAUSE_REPLAY, PAUSE_RIG) if self.graph.switches.ready(name))
        return next(ready, "")
