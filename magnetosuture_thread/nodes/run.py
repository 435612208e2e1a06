"""Runs a node as a program: one-line errors, a clean end, exit codes."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType
from typing import TypeVar

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from magnetosuture_thread.errors import MagnetosutureError
from magnetosuture_thread.nodes.parameter_files import init

N = TypeVar("N", bound="Node | tuple[Node, ...]")


def run(
    make: Callable[[], N], arguments: Sequence[str] | None = None, made: Callable[[N], None] = lambda node: None
) -> int:
    """Run a node, or several in one process, until it is interrupted.

    Args:
        make: makes the node, or all of them.
        arguments: of the command line; those of the process if None.
        made: called with what was made; for what concerns the whole process.

    Returns:
        0 when it was asked to end, 1 when it could not start.
    """
    spins = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        # rclpy hears the signal first, and ends the executor. A KeyboardInterrupt as well, amid a message that its
        # library makes in Python, would come out as another error.
        if not spins:
            raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    try:
        init(arguments)
    except Exception as error:  # rclpy raises several kinds, some private, for a broken parameter file.
        print(f"error: {_one_line(error)}", file=sys.stderr)
        return 1
    nodes: tuple[Node, ...] = ()
    executor = None
    try:
        result = make()
        nodes = result if isinstance(result, tuple) else (result,)
        made(result)
        # The multi-threaded executor loses messages in the wheels of Jazzy.
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        # What was loaded stays; to look through it for garbage again and again takes tens of milliseconds.
        gc.collect()
        gc.freeze()
        spins = True
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except rclpy_implementation.RCLError:
        if rclpy.ok():
            raise  # else a callback was still at work when the node was asked to end
    except (MagnetosutureError, ParameterException) as error:
        print(f"error: {_one_line(error)}", file=sys.stderr)
        return 1
    except ValueError as error:
        if nodes:
            raise
        # rclpy's own word for a parameter that has no value, as an empty list.
        print(f"error: a parameter cannot be declared: {_one_line(error)}", file=sys.stderr)
        return 1
    finally:
        if executor is not None:
            executor.shutdown()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
