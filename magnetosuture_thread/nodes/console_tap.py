"""Takes all that is said in a graph, for a recording that somebody may begin and end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

from rclpy.node import Node

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.console_inbox import Inbox

DEPTH = 1000  # messages of a topic that may wait before any is lost
PERIOD = 0.01  # s between two looks at all topics
KINDS = (topics.INPUTS, topics.OUTPUTS, topics.SIMULATED, topics.SETTINGS)
SAID = tuple({topic.name: topic for kind in KINDS for topic in kind}.values())


class ConsoleTap:
    """Hands on every message of some topics as it is, from now on; what is said once and for all comes first.

    Args:
        node: that subscribes; no executor spins it.
        taken: topics to take.
        now: the graph's time [ns], where that is another than the time of the day.
        receive: called with topic, time of arrival [ns] and CDR bytes of every message.
    """

    def __init__(
        self,
        node: Node,
        taken: Iterable[topics.Topic],
        now: Callable[[], int] | None,
        receive: Callable[[str, int, bytes], None],
    ) -> None:
        self._inboxes = [Inbox(node, topic, DEPTH) for topic in taken]
        self._now = now
        self._receive = receive

    async def run(self) -> None:
        """Hand on messages until this is cancelled."""
        while True:
            self.look()
            await asyncio.sleep(PERIOD)

    def look(self) -> None:
        """Hand on the messages that wait."""
        for inbox in self._inboxes:
            for data, arrived in inbox.take():
                self._receive(inbox.topic.channel.recorded, arrived if self._now is None else self._now(), data)

    def close(self) -> None:
        """Hand on what waits, and take no more."""
        self.look()
        for inbox in self._inboxes:
            inbox.close()
