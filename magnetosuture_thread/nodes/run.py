"""Runs a node as a program: one-line errors, a clean end, exit codes, priority."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.nodes.node import GuardedNode, Health
from magnetosuture_thread.nodes.parameters import init
from magnetosuture_thread.nodes.program import STOPS

LOADING_GRACE = 1.0  # s to end in order for a process that is asked to while it loads
DELIVERY_TIMEOUT = 0.2  # s for the last messages of all nodes to be acknowledged


class Interruption:
    """Keeps the signals that interrupt this process until it is asked whether one came.

    The library behind rclpy calls Python to make and convert messages, and has its own idea of an exception there: a
    KeyboardInterrupt comes out as another error, or is lost. Signals that are ignored, or that end the process
    without a word to Python, are left as they are, and outside the main thread, which gets none, so are all.
    """

    def __init__(self) -> None:
        self._asked = False
        self._before: list[tuple[signal.Signals, Callable[[int, FrameType | None], Any]]] = []

    def __enter__(self) -> Interruption:
        """Begin to keep signals."""
        if threading.current_thread() is threading.main_thread():
            handlers = [(which, signal.getsignal(which)) for which in STOPS]
            self._before = [(which, handler) for which, handler in handlers if callable(handler)]
            for which, _ in self._before:
                signal.signal(which, self._keep)
        return self

    def __exit__(self, *error: object) -> None:
        """Keep no more; raise for one that came, unless something was raised already.

        Raises:
            KeyboardInterrupt: a signal came.
        """
        for which, handler in self._before:
            signal.signal(which, handler)
        if error[0] is None:
            self.check()

    def check(self) -> None:
        """Raise if a signal came.

        Raises:
            KeyboardInterrupt: one came.
        """
        if self._asked:
            self._asked = False
            raise KeyboardInterrupt

    def _keep(self, number: int, frame: FrameType | None) -> None:
        self._asked = True


def raise_priority(priority: int, process: int | None = None) -> str:
    """Give all threads of a process a real-time priority, and return the result as text.

    Under the ordinary scheduling a process that wakes up waits for others that are busy, here by up to some
    milliseconds. Threads that begin later inherit the priority.

    Args:
        priority: of SCHED_FIFO, 1 to 99; with 0 all stays as it is.
        process: its number; this one if None.

    Returns:
        How the process is scheduled now, for a person.
    """
    if not priority:
        return "ordinary"
    try:
        for thread in Path(f"/proc/{process or 'self'}/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except ProcessLookupError:
        pass  # a thread that has just ended
    except OSError as error:
        return f"ordinary; real-time priority {priority} refused ({error.strerror}), see `ulimit -r`"
    return f"real time, priority {priority}"


def end_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that end a node in order; not SIGHUP where nohup ignores it.

    What a shell runs in the background ignores SIGINT, but a node's parent ends it by that.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return tuple(which for which in STOPS if which is not signal.SIGHUP or not ignored)


class _Ending(Future):
    """Done when a signal has asked the process to end, or when its nodes were shut down by their lifecycle.

    rclpy's own handlers would take the nodes out of the graph at once, before they can publish their final messages. A
    signal raises nothing: a KeyboardInterrupt out of a library that calls Python comes out as another error, or is
    lost. A thread hears of it, as Python runs no handler while the compiler is at work. It wakes the executor, and ends
    a process that goes on loading. No coil has a current then: see `Health.load`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._asked = False
        self._nodes: tuple[Node, ...] = ()
        self._executor: SingleThreadedExecutor | None = None
        woken, written = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(written, False)
        signal.set_wakeup_fd(written, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(woken,), name="signals", daemon=True).start()
        for which in end_signals():
            signal.signal(which, lambda number, frame: None)

    def done(self) -> bool:
        """Return whether the process is to end."""
        ended = [isinstance(node, GuardedNode) and node.has_ended for node in self._nodes]
        return self._asked or (bool(ended) and all(ended))

    def add_done_callback(self, callback: Callable[..., None]) -> None:
        """Leave a callback out: an executor adds one in each turn, and a signal wakes it."""

    def spin(self, executor: SingleThreadedExecutor, nodes: tuple[Node, ...]) -> None:
        """Run the callbacks of nodes until the process is to end."""
        self._executor, self._nodes = executor, nodes
        executor.spin_until_future_complete(self)

    def _watch(self, woken: int) -> None:
        os.read(woken, 1)
        self._asked = True
        while True:
            if self._executor is not None:
                with suppress(Exception):  # it is gone already
                    self._executor.wake()
            time.sleep(LOADING_GRACE)
            if Health.loading:
                os._exit(0)


def run(make: Callable[[], Node | tuple[Node, ...]], arguments: Sequence[str] | None = None) -> int:
    """Run a node, or several in one process, until it is interrupted, terminated, hung up, or shut down.

    A node then publishes its final messages while the graph is still there: see `GuardedNode.finish`. One that is asked
    to end while it starts ends once it has started, or after `LOADING_GRACE` if it loads or compiles.

    Args:
        make: makes the node, or all of them.
        arguments: of the command line; those of the process if None.

    Returns:
        0 when it was asked to end, 1 with one line on standard error when it could not start or go on.
    """
    nodes: tuple[Node, ...] = ()
    executor = None
    try:
        ending = _Ending()
        init(arguments, signal_handler_options=SignalHandlerOptions.NO)
        made = make()
        nodes = made if isinstance(made, tuple) else (made,)
        if isinstance(made, GuardedNode):
            made.own_process()
        # The multi-threaded executor loses messages in the wheels of Jazzy.
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        # What was loaded stays; to look through it for garbage again and again takes tens of milliseconds.
        gc.collect()
        gc.freeze()
        ending.spin(executor, nodes)
        _finish(nodes)
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


def _finish(nodes: tuple[Node, ...]) -> None:
    """Let nodes publish their final messages, and give the middleware the time to deliver them."""
    if not rclpy.ok():
        return
    for node in nodes:
        if isinstance(node, GuardedNode):
            node.finish()
    until = time.monotonic() + DELIVERY_TIMEOUT
    for node in nodes:
        for publisher in node.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, until - time.monotonic())))
