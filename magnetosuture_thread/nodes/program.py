"""Runs a node as a program, by its name: `ros2 run`, or `python -m magnetosuture_thread.nodes.program NAME`.

What needs ROS is imported where it is used: a program that is asked to end while it loads ends at once, without a word.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.nodes.processes import STOPS
from magnetosuture_thread.settings.errors import missing_module
from magnetosuture_thread.settings.interface import ALL_NODES

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.node import GuardedNode

LOADING_GRACE = 1.0  # s to end in order for a process that is asked to while it loads
DELIVERY_TIMEOUT = 0.2  # s for the last messages of all nodes to be acknowledged

MAKERS = {name: f"{name.title().replace('_', '')}Node" for name in ALL_NODES} | {"perception": "perception"}
"""What each program makes and runs, by its name, in the module of that name; beside the console."""


def main() -> int:
    """Run the node that has the name of this program.

    To import it takes seconds. It has no currents and is in no graph meanwhile, and leaves without a traceback. When it
    has ended, further signals are ignored: Python gives their default actions back before it is gone, and a terminal's
    Ctrl-C reaches each node twice, from the terminal and from launch.

    Returns:
        The node's exit code; 1 with one line on standard error where ROS, or another package, is not installed.
    """
    name = Path(sys.argv[0]).name
    for which in STOPS:
        if signal.getsignal(which) is not signal.SIG_IGN:
            signal.signal(which, lambda number, frame: os._exit(0))
    try:
        try:
            module = import_module(f"magnetosuture_thread.nodes.{name}")
        except ModuleNotFoundError as error:
            print(f"error: {missing_module(error)}", file=sys.stderr)
            return 1
        return run(getattr(module, MAKERS.get(name, "ConsoleNode")))
    finally:
        for which in STOPS:
            signal.signal(which, signal.SIG_IGN)


def run(make: Callable[[], GuardedNode | tuple[GuardedNode, ...]], arguments: Sequence[str] | None = None) -> int:
    """Run a node, or several in one process, until it is interrupted, terminated, hung up, or shut down.

    A node then publishes its final messages while the graph is still there: see `GuardedNode.finish`. One that is asked
    to end while it starts ends once it has started, or after `LOADING_GRACE` if it loads or compiles.

    rclpy's own handlers would take the nodes out of the graph at once, before they can publish their final messages. A
    signal raises nothing: a KeyboardInterrupt out of a library that calls Python comes out as another error, or is
    lost. A worker hears of it, as Python runs no handler while the compiler is at work. It wakes the executor, and ends
    a process that goes on loading. No coil has a current then: see `Health.load`.

    Args:
        make: makes the node, or all of them.
        arguments: of the command line; those of the process if None.

    Returns:
        0 when it was asked to end, 1 with one line on standard error when it could not start or go on.
    """
    import rclpy
    from rclpy.duration import Duration
    from rclpy.exceptions import ParameterException
    from rclpy.executors import ExternalShutdownException
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.signals import SignalHandlerOptions

    from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
    from magnetosuture_thread.nodes.node import Health
    from magnetosuture_thread.nodes.parameters import init

    nodes: tuple[GuardedNode, ...] = ()
    executor: KeptWaitSetExecutor | None = None
    is_ending = threading.Event()
    woken, written = os.pipe2(os.O_CLOEXEC)

    def end() -> None:
        os.read(woken, 1)
        is_ending.set()
        while True:
            if executor is not None:
                with suppress(Exception):  # it is gone already
                    executor.wake()
            time.sleep(LOADING_GRACE)
            if Health.loading:
                os._exit(0)

    try:
        os.set_blocking(written, False)
        signal.set_wakeup_fd(written, warn_on_full_buffer=False)
        threading.Thread(target=end, name="signals", daemon=True).start()
        for which in STOPS:
            # Of those that are ignored only SIGHUP stays so, as by nohup: what a shell runs in the background ignores
            # SIGINT, but a node's parent ends it by that.
            if which is not signal.SIGHUP or signal.getsignal(which) is not signal.SIG_IGN:
                signal.signal(which, lambda number, frame: None)
        init(arguments, signal_handler_options=SignalHandlerOptions.NO)
        made = make()
        nodes = made if isinstance(made, tuple) else (made,)
        executor = KeptWaitSetExecutor()
        for node in nodes:
            executor.add_node(node)
        # What was loaded stays; to look through it for garbage again and again takes tens of milliseconds.
        gc.collect()
        gc.freeze()
        for node in nodes:
            node.take_priority()
        nodes[0].spin(executor, lambda: is_ending.is_set() or all(node.has_ended for node in nodes))
        for node in nodes:
            node.finish()
        until = time.monotonic() + DELIVERY_TIMEOUT
        for node in nodes:
            for publisher in node.publishers:
                publisher.wait_for_all_acked(Duration(seconds=max(0.0, until - time.monotonic())))
    except ExternalShutdownException:  # something else in this process has shut the context down
        return 0
    except Exception as error:
        is_shut_down = not rclpy.ok()
        if nodes and is_shut_down and isinstance(error, rclpy_implementation.RCLError):
            return 0  # a callback was still at work when the context was shut down
        # rclpy raises several kinds, some private, for a broken file or parameter.
        cannot_start = not nodes and (isinstance(error, ValueError) or is_shut_down)
        if not (cannot_start or isinstance(error, (MagnetosutureError, ParameterException))):
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    finally:
        if executor is not None:
            executor.shutdown()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in (*MAKERS, "console"):
        sys.exit(f"error: expected one of {', '.join((*MAKERS, 'console'))}")
    sys.argv = sys.argv[1:]
    sys.exit(main())
