"""Takes messages where somebody looks at them, without an executor."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.nodes.messages import decoded
from magnetosuture_thread.nodes.topics import Topic


class Inbox:
    """The messages of a topic that have come and nobody has looked at.

    rclpy's waiting for hundreds of messages a second would cost as much as the nodes that say them; here they wait
    in the middleware, which keeps the newest and knows when each came.

    Args:
        node: that subscribes.
        topic: to take.
        depth: messages that may wait; of more, the oldest are lost.
    """

    def __init__(self, node: Node, topic: Topic, depth: int) -> None:
        self.topic = topic
        quality = QoSProfile(
            depth=depth,
            reliability=topic.qos.reliability or ReliabilityPolicy.RELIABLE,
            durability=topic.qos.durability,
        )
        self._node = node
        self._subscription = node.create_subscription(topic.message, topic.name, _never, quality, raw=True)

    def take(self) -> Iterator[tuple[bytes, int]]:
        """Give the messages that wait: their CDR bytes, and when they came [ns]."""
        subscription = self._subscription
        with subscription.handle:
            while (found := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                data, info = found
                yield bytes(data), info["received_timestamp"]

    def read(self) -> Iterator[tuple[Any, int]]:
        """Give the messages that wait, and when they came [ns]; those that cannot be read are passed over."""
        for data, arrived in self.take():
            try:
                yield decoded(self.topic, data), arrived
            except InvalidInputError:
                continue

    def close(self) -> None:
        """Take no more."""
        self._node.destroy_subscription(self._subscription)


class Latest:
    """What the newest message of a topic says.

    Args:
        node: that subscribes.
        topic: to take.
        read: makes what is kept of a message; an `InvalidInputError` leaves what was kept before.
        period: between two messages that are read, at the least [s].

    Attributes:
        value: what the newest message says that was read; None before the first.
    """

    def __init__(self, node: Node, topic: Topic, read: Callable[[Any], Any], period: float = 0.0) -> None:
        self._inbox = Inbox(node, topic, 1)
        self._read = read
        self._period = period
        self._again = 0.0
        self._arrived = 0
        self.value: Any = None

    def look(self) -> bool:
        """Read the newest message, if one has come; return whether there is something new."""
        now = time.monotonic()
        if now < self._again:
            return False
        waiting = list(self._inbox.take())
        if not waiting:
            return False
        data, arrived = waiting[-1]
        try:
            self.value = self._read(decoded(self._inbox.topic, data))
        except InvalidInputError:
            return False
        self._arrived, self._again = arrived, now + self._period
        return True

    @property
    def age(self) -> float:
        """Return how long ago the message came [s]."""
        return max(0.0, time.time() - self._arrived * 1e-9)

    def aged(self) -> dict[str, Any] | None:
        """Return a copy of what the newest message says, with its age."""
        return None if self.value is None else {**self.value, "age": self.age}

    def close(self) -> None:
        """Take no more."""
        self._inbox.close()


def _never(data: bytes) -> None:
    """Stand in for a callback: no executor calls any."""
