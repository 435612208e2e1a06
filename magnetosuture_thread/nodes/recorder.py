"""Takes what is said in a running graph."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from magnetosuture_thread.interface import DIAGNOSTICS
from magnetosuture_thread.nodes.topics import Topic

DEPTH = 1000  # messages that may wait before any is lost


class Recorder:
    """A node that takes every message of some topics as it is.

    Args:
        domain: the graph's ROS domain.
        taken: topics to take.
        simulated_clock: whether the time is that of /clock.
        receive: called with topic, time of arrival [ns] and CDR bytes of every message.

    Attributes:
        taken: messages of each topic so far, by its name with a leading slash.
        said: of each node, what it last said of itself: message and values.
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
        self._simulated = simulated_clock
        self.taken: Counter[str] = Counter()
        self.said: dict[str, tuple[str, dict[str, str]]] = {}
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain, args=[])
        overrides = [Parameter("use_sim_time", value=simulated_clock)]
        self._node = rclpy.create_node("recorder", context=self._context, parameter_overrides=overrides)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._subscriptions = {
            topic.name: self._node.create_subscription(
                topic.message, topic.name, self._taker(topic), self._quality(topic), raw=True
            )
            for topic in taken
        }

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def silent(self) -> list[str]:
        """Return the topics that nobody publishes yet."""
        return [name for name, subscription in self._subscriptions.items() if not subscription.get_publisher_count()]

    def spin(self, duration: float) -> None:
        """Take messages for a while [s]."""
        end = time.monotonic() + duration
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def _quality(self, topic: Topic) -> QoSProfile:
        """Return the topic's own quality of service, with a longer queue."""
        return QoSProfile(
            depth=DEPTH,
            reliability=topic.qos.reliability or ReliabilityPolicy.RELIABLE,
            durability=topic.qos.durability,
        )

    def _taker(self, topic: Topic) -> Callable[[Any, Any], None]:
        def take(data: bytes, info: dict[str, int]) -> None:
            # When the message reached this process: it may have waited here, which is not the graph's delay.
            arrived = info["received_timestamp"]
            if self._simulated or not arrived:
                arrived = self._node.get_clock().now().nanoseconds
            self.taken[topic.channel.recorded] += 1
            self._receive(topic.channel.recorded, int(arrived), bytes(data))
            if topic.channel is DIAGNOSTICS:
                for status in deserialize_message(data, DiagnosticArray).status:
                    values = {value.key: value.value for value in status.values}
                    self.said[status.name.split(":")[0]] = (status.message, values)

        return take
