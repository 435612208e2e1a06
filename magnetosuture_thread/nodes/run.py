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
from types import FrameType, TracebackType
from typing import Any, TypeVar

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.nodes.parameter_files import init
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keep no more; raise for one that came, unless something was raised already.

        Raises:
            KeyboardInterrupt: a signal came.
        """
        for which, handler in self._before:
            signal.signal(which, handler)
        if kind is None:
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


ORDINARY = "ordinary"


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
        return ORDINARY
    try:
        for thread in Path(f"/proc/{process or 'self'}/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except ProcessLookupError:
        pass  # a thread that has just ended
    except OSError as error:
        return f"{ORDINARY}; real-time priority {priority} refused ({error.strerror}), see `ulimit -r`"
    return f"real time, priority {priority}"


N = TypeVar("N", bound="Node | tuple[Node, ...]")


def end_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that end a node in order; not SIGHUP where nohup ignores it.

    What a shell runs in the background ignores SIGINT, but a node's parent ends it by that.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return tuple(which for which in STOPS if which is not signal.SIGHUP or not ignored)


class _Ending(Future):
    """Done when a signal has asked the process to end: amid its start by a KeyboardInterrupt, later between callbacks.

    rclpy's own handlers would take the nodes out of the graph at once, before they can publish their final messages.
    Python runs no handler while the compiler is at work, nor while an executor waits: a thread hears of signals too. It
    wakes the executor, and ends a process that goes on loading. No coil has a current then: see `Health.load`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._asked = self._deferred = False
        self._nodes: tuple[Node, ...] = ()
        self._executor: SingleThreadedExecutor | None = None
        woken, written = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(written, False)
        signal.set_wakeup_fd(written, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(woken,), name="signals", daemon=True).start()
        for which in end_signals():
            signal.signal(which, self._on_signal)
        # A KeyboardInterrupt in a function that a C library calls, as to load compiled code, is lost with a traceback
        # on standard error; the signal is remembered here.
        report = sys.unraisablehook
        sys.unraisablehook = lambda lost: None if lost.exc_type is KeyboardInterrupt else report(lost)

    def done(self) -> bool:
        """Return whether the process is to end: it was asked to, or its nodes were shut down by their lifecycle."""
        ended = [isinstance(node, GuardedNode) and node.has_ended for node in self._nodes]
        return self._asked or (bool(ended) and all(ended))

    def add_done_callback(self, callback: Callable[..., None]) -> None:
        """Leave a callback out: an executor adds one in each turn, and `defer` wakes it."""

    def defer(self, executor: SingleThreadedExecutor, nodes: tuple[Node, ...]) -> None:
        """From now on raise nothing, and wake an executor instead."""
        self._executor, self._nodes, self._deferred = executor, nodes, True

    def _watch(self, woken: int) -> None:
        os.read(woken, 1)
        while True:
            if self._executor is not None:
                with suppress(Exception):  # it is gone already
                    self._executor.wake()
            time.sleep(LOADING_GRACE)
            if Health.loading:
                os._exit(0)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        # Amid a message that rclpy's library makes in Python, a KeyboardInterrupt would come out as another error.
        again, self._asked = self._asked, True
        if not self._deferred and not again:
            raise KeyboardInterrupt


def run(
    make: Callable[[], N], arguments: Sequence[str] | None = None, made: Callable[[N], None] = lambda node: None
) -> int:
    """Run a node, or several in one process, until it is interrupted, terminated, hung up, or shut down.

    A node then publishes its final messages while the graph is still there: see `GuardedNode.finish`.

    Args:
        make: makes the node, or all of them.
        arguments: of the command line; those of the process if None.
        made: called with what was made; for what concerns the whole process.

    Returns:
        0 when it was asked to end, 1 when it could not start.
    """
    nodes: tuple[Node, ...] = ()
    executor = ended = None
    try:
        ended = _Ending()
        try:
            init(arguments, signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # rclpy raises several kinds, some private, for a broken parameter file.
            if ended.done():
                return 0
            print(f"error: {_one_line(error)}", file=sys.stderr)
            return 1
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
        ended.defer(executor, nodes)
        executor.spin_until_future_complete(ended)
        _finish(nodes)
    except (KeyboardInterrupt, ExternalShutdownException):
        _finish(nodes)
    except rclpy_implementation.RCLError:
        amid_start = not nodes and ended is not None and ended.done()
        if rclpy.ok() and not amid_start:
            raise  # else a callback was still at work when the node was asked to end
    except (MagnetosutureError, ParameterException, ValueError, RuntimeError, SystemError) as error:
        if not nodes and ended is not None and ended.done():
            return 0  # amid its start: the library behind rclpy makes other errors of a KeyboardInterrupt
        if isinstance(error, (MagnetosutureError, ParameterException)):
            print(f"error: {_one_line(error)}", file=sys.stderr)
            return 1
        if nodes or not isinstance(error, ValueError):
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


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
