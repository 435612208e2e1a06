"""Latest messages of topics, polled without an executor, and all messages of a graph for a recording."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.topics import Topic


class Inbox:
    """Queue of the messages of a topic since the last poll.

    Waiting for hundreds of messages a second in rclpy would cost as much as the nodes that send them. Here they are
    queued in the middleware, which keeps the latest and their time of arrival.

    Args:
        node: that subscribes.
        topic: to subscribe.
        depth: of the queue; beyond it, the oldest messages are lost.
    """

    def __init__(self, node: Node, topic: Topic, depth: int) -> None:
        self.topic = topic
        quality = QoSProfile(
            depth=depth,
            reliability=topic.qos.reliability or ReliabilityPolicy.RELIABLE,
            durability=topic.qos.durability,
        )
        self._node, self._depth = node, depth
        self._subscription = node.create_subscription(topic.message, topic.name, _never, quality, raw=True)

    def take(self) -> Iterator[tuple[bytes, int]]:
        """Yield the queued messages, no more than the queue holds: CDR bytes, and time of arrival [ns].

        In a flood there would always be one more.
        """
        subscription = self._subscription
        with subscription.handle:
            for _ in range(self._depth):
                found = subscription.handle.take_message(subscription.msg_type, True)
                if found is None:
                    return
                data, info = found
                yield bytes(data), info["received_timestamp"]

    def read(self) -> Iterator[tuple[Any, int]]:
        """Yield the queued messages, and their time of arrival [ns]; invalid ones are skipped."""
        for data, arrived in self.take():
            try:
                yield self.topic.decode(data), arrived
            except InvalidInputError:
                continue

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)


class Latest:
    """Content of the latest message of a topic.

    Args:
        node: that subscribes.
        topic: to subscribe.
        read: converts a message; where it fails, the previous value stays.
        period: minimum between two messages that are read [s].
        max_bytes: of a message that is read; the topic's own bound if None.

    Attributes:
        value: content of the latest message that was read; None before the first.
    """

    def __init__(
        self,
        node: Node,
        topic: Topic,
        read: Callable[[Any], Any],
        period: float = 0.0,
        *,
        max_bytes: int | None = None,
    ) -> None:
        self._inbox = Inbox(node, topic, 1)
        self._max_bytes = topic.max_bytes if max_bytes is None else max_bytes
        self._read = read
        self._period = period
        self._next_read = 0.0
        self._arrived = 0
        self.value: Any = None

    def poll(self) -> bool:
        """Read the latest message, if there is one; return whether there is a new value."""
        now = time.monotonic()
        if now < self._next_read:
            return False
        waiting = list(self._inbox.take())
        if not waiting:
            return False
        data, arrived = waiting[-1]
        if len(data) > self._max_bytes:
            return False
        try:
            self.value = self._read(self._inbox.topic.decode(data))
        except Exception:  # whatever is wrong with a message, the page goes on with the one before
            return False
        self._arrived, self._next_read = arrived, now + self._period
        return True

    @property
    def age(self) -> float:
        """Return the age of the message [s]."""
        return max(0.0, time.time() - self._arrived * 1e-9)

    def aged(self) -> dict[str, Any] | None:
        """Return a copy of the latest content, with its age."""
        return None if self.value is None else {**self.value, "age": self.age}

    def close(self) -> None:
        """Unsubscribe."""
        self._inbox.close()


def _never(data: bytes) -> None:
    """Unused callback: there is no executor."""


QUEUE_DEPTH = 1000  # messages of a topic
POLL_PERIOD = 0.01  # s
_GROUPS = (topics.INPUTS, topics.OUTPUTS, topics.SIMULATED, topics.SETTINGS, topics.PROCEDURES)
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
