"""Console node: serves the operator page on the graph of its ROS domain."""

from __future__ import annotations

import asyncio
import signal
import sys

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from magnetosuture_thread.console.server import ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import MagnetosutureError
from magnetosuture_thread.nodes.console_graph import ConsoleGraph
from magnetosuture_thread.nodes.console_host import NAME, GraphHost
from magnetosuture_thread.nodes.diagnostics import PERIOD, Health
from magnetosuture_thread.nodes.parameter_files import init, node_options
from magnetosuture_thread.nodes.parameters import declare


async def serve(node: Node, settings: ConsoleSettings) -> None:
    """Serve the page until the process is terminated; the needle is stopped first."""
    loop, terminated = asyncio.get_running_loop(), asyncio.Event()
    for which in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(which, terminated.set)
    graph = ConsoleGraph(node, settings)
    server = ConsoleServer(settings, graph, GraphHost(graph))
    url = await server.start()
    print(f"the operator's page: {url}", flush=True)
    health = Health(node)
    health.ok(f"serving on {settings.address}")
    try:
        while not terminated.is_set():
            graph.now()  # sets the clock for the stamp
            health.publish()
            try:
                await asyncio.wait_for(terminated.wait(), PERIOD)
            except asyncio.TimeoutError:
                continue
    finally:
        await server.stop()


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program; return 0 when it was terminated, 1 when it could not start."""
    node = None
    try:
        init(arguments, signal_handler_options=SignalHandlerOptions.NO)
        # Without an executor its parameter services could not answer.
        node = rclpy.create_node(NAME, **node_options(NAME, {"start_parameter_services": False}))
        asyncio.run(serve(node, declare(node, ConsoleSettings)))
    except (MagnetosutureError, ParameterException, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass  # before the page was there
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
