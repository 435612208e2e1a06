"""Ctrl-C that waits for a good moment."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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
