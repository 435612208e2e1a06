"""Receives all messages of a graph, for a recording."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

from rclpy.node import Node

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.console_inbox import Inbox

QUEUE_DEPTH = 1000  # messages of a topic
POLL_PERIOD = 0.01  # s
_GROUPS = (topics.INPUTS, topics.OUTPUTS, topics.SIMULATED, topics.SETTINGS)
RECORDED_TOPICS = tuple({topic.name: topic for kind in _GROUPS for topic in kind}.values())


class ConsoleTap:
    """Forwards every message of some topics unchanged; latched ones come first.

    Args:
        node: that subscribes, without an executor.
        taken: topics to subscribe.
        now: the graph's time [ns], where it differs from wall time.
        receive: called with topic, time of arrival [ns] and CDR bytes of every message.
    """

    def __init__(
        self,
        node: Node,
        taken: Iterable[topics.Topic],
        now: Callable[[], int] | None,
        receive: Callable[[str, int, bytes], None],
    ) -> None:
        self._inboxes = [Inbox(node, topic, QUEUE_DEPTH) for topic in taken]
        self._now = now
        self._receive = receive

    async def run(self) -> None:
        """Forward messages until cancelled."""
        while True:
            self.poll()
            await asyncio.sleep(POLL_PERIOD)

    def poll(self) -> None:
        """Forward the queued messages."""
        for inbox in self._inboxes:
            for data, arrived in inbox.take():
                self._receive(inbox.topic.channel.recorded, arrived if self._now is None else self._now(), data)

    def close(self) -> None:
        """Forward the queued messages, and unsubscribe."""
        self.poll()
        for inbox in self._inboxes:
            inbox.close()
