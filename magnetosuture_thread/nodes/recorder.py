"""Records messages of a running graph."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress

import rclpy
from rclpy.context import Context
from rclpy.qos import QoSProfile, ReliabilityPolicy

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.interface import ALL_NODES, DIAGNOSTICS
from magnetosuture_thread.messages.reading import clock_nanoseconds
from magnetosuture_thread.nodes.diagnostics import read_status
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.nodes.topics import CLOCK, Topic

DEPTH = 1000  # messages that may wait before any is lost
PERIOD = 0.005  # s between two looks at all topics


class Recorder:
    """A node that records the serialised messages of some topics.

    It looks at its subscriptions itself, without an executor: with nearly a thousand messages a second
    rclpy's waiting for each would cost as much as the graph that is recorded. When a message arrived is
    what the middleware says, so that it does not matter when it is looked at.

    Args:
        domain: the graph's ROS domain.
        taken: topics to take.
        simulated_clock: whether the time is that of /clock.
        receive: called with topic, time of arrival [ns] and CDR bytes of every message.

    Attributes:
        taken: messages of each topic so far, by its name with a leading slash.
        status_texts: of each node of this package, message and values of its last status.
    """

    def __init__(
        self,
        domain: int,
        taken: Sequence[Topic],
        *,
        simulated_clock: bool,
        receive: Callable[[str, int, bytes], None],
    ) -> None:
        self._receive = receive
        self._now = 0 if simulated_clock else None
        self.taken: Counter[str] = Counter()
        self.status_texts: dict[str, tuple[str, dict[str, str]]] = {}
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain, args=[])
        self._node = GuardedNode("recorder", context=self._context, start_parameter_services=False)
        followed = (CLOCK, *taken) if simulated_clock else taken
        self._subscriptions = [
            (topic, self._node.create_subscription(topic.message, topic.name, _never, self._quality(topic), raw=True))
            for topic in followed
        ]

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        self._context.try_shutdown()

    def silent(self) -> list[str]:
        """Return the topics without a publisher."""
        return [t.name for t, subscription in self._subscriptions if not subscription.get_publisher_count()]

    def spin(self, duration: float) -> None:
        """Receive messages for a time [s]."""
        end = time.monotonic() + duration
        while time.monotonic() < end:
            for topic, subscription in self._subscriptions:
                with subscription.handle:
                    while (found := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                        data, info = found
                        self._take(topic, bytes(data), info["received_timestamp"])
            time.sleep(PERIOD)

    def _take(self, topic: Topic, data: bytes, arrived: int) -> None:
        if topic is CLOCK:
            with suppress(InvalidInputError):  # no time at all
                self._now = clock_nanoseconds(CLOCK.decode(data))
            return
        self.taken[topic.channel.recorded] += 1
        self._receive(topic.channel.recorded, arrived if self._now is None else self._now, data)
        if topic.channel is DIAGNOSTICS:
            with suppress(InvalidInputError):
                for status in topic.decode(data).status:
                    name = status.name.split(":")[0]
                    if name in ALL_NODES:
                        self.status_texts[name] = read_status(status)

    def _quality(self, topic: Topic) -> QoSProfile:
        """Return the topic's own quality of service, with a longer queue."""
        return QoSProfile(
            depth=DEPTH,
            reliability=topic.qos.reliability or ReliabilityPolicy.RELIABLE,
            durability=topic.qos.durability,
        )


def _never(data: bytes) -> None:
    """Stand in for a callback: no executor calls any."""
