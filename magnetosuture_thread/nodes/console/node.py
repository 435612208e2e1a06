"""The node `console`: serves the operator page for a running graph."""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.console.server import ConsoleServer, serve_until
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.interface import PAUSE_REPLAY, PAUSE_RIG
from magnetosuture_thread.nodes.console.graph import ConsoleGraph
from magnetosuture_thread.nodes.diagnostics import PERIOD, Health
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.nodes.parameter_files import init, node_options
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import end_signals

NAME = "console"
RIG = "rig_simulator"
REQUEST_PERIOD = 0.05  # s between two looks for requests to the node's parameter services
# rclpy's own service of types is answered by an executor only.
NO_SERVICE = [Parameter("start_type_description_service", value=False)]


@contextmanager
def joined(*, domain: int | None = None, namespace: str = "", simulated_clock: bool = False) -> Iterator[Node]:
    """Create a node in a graph, without an executor.

    Args:
        domain: the graph's ROS domain; the one that the environment names if None.
        namespace: of the graph, where it is in one.
        simulated_clock: whether its time is that of /clock.
    """
    context = Context()
    rclpy.init(context=context, domain_id=domain, args=[], signal_handler_options=SignalHandlerOptions.NO)
    parameters = [*NO_SERVICE, Parameter("use_sim_time", value=simulated_clock)]
    options = {"parameter_overrides": parameters, "start_parameter_services": False}
    node = rclpy.create_node(NAME, context=context, namespace=namespace, **options)
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
        can_pause = bool(self._pause_service())
        self.paused = self.paused and can_pause
        return {
            "mode": self.mode,
            "setup": "",
            "setups": [],
            "can_pause": can_pause,
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
        refusal = await self.graph.services.call(name, SetBool.Request(data=paused))
        if not refusal:
            self.paused = paused
        return refusal

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Refuse: this node records no bags."""
        return "the node console writes no bags; `magnetosuture console --graph` does"

    def _pause_service(self) -> str:
        """Return the service that pauses time; empty if there is none."""
        return next((name for name in (PAUSE_REPLAY, PAUSE_RIG) if self.graph.services.ready(name)), "")


def answer_requests(node: Node) -> None:
    """Answer what waits at the node's services, those of its parameters: no executor does."""
    for service in node.services:
        with service.handle:
            request, header = service.handle.service_take_request(service.srv_type.Request)
            if header is not None:
                service.send_response(service.callback(request, service.srv_type.Response()), header)


async def _serve(node: Node, settings: ConsoleSettings) -> None:
    """Serve the page until the process is asked to end; answer the node's services and publish its health."""
    graph, health = ConsoleGraph(node, settings), Health(node)
    health.ok(f"serving on {settings.address}")
    due = time.monotonic()

    async def watch() -> None:
        nonlocal due
        answer_requests(node)
        if time.monotonic() >= due:
            due = time.monotonic() + PERIOD
            graph.now()  # sets the clock for the stamp
            health.publish()

    def report(url: str) -> None:
        print(f"the operator's page: {url}", flush=True)

    await serve_until(end_signals(), ConsoleServer(settings, graph, GraphHost(graph)), watch, REQUEST_PERIOD, report)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program; return 0 when it was terminated, 1 when it could not start."""
    node = None
    for which in end_signals():  # also amid the start
        signal.signal(which, signal.default_int_handler)
    try:
        init(arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = GuardedNode(NAME, **node_options(NAME, {"parameter_overrides": NO_SERVICE}))
        asyncio.run(_serve(node, declare(node, ConsoleSettings)))
    except KeyboardInterrupt:
        return 0
    except (MagnetosutureError, ParameterException, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
