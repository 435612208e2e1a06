"""A node's status on /diagnostics."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from magnetosuture_thread.compiled import compilations
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.texts import shortened

PERIOD = 1.0  # s
COMPILING = "compiling"  # how the state of a node begins that does
MAX_TEXT_CHARS = 400  # of a status or a value, whatever is in it
MAX_VALUES = 100  # that are read of one status


class Health:
    """Publishes a node's state once a second, and at once when it changes.

    Changes are not published more often than `quiet` seconds apart, so that a flood of bad messages
    does not become a flood of reports: one that comes sooner waits, and the last of those that wait is
    published. The count of refusals goes on all the same.

    Args:
        node: whose health it is.

    Attributes:
        loading: how many nodes of this process load; no driver may be open then, as a signal ends the process.
    """

    quiet = 0.05
    loading: ClassVar[int] = 0

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._publisher = topics.DIAGNOSTICS.publisher(node)
        self._level, self._text, self._standby = DiagnosticStatus.OK, "starting", ""
        self._refused = 0
        self._last_refusal = ""
        self._values: dict[str, object] = {}
        self._sent = -1.0
        node.create_timer(PERIOD, self.publish, clock=self._clock)
        self._late = node.create_timer(self.quiet, self._publish_late, clock=self._clock)
        self._late.cancel()

    def ok(self, text: str, **values: object) -> None:
        """Report level OK."""
        self._set(DiagnosticStatus.OK, text, values)

    def warn(self, text: str, **values: object) -> None:
        """Report level WARN: the node continues but cannot do all of its work."""
        self._set(DiagnosticStatus.WARN, text, values)

    def error(self, text: str, **values: object) -> None:
        """Report level ERROR: the node cannot do its work."""
        self._set(DiagnosticStatus.ERROR, text, values)

    def stand_by(self, text: str) -> None:
        """Report this at level WARN, whatever else there is to report; an empty text ends that."""
        if text != self._standby:
            self._standby = shortened(text, MAX_TEXT_CHARS)
            self._publish_soon()

    def note(self, **values: object) -> None:
        """Keep values for the next report."""
        self._values.update(values)

    def refuse(self, problem: Exception, **values: object) -> None:
        """Say that an input was refused; the node itself goes on. An error that it has said before stays said."""
        self._refused += 1
        self._last_refusal = shortened(str(problem), MAX_TEXT_CHARS)
        if self._level == DiagnosticStatus.ERROR:
            self._values.update(values)
        else:
            self._set(DiagnosticStatus.WARN, f"refused: {self._last_refusal}", values)

    @contextmanager
    def load(self, what: str) -> Iterator[None]:
        """Report once a second, at level WARN, that the node loads, or compiles what no cache has, while it does."""
        before, compiling, done = compilations(), f"{COMPILING} {what}, once on this machine", threading.Event()
        self.warn(f"loading {what}")
        self._node.get_logger().info(self._text)

        def repeat() -> None:
            while not done.wait(PERIOD):
                if compilations() > before and self._text != compiling:
                    self.warn(compiling)
                    self._node.get_logger().info(compiling)
                self.publish()

        thread = threading.Thread(target=repeat, daemon=True)
        thread.start()
        Health.loading += 1
        try:
            yield
        finally:
            Health.loading -= 1
            done.set()
            thread.join()

    def publish(self) -> None:
        """Publish the state now."""
        values = {**self._values, "refused": self._refused, "last refusal": self._last_refusal or "none"}
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if self._standby else self._level,
            name=f"{self._node.get_fully_qualified_name().lstrip('/')}: state",
            message=self._standby or self._text,
            hardware_id="magnetosuture",
            values=[KeyValue(key=key, value=shortened(str(value), MAX_TEXT_CHARS)) for key, value in values.items()],
        )
        stamp = self._node.get_clock().now().to_msg()
        message = DiagnosticArray(status=[status])
        message.header.stamp = stamp
        self._publisher.publish(message)
        self._sent = self._clock.now().nanoseconds * 1e-9

    def _set(self, level: bytes, text: str, values: dict[str, object]) -> None:
        text = shortened(text, MAX_TEXT_CHARS)
        changed = (level, text) != (self._level, self._text)
        self._level, self._text = level, text
        self._values.update(values)
        if changed and not self._standby:
            self._publish_soon()

    def _publish_soon(self) -> None:
        if self._clock.now().nanoseconds * 1e-9 - self._sent > self.quiet:
            self.publish()
        elif self._late.is_canceled():
            self._late.reset()

    def _publish_late(self) -> None:
        self._late.cancel()
        self.publish()


def read_status(status: DiagnosticStatus) -> tuple[str, dict[str, str]]:
    """Return message and values of a status, of anybody, with texts of bounded length."""
    values = {shortened(each.key): shortened(each.value, MAX_TEXT_CHARS) for each in status.values[:MAX_VALUES]}
    return shortened(status.message, MAX_TEXT_CHARS), values
